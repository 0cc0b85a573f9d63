// Formats of numbers, and the names of phases, events and keys.

export const PHASES = { 1: "own anchor", 2: "search", 3: "encounter" };

/** What robots of a team do, by phase. */
export const STEPS = { 1: "pose unknown", 2: "to another anchor", 3: "pose estimated" };

/** Returns a number with a minus sign; one that rounds to zero has no sign. */
export const number = (value, digits) => value.toFixed(digits).replace(/^-(?=[0.]+$)/, "").replace("-", "−");
const signed = (value, digits) => number(value, digits).replace(/^\d/, "+$&");

export function metres(value) {
  const size = Math.abs(value);
  if (size >= 0.095 || size === 0) return `${number(value, size < 1e4 ? 2 : 0)} m`;
  if (size >= 1e-3) return `${number(value * 1e3, 1)} mm`;
  if (size >= 1e-6) return `${number(value * 1e6, 1)} µm`;
  return `${value.toExponential(1).replace("-", "−")} m`;
}

/** Returns a time in s, to the millisecond. */
export const seconds = (value) => `${Number(value.toFixed(3))} s`;

export const rad = (value) => `${signed(value, 2)} rad`;
export const speed = (value) => `${number(value, 2)} m/s`;
export const turning = (value) => `${signed(value, 2)} rad/s`;
export const place = ([x, y]) => `${number(x, 2)}, ${number(y, 2)} m`;

export function probability(value) {
  if (value > 0.9999) return "> 99.99 %";
  if (value >= 0.995) return `${(100 * value).toFixed(2)} %`;
  if (value < 0.001) return "< 0.1 %";
  return `${(100 * value).toFixed(value < 0.1 ? 1 : 0)} %`;
}

/** Returns the text of an event or a caption, with what the ground truth adds if it is `shown`. */
export const said = ({ text, truth }, shown, joint = "; ") => [text, shown && truth].filter(Boolean).join(joint);

export const plural = (count, one) => `${count} ${one}${count === 1 ? "" : "s"}`;

/** One symbol for each kind of event, so that kinds can be distinguished without colour. */
export const SIGNS = {
  anchor: "◎", "anchor-lost": "○", contact: "⇄", "contact-lost": "⇎", phase: "§", state: "·",
  branch: "∠", candidates: "∴", claim: "★", undecided: "…", inconsistent: "!", late: "◔", end: "■", down: "⊘", back: "↻",
  "report-lost": "✕", "report-damaged": "⊗", "report-late": "◷", "report-doubled": "‖",
};

export const KEYS = [
  ["space", "play or pause"],
  ["← →", "previous or next tick; with Shift, 10 ticks"],
  [", .", "previous or next event"],
  ["Home End", "first or last tick"],
  ["[ ]", "slower or faster, at a plain speed"],
  ["G", "guided play: fast through the search, slow at what matters"],
  ["C", "let the camera follow the story, or leave it"],
  ["L", "follow a running mission"],
  ["T", "show or hide the ground truth"],
  ["R", "next robot; with Shift, previous robot"],
  ["A", "all robots"],
  ["Esc", "all robots, and nothing selected; a click on a robot, an anchor or a hypothesis selects it"],
  ["+ −", "zoom in or out; also the mouse wheel"],
  ["W S", "pan up or down; with Shift, left or right; also by dragging"],
  ["N", "zoom to the robots and to where they may be"],
  ["F", "zoom to the whole scenario"],
  ["D", "show or hide the sequence diagram of the reports"],
  ["E", "change the scenario, and run it again"],
  ["K", "show or hide the legend"],
  ["V", "show or hide the charts"],
  ["?", "this help"],
];

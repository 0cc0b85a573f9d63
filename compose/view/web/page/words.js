// How figures are written, what the phases and the signs are called.

export const PHASES = { 1: "its anchor", 2: "the search", 3: "the encounter" };

const number = (value, digits) => value.toFixed(digits).replace("-", "−");

export function metres(value) {
  const size = Math.abs(value);
  if (size >= 0.095 || size === 0) return `${number(value, size < 1e4 ? 2 : 0)} m`;
  if (size >= 1e-3) return `${number(value * 1e3, 1)} mm`;
  if (size >= 1e-6) return `${number(value * 1e6, 1)} µm`;
  return `${value.toExponential(1).replace("-", "−")} m`;
}

export const rad = (value) => `${value < 0 ? "" : "+"}${number(value, 2)} rad`;
export const speed = (value) => `${number(value, 2)} m/s`;
export const turning = (value) => `${value < 0 ? "" : "+"}${number(value, 2)} rad/s`;
export const place = ([x, y]) => `${number(x, 2)}, ${number(y, 2)} m`;

export function probability(value) {
  if (value > 0.9999) return "> 99.99 %";
  if (value >= 0.995) return `${(100 * value).toFixed(2)} %`;
  if (value < 0.001) return "< 0.1 %";
  return `${(100 * value).toFixed(value < 0.1 ? 1 : 0)} %`;
}

export const plural = (count, one) => `${count} ${one}${count === 1 ? "" : "s"}`;

/** Kinds of events: a sign of its own for each, since colour says too little. */
export const SIGNS = {
  anchor: "◎", "anchor-lost": "○", contact: "⇄", "contact-lost": "⇎", phase: "§", state: "·",
  branch: "∠", candidates: "∴", claim: "★", undecided: "…", alarm: "!", late: "◔", end: "■", down: "⊘", back: "↻",
  "report-lost": "✕", "report-damaged": "⊗", "report-late": "◷", "report-doubled": "‖",
};

export const KIND_NAMES = {
  anchor: "anchor in range", "anchor-lost": "anchor out of range", contact: "contact", "contact-lost": "contact lost",
  phase: "phase", state: "state", branch: "branch chosen", candidates: "candidates", claim: "claim",
  undecided: "undecided", alarm: "inconsistent", late: "late", end: "end", down: "process gone", back: "process runs again", "report-lost": "report lost",
  "report-damaged": "report damaged", "report-late": "report late", "report-doubled": "report doubled",
};

export const FAULTS = new Set(["report-lost", "report-damaged", "report-late", "report-doubled", "late"]);

export const KEYS = [
  ["space", "play, pause"],
  ["← →", "a tick back, on; with shift ten"],
  [", .", "to the event before, after"],
  ["Home End", "to the beginning, to the end"],
  ["[ ]", "slower, faster"],
  ["L", "follow a mission that runs"],
  ["T", "truth, or only what robots know"],
  ["R", "the next robot; with shift the one before"],
  ["A", "all robots"],
  ["+ −", "nearer, farther; also the wheel"],
  ["W S", "shift the plane up, down; with shift left, right; also by dragging"],
  ["N", "the robots from near"],
  ["F", "fit everything in"],
  ["?", "these keys"],
];

export const MEANINGS = [
  ["a filled robot", "where it truly is; a pointed one plays a, a round one b"],
  ["an outlined robot", "where it may be, for all it knows; the paler, the less likely; crossed out: ruled out just now"],
  ["an ellipse", "three sigma of the likeliest"],
  ["a hollow robot, crossed out", "its process is gone"],
  ["a line to an anchor", "a range, in the tick in which it is measured"],
  ["a double line", "contact; the dots on it are reports: filled heard, with a tail late, hollow lost, crossed damaged"],
  ["a dotted trail", "phase 1; a thin one phase 2, a thick one phase 3"],
  ["a ring round an anchor", "its range; broken: the orbit"],
];

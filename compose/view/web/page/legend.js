// The legend beside the plane: only the marks that are drawn now, and those above the time line, in plain words.

import { make } from "./cards.js";
import { SIGNS, STEPS } from "./words.js";

/** The least width in pixels of a window in which the legend is open at first. */
const WIDE_PX = 900;

const drawn = (inside) => `<svg viewBox="0 0 30 16" aria-hidden="true">${inside}</svg>`;
const line = (colour, more = "") => drawn(`<path d="M1 8h28" fill="none" stroke="var(--${colour})" stroke-width="2" ${more}/>`);
const ring = (colour, more = "") => drawn(`<circle cx="15" cy="8" r="6" fill="none" stroke="var(--${colour})" stroke-width="1.8" ${more}/>`);
const GLOW = '<path d="M1 8h28" stroke="var(--now)" stroke-width="8"/>';
const POINTED = 'd="M23 8 8 14l4-6-4-6z"';
const ROUND = 'd="M22 8 17.5 3.5a6.4 6.4 0 1 0 0 9z"';
const dot = (more) => drawn(`<circle cx="15" cy="8" r="4.5" stroke-width="1.8" ${more}/>`);
const cross = 'M11 4l8 8M19 4l-8 8';

/** The marks of the plane that stay once they are drawn, in the order of the legend, each with its drawing and its words. */
const LASTING = {
  "robot-a": [drawn(`<path ${POINTED} fill="var(--robot-a)"/>`), ({ a }) => `robot ${a}`],
  "robot-b": [drawn(`<path ${ROUND} fill="var(--robot-b)"/>`), ({ b }) => `robot ${b}`],
  localised: [drawn(`<path ${POINTED} fill="var(--robot-a)"/>`), ({ team }) => `localised robot, its path${team ? "" : " and its anchor"}`],
  unlocalised: [drawn(`<path ${ROUND} fill="var(--robot-b)"/>`), "robot that is not yet localised, its path"],
  meeting: [drawn('<path d="M1 8h20" stroke="var(--robot-a)" stroke-width="1.3"/><path d="M28 8l-7 3v-6z" fill="var(--robot-a)"/>'), "who localises whom; dotted: planned"],
  anchor: [drawn('<circle cx="15" cy="8" r="7.5" fill="var(--disc)" stroke="var(--ring)"/><path d="M15 4.5l3.5 6h-7z" fill="var(--ink)"/>'), ({ range }) => `anchor${range && `; sensing range ${range}`}`],
  unsurveyed: [drawn('<path d="M15 4.5l3.5 6h-7z" fill="var(--paper)" stroke="var(--ink)"/>'), "anchor at a position that robots do not know"],
  orbit: [drawn('<path d="M2 15q13-22 26 0" fill="none" stroke="var(--orbit)" stroke-width="1.6" stroke-dasharray="6 4"/>'), ({ own }) => (own ? "orbit" : "search circle (phase 2)")],
  "path-1": [line("faint", 'stroke-dasharray="1.5 4"'), ({ own, team }) => (team ? "path, pose unknown" : `path, phase 1${own ? "" : ": near anchor"}`)],
  "path-2": [line("faint", 'stroke-dasharray="6 4"'), ({ own, team }) => (team ? "path to another anchor" : `path, phase 2${own ? "" : ": search"}`)],
  "path-3": [line("faint"), ({ own, team }) => (team ? "path, pose estimated" : `path, phase 3${own ? "" : ": encounter"}`)],
  reported: [line("fault", 'stroke-dasharray="6 4"'), "path that an attacker reports"],
};
/** The other marks. */
const MOMENTARY = {
  down: [drawn(`<path ${POINTED} fill="none" stroke="var(--faint)" stroke-width="2"/><path d="${cross}" stroke="var(--fault)" stroke-width="2"/>`), "robot whose process is gone"],
  places: [drawn('<circle cx="15" cy="8" r="6.5" fill="none" stroke="var(--ghost)" stroke-width="2.4" stroke-dasharray="1.5 4"/><path d="M15 5.5l2.5 4.3h-5z" fill="var(--ink)"/>'), "all places at the measured distance"],
  way: [line("ghost", 'stroke-width="1.6"'), "path by a hypothesis"],
  axis: [line("faint", 'stroke-width="1" stroke-dasharray="6 4"'), "mirror axis: distances to the anchor do not tell its sides apart"],
  crossing: [drawn('<circle cx="10" cy="8" r="7" fill="none" stroke="var(--ghost)" stroke-dasharray="6 4"/><circle cx="20" cy="8" r="7" fill="none" stroke="var(--ghost)" stroke-width="2" stroke-dasharray="1.5 4"/>'), "turned about its anchor, the driven path fits where the circles cross"],
  distance: [drawn(`${GLOW}<path d="M1 8h28" stroke="var(--range)" stroke-width="2"/>`), ({ team }) => `distance to ${team ? "an" : "the"} anchor`],
  turned: [drawn(`<path ${POINTED} fill="none" stroke="var(--faint)" stroke-opacity="0.7"/>`), "turned around the anchor: just as possible"],
  pose: [drawn(`<path ${POINTED} fill="none" stroke="var(--ghost)" stroke-width="2"/>`), "hypothesis: a pose (place and heading) that a robot may have"],
  "ruled-out": [drawn(`<path ${POINTED} fill="none" stroke="var(--ghost)" stroke-dasharray="3 2.2"/><path d="${cross}" stroke="var(--fault)" stroke-width="1.8"/>`), "pose that is ruled out"],
  ellipse: [drawn('<ellipse cx="15" cy="8" rx="12" ry="5.5" fill="var(--cloud)" stroke="var(--ghost)"/>'), "uncertainty (3 sigma)"],
  arc: [drawn('<path d="M2 13q13-15 26 0l-4 2q-9-9-18 0z" fill="var(--cloud)" stroke="var(--ghost)"/>'), "uncertainty (3 sigma): along an arc"],
  estimated: [drawn('<circle cx="15" cy="8" r="6.5" fill="var(--cloud)" stroke="var(--ghost)"/><circle cx="15" cy="8" r="2" fill="var(--ghost)"/>'), "anchor as a robot estimates it (3 sigma)"],
  contact: [drawn(`${GLOW}<path d="M1 6h28M1 10h28" stroke="var(--link)" stroke-width="1.4"/>`), "in range of each other"],
  reach: [ring("link", 'stroke-dasharray="6 4"'), ({ range }) => `range between robots: ${range}`],
  report: [dot('fill="var(--link)"'), ({ team }) => `report to ${team ? "another" : "the other"} robot`],
  late: [drawn('<path d="M4 8h11" stroke="var(--link)" stroke-width="4"/><circle cx="17" cy="8" r="4.5" fill="var(--link)"/>'), "report that arrives late"],
  waiting: [dot('fill="none" stroke="var(--link)"'), "report under way"],
  lost: [dot('fill="none" stroke="var(--fault)" stroke-dasharray="3 2.2"'), "report that is lost"],
  damaged: [drawn(`<circle cx="15" cy="8" r="5" fill="none" stroke="var(--fault)" stroke-width="1.6"/><path d="${cross}" stroke="var(--fault)"/>`), "report that arrives damaged"],
  configuration: [drawn('<path d="M5 8h20" stroke="var(--tint-1)"/><circle cx="5" cy="8" r="3.6" fill="var(--card)" stroke="var(--tint-1)" stroke-width="2"/><circle cx="25" cy="8" r="3.6" fill="var(--card)" stroke="var(--tint-1)" stroke-width="2"/>'), "hypothesis: a pose of each robot, in one colour"],
  reachable: [drawn('<path d="M3 13q12-14 24-4" fill="none" stroke="var(--faint)" stroke-width="4"/>'), ({ mover }) => `where ${mover} could drive; thick: predictions differ more`],
  choice: [drawn('<path d="M3 11q10-9 19-4" fill="none" stroke="var(--ink)" stroke-width="2"/><path d="M28 9.5l-8 1.5 3.5-6z" fill="var(--ink)"/>'), ({ mover }) => `manoeuvre chosen by ${mover}`],
  predicted: [drawn('<circle cx="15" cy="8" r="6" fill="none" stroke="var(--tint-1)" stroke-width="1.8" stroke-dasharray="6 4"/><path d="M15 8h6" stroke="var(--tint-1)"/>'), "distance that a hypothesis predicts"],
  inset: [drawn('<rect x="3" y="1" width="24" height="14" fill="none" stroke="var(--ring)"/><rect x="8" y="5" width="8" height="5" fill="none" stroke="var(--ink)"/>'), "all robots, and what is in view"],
  measured: [ring("ink", 'style="stroke-width: 4; opacity: 0.2"'), "measured distance"],
};
/** The drawing of the bands of the time line. */
const BANDS = drawn('<path d="M1 8h9" stroke="var(--faint)" stroke-width="3"/><path d="M10 8h9" stroke="var(--faint)" stroke-width="6"/><path d="M19 8h10" stroke="var(--faint)" stroke-width="10"/>');
/** The signs above the time line. */
const TIMES = {
  contact: "robots in range (shaded)", claim: "a robot claims its pose", inconsistent: "a contradiction is found",
  several: "number of hypotheses of a robot", undecided: "a robot has no claim, or withdraws it", down: "a process is gone", back: "a process is back",
};

export class Legend {
  /** `box` is the details element that opens the legend; `changed` is called when it opens or closes. */
  constructor(box, changed) {
    this.list = box.querySelector("ul");
    box.open = window.innerWidth >= WIDE_PX;
    box.addEventListener("toggle", changed);
  }

  #key = "";

  /**
   * Lists `marks` of the plane and `kinds` of events above the time line. What stays comes first, so that lines keep their places.
   *
   * `names` are the words of the story: the ids of robots `a` and `b`, the `mover` of the last manoeuvre, the
   * sensing `range`, whether the planner is the user's `own`, and whether the robots are a `team`.
   */
  draw(marks, kinds, names) {
    const key = [...marks, "", ...kinds, "", ...Object.values(names)].join();
    if (key === this.#key) return;
    this.#key = key;
    const said = (words) => (typeof words === "string" ? words : words(names));
    const items = (all) => Object.entries(all).filter(([name]) => marks.has(name)).map(([, [picture, words]]) => entry(picture, said(words)));
    const times = Object.entries(TIMES).filter(([kind]) => kinds.has(kind)).map(([kind, words]) => (
      make("li", {}, make("b", { textContent: SIGNS[kind] ?? "4" }), make("span", { textContent: words }))
    ));
    times.push(entry(BANDS, names.team ? `thickness: ${Object.values(STEPS).join(", ")}` : "thickness: phase 1, 2, 3"));
    const passing = items(MOMENTARY);
    if (passing.length) passing.unshift(title("now"));
    this.list.replaceChildren(...items(LASTING), title("on the time line"), ...times, ...passing);
  }
}

const title = (words) => make("li", { className: "title", textContent: words });

const entries = {};
/** Returns the line of the legend with `picture` and `words`; the same one at each call. */
function entry(picture, words) {
  if (entries[picture + words]) return entries[picture + words];
  const item = make("li");
  item.innerHTML = picture;
  item.append(make("span", { textContent: words }));
  return entries[picture + words] = item;
}

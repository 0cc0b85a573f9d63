// The sequence diagram: a lane for the world and for each robot, the ticks around the current one, and the reports as arrows.

import { cross, line, OUTLINED, unit } from "./pen.js";
import { extent, fresh_pen, palette, resize } from "./strip.js";
import { plural, SIGNS } from "./words.js";

const LANE = 30;
/** The width of a tick. */
const TICK = 34;
const MOST_LANES = 6;
const TOP = 18;
/** Half the gap in the lane of a process that is restarted in the same tick, as a share of the width of a tick. */
const GAP = 0.3;
const PROCESS = new Set(["late", "down", "back"]);

export class Sequence {
  /** `box` is the details element that opens the diagram; nothing is drawn while it is closed. */
  constructor(box, go, changed) {
    const canvas = box.querySelector("canvas");
    Object.assign(this, { box, canvas, changed, told: box.querySelector("p") });
    canvas.addEventListener("click", ({ clientX }) => {
      const from_left = (clientX - canvas.getBoundingClientRect().left) / unit();
      go(this.from + Math.floor((from_left - this.inset) / TICK));
    });
    box.addEventListener("toggle", changed);
  }

  from = 0;
  inset = 60;

  /** Draws the ticks around the current one. */
  draw(store, { tick, focus }) {
    if (!this.box.open) return;
    const { canvas } = this, robots = store.few(focus, MOST_LANES);
    const of = palette(), size = extent(canvas), tall = TOP + LANE * (robots.length + 1);
    resize(canvas, size, tall);
    const pen = fresh_pen(canvas, size.ratio, of);
    this.inset = 14 + Math.max(...["world", ...robots.map((robot) => robot.id)].map((name) => pen.measureText(name).width));
    const room = size.wide - this.inset, count = Math.max(Math.floor(room / TICK + 1e-6), 1);
    this.from = Math.max(Math.min(tick - Math.floor(count / 2), store.last - count + 1), store.first);
    const to = Math.min(this.from + count - 1, store.last);
    const x = (k) => this.inset + (k - this.from + 0.5) * TICK;
    const rows = new Map([[null, TOP + LANE / 2], ...robots.map((robot, i) => [robot.id, TOP + LANE * (i + 1.5)])]);
    const frame = { pen, store, of, rows, x, tick, to };
    pen.fillStyle = of("grid");
    pen.fillRect(x(tick) - TICK / 2, 0, TICK, tall);
    for (const [id, y] of rows) {
      pen.fillStyle = of("faint");
      pen.fillText(id ?? "world", 4, y + 4);
    }
    pen.textAlign = "center";
    pen.beginPath();
    pen.rect(this.inset, 0, room, tall); // an arrow may begin before the first tick that is shown
    pen.clip();
    this.#lanes(frame);
    this.#arrows(frame);
    this.#ticks(frame);
    const hidden = store.stage.robots.length - robots.length;
    const text = `Tick ${tick}. ${told(store, tick, rows).join(". ") || "No reports"}.${hidden ? ` ${plural(hidden, "robot")} not shown.` : ""}`;
    if (this.told.textContent !== text) {
      this.told.textContent = text;
      canvas.setAttribute("aria-label", text);
    }
  }

  /** Draws the lanes; the lane of a process has a gap from its end to its restart. */
  #lanes({ pen, store, of, rows, x, to }) {
    const half = TICK / 2;
    for (const [id, y] of rows) {
      const hue = of(id === null ? "faint" : `robot-${store.stage.robots[store.places.get(id)].role}`), lane = (from, end) => line(pen, [[from, y], [end, y]], hue, 2);
      let begin = x(this.from) - half;
      for (let k = this.from; k <= to; k++) {
        const kinds = (store.scene(k)?.events ?? []).filter((event) => event.robot === id).map((event) => event.kind);
        const down = kinds.includes("down"), back = kinds.includes("back");
        if ((down || store.player(k, id)?.down) && begin !== null) {
          lane(begin, x(k) - (down ? GAP * TICK : half));
          begin = null;
        }
        if (back) begin = x(k) + GAP * TICK;
        else if (!down && begin === null && !store.player(k, id)?.down) begin = id === null ? null : x(k) - half;
      }
      if (begin !== null) lane(begin, x(to) + half);
    }
  }

  #arrows({ pen, store, of, rows, x, to }) {
    const side = 0.2 * TICK;
    for (let k = this.from; k <= to; k++) {
      for (const passage of store.scene(k)?.passages ?? []) {
        const fate = fate_of(passage, k), start = rows.get(passage.sender), end = rows.get(passage.receiver);
        if (!fate || start === undefined || end === undefined) continue;
        arrow(pen, x(passage.tick) - side, start, x(fate === "lost" ? passage.tick : k) + side, end, fate, of);
      }
    }
  }

  /** Draws the numbers of ticks, ends and restarts of processes, and missed deadlines. */
  #ticks({ pen, store, of, rows, x, tick, to }) {
    for (let k = this.from; k <= to; k++) {
      pen.fillStyle = of(k === tick ? "ink" : "faint");
      pen.fillText(String(k), x(k), 12);
      for (const { kind, robot } of store.scene(k)?.events ?? []) {
        const y = rows.get(robot);
        if (!PROCESS.has(kind) || y === undefined) continue;
        pen.fillStyle = of(kind === "back" ? "ink" : "fault");
        pen.fillText(kind === "back" ? "●" : SIGNS[kind], x(k) + { late: 0, down: -GAP, back: GAP }[kind] * TICK, y + 4);
      }
    }
  }
}

/** Returns what became of the reports of a tick, and of the processes, in sentences. */
function told(store, tick, rows) {
  const { passages = [], events = [] } = store.scene(tick) ?? {};
  const shown = passages.filter((passage) => fate_of(passage, tick) && rows.has(passage.sender) && rows.has(passage.receiver));
  return [
    ...shown.map((passage) => `${passage.sender}'s report of tick ${passage.tick} to ${passage.receiver}: ${fate_of(passage, tick)}`),
    ...events.filter(({ kind, robot }) => PROCESS.has(kind) && rows.has(robot)).map((event) => event.text),
  ];
}

function fate_of({ what, tick }, now) {
  if (what === "heard") return tick < now ? "delayed" : "received";
  return what === "sent" ? null : what;
}

/** Draws an arrow; a lost report ends half-way in a cross, a damaged one at its receiver, a delayed one is dashed. */
function arrow(pen, x, y, to_x, to_y, fate, of) {
  const bad = fate === "lost" || fate === "damaged";
  const part = fate === "lost" ? 0.5 : 0.88, end_x = x + part * (to_x - x), end_y = y + part * (to_y - y);
  const hue = of(bad ? "fault" : fate === "delayed" ? "range" : "link");
  line(pen, [[x, y], [end_x, end_y]], hue, 1.5, fate === "delayed" ? OUTLINED : []);
  if (bad) return void cross(pen, end_x, end_y, 4.3, { fault: hue });
  const angle = Math.atan2(to_y - y, to_x - x);
  for (const turn of [2.6, -2.6]) line(pen, [[end_x, end_y], [end_x + 6 * Math.cos(angle + turn), end_y + 6 * Math.sin(angle + turn)]], hue, 1.5);
}

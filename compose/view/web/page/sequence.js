// The sequence diagram: a lane for the world and for each robot, time across, and the reports between them as arrows.
// Zoomed out, bars count the reports instead.

import { unit } from "./pen.js";
import { plural, SIGNS } from "./words.js";

const LANE = 30;
/** The width of a tick: at first, at the most, and that below which arrows become bars. */
const TICK = 34;
const WIDEST = 80;
const NARROW = 12;
/** The least width of a bar, and the height of the highest. */
const BAR = 5;
const HIGH = 20;
const MOST_LANES = 6;
const TOP = 18;
/** Half the gap in the lane of a process that is restarted in the same tick, as a share of the width of a tick. */
const GAP = 0.3;
/** The distance between two numbers of ticks. */
const NUMBERS = 34;
/** The fates of a report with their colours, from the bottom of a bar to its top. */
const FATES = { received: "link", delayed: "range", damaged: "fault", lost: "fault" };
const PROCESS = new Set(["late", "down", "back"]);

export class Sequence {
  /** `box` is the details element that opens the diagram; nothing is drawn while it is closed. */
  constructor(box, go, changed) {
    const canvas = box.querySelector("canvas");
    Object.assign(this, { box, canvas, changed, told: box.querySelector("p") });
    const tick = (event) => this.from + Math.floor((event.clientX - canvas.getBoundingClientRect().left - this.inset * unit()) / (this.wide * unit()));
    canvas.addEventListener("click", (event) => go(tick(event)));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * 0.0015));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const action = { "+": 1.6, "=": 1.6, "-": 1 / 1.6, 0: 0 }[event.key];
      if (event.ctrlKey || event.metaKey || event.altKey || action === undefined) return;
      event.preventDefault();
      event.stopPropagation(); // else the plane zooms as well
      this.zoom(action);
    });
    for (const button of box.querySelectorAll("button")) button.addEventListener("click", () => this.zoom(Number(button.value)));
    box.addEventListener("toggle", changed);
  }

  from = 0;
  inset = 60;
  /** The width of a tick, and that with which all ticks are visible. */
  wide = TICK;
  #least = TICK;

  /** Magnifies the time axis by `factor` around the current tick; 0 shows all ticks. */
  zoom(factor) {
    this.wide = Math.min(Math.max(this.wide * factor, this.#least), WIDEST);
    this.changed();
  }

  /** Draws the visible ticks, around the current one if they are not all. */
  draw(store, { tick, focus }) {
    if (!this.box.open) return;
    const { canvas } = this, robots = shown(store, focus);
    const style = getComputedStyle(document.documentElement), of = (name) => style.getPropertyValue(`--${name}`).trim();
    const scale = unit(), ratio = (window.devicePixelRatio || 1) * scale;
    const wide = canvas.clientWidth / scale, tall = TOP + LANE * (robots.length + 1);
    canvas.style.height = `${Math.round(tall * scale)}px`;
    canvas.width = Math.round(wide * ratio);
    canvas.height = Math.round(tall * ratio);
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.font = `11px ${of("font")}`;
    this.inset = 14 + Math.max(...["world", ...robots.map((robot) => robot.id)].map((name) => pen.measureText(name).width));
    const ticks = store.last - store.first + 1, room = wide - this.inset;
    this.#least = Math.min(room / Math.max(ticks, 1), TICK);
    this.wide = Math.max(this.wide, this.#least);
    const count = Math.max(Math.floor(room / this.wide + 1e-6), 1);
    this.from = Math.max(Math.min(tick - Math.floor(count / 2), store.last - count + 1), store.first);
    const to = Math.min(this.from + count - 1, store.last);
    const x = (k) => this.inset + (k - this.from + 0.5) * this.wide;
    const rows = new Map([[null, TOP + LANE / 2], ...robots.map((robot, i) => [robot.id, TOP + LANE * (i + 1.5)])]);
    const frame = { pen, store, of, rows, x, tick, to };
    pen.fillStyle = of("grid");
    pen.fillRect(x(tick) - Math.max(this.wide, 2) / 2, 0, Math.max(this.wide, 2), tall);
    for (const [id, y] of rows) {
      pen.fillStyle = of("faint");
      pen.fillText(id ?? "world", 4, y + 4);
    }
    pen.textAlign = "center";
    pen.beginPath();
    pen.rect(this.inset, 0, room, tall); // an arrow may begin before the first tick that is shown
    pen.clip();
    this.#lanes(frame);
    this.#numbers(frame);
    if (this.wide < NARROW) this.#bars(frame);
    else this.#arrows(frame);
    this.#processes(frame);
    const hidden = store.stage.robots.length - robots.length;
    const text = `Tick ${tick}. ${told(store, tick, rows).join(". ") || "No reports"}.${hidden ? ` ${plural(hidden, "robot")} not shown.` : ""}`;
    if (this.told.textContent !== text) {
      this.told.textContent = text;
      canvas.setAttribute("aria-label", text);
    }
  }

  /** Draws the lanes; the lane of a process has a gap from its end to its restart. */
  #lanes({ pen, store, of, rows, x, to }) {
    const half = this.wide / 2;
    for (const [id, y] of rows) {
      pen.strokeStyle = of(id === null ? "faint" : `robot-${store.stage.robots[store.places.get(id)].role}`);
      pen.lineWidth = 2;
      let begin = x(this.from) - half;
      for (let k = this.from; k <= to; k++) {
        const kinds = (store.scene(k)?.events ?? []).filter((event) => event.robot === id).map((event) => event.kind);
        const down = kinds.includes("down"), back = kinds.includes("back");
        if ((down || store.player(k, id)?.down) && begin !== null) {
          line(pen, begin, y, x(k) - (down ? GAP * this.wide : half), y);
          begin = null;
        }
        if (back) begin = x(k) + GAP * this.wide;
        else if (!down && begin === null && !store.player(k, id)?.down) begin = id === null ? null : x(k) - half;
      }
      if (begin !== null) line(pen, begin, y, x(to) + half, y);
    }
  }

  #numbers({ pen, store, of, x, tick, to }) {
    const raw = NUMBERS / this.wide, power = 10 ** Math.floor(Math.log10(Math.max(raw, 1)));
    const step = [1, 2, 5, 10].find((factor) => factor * power >= raw) * power;
    const wide = (k) => pen.measureText(String(k)).width;
    const at = (k) => Math.min(Math.max(x(k), this.inset + wide(k) / 2), x(to) + (this.wide - wide(k)) / 2);
    pen.fillStyle = of("faint");
    for (let k = Math.ceil(this.from / step) * step; k <= to; k += step) {
      if (Math.abs(at(k) - at(tick)) >= (wide(k) + wide(tick)) / 2 + 4) pen.fillText(String(k), at(k), 12);
    }
    if (!store.scene(tick)) return;
    pen.fillStyle = of("ink");
    pen.fillText(String(tick), at(tick), 12);
  }

  #arrows({ pen, store, of, rows, x, to }) {
    const side = 0.2 * this.wide;
    for (let k = this.from; k <= to; k++) {
      for (const passage of store.scene(k)?.passages ?? []) {
        const fate = fate_of(passage, k), start = rows.get(passage.sender), end = rows.get(passage.receiver);
        if (!fate || start === undefined || end === undefined) continue;
        arrow(pen, x(passage.tick) - side, start, x(fate === "lost" ? passage.tick : k) + side, end, fate, of);
      }
    }
  }

  /** Draws, on the lane of the receiver, how many reports had each fate; the highest bar has the most reports. */
  #bars({ pen, store, of, rows, x, to }) {
    const each = Math.max(Math.ceil(BAR / this.wide), 1), bins = new Map();
    for (let k = this.from; k <= to; k++) {
      for (const passage of store.scene(k)?.passages ?? []) {
        const fate = fate_of(passage, k);
        if (!fate || !rows.has(passage.receiver)) continue;
        const key = `${passage.receiver}/${Math.floor((k - this.from) / each)}`;
        const bin = bins.get(key) ?? { receiver: passage.receiver, place: Math.floor((k - this.from) / each), sum: 0 };
        bin[fate] = (bin[fate] ?? 0) + 1;
        bin.sum += 1;
        bins.set(key, bin);
      }
    }
    const most = Math.max(...[...bins.values()].map((bin) => bin.sum));
    const broad = Math.max(each * this.wide - 1, 1), end = x(to) + this.wide / 2;
    for (const bin of bins.values()) {
      const left = Math.min(this.inset + bin.place * each * this.wide, end - broad); // the last bin may have fewer ticks
      let y = rows.get(bin.receiver) - 2;
      for (const [fate, colour] of Object.entries(FATES)) {
        const high = (HIGH * (bin[fate] ?? 0)) / most;
        pen.fillStyle = of(colour);
        pen.fillRect(left, y - high, broad, high);
        y -= high;
      }
    }
  }

  /** Draws ends and restarts of processes, and missed deadlines. */
  #processes({ pen, store, of, rows, x, to }) {
    for (let k = this.from; k <= to; k++) {
      for (const { kind, robot } of store.scene(k)?.events ?? []) {
        const y = rows.get(robot);
        if (!PROCESS.has(kind) || y === undefined) continue;
        pen.fillStyle = of(kind === "back" ? "ink" : "fault");
        pen.fillText(kind === "back" ? "●" : SIGNS[kind], x(k) + { late: 0, down: -GAP, back: GAP }[kind] * this.wide, y + 4);
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

/** Returns the robots with a lane: all if they are few, else the chosen one and its peer. */
function shown(store, focus) {
  const { robots } = store.stage;
  if (robots.length <= MOST_LANES) return robots;
  const chosen = store.chosen(focus);
  return robots.filter((robot) => robot === chosen || robot.id === chosen.peer);
}

function fate_of({ what, tick }, now) {
  if (what === "heard") return tick < now ? "delayed" : "received";
  return what === "sent" ? null : what;
}

function line(pen, x, y, to_x, to_y) {
  pen.beginPath();
  pen.moveTo(x, y); pen.lineTo(to_x, to_y);
  pen.stroke();
}

/** Draws an arrow; a lost report ends half-way in a cross, a damaged one at its receiver, a delayed one is dashed. */
function arrow(pen, x, y, to_x, to_y, fate, of) {
  const bad = fate === "lost" || fate === "damaged";
  const part = fate === "lost" ? 0.5 : 0.88, end_x = x + part * (to_x - x), end_y = y + part * (to_y - y);
  pen.strokeStyle = of(bad ? "fault" : fate === "delayed" ? "range" : "link");
  pen.lineWidth = 1.5;
  pen.setLineDash(fate === "delayed" ? [4, 3] : []);
  line(pen, x, y, end_x, end_y);
  pen.setLineDash([]);
  if (bad) {
    line(pen, end_x - 3, end_y - 3, end_x + 3, end_y + 3);
    line(pen, end_x - 3, end_y + 3, end_x + 3, end_y - 3);
    return;
  }
  const angle = Math.atan2(to_y - y, to_x - x);
  for (const turn of [2.6, -2.6]) line(pen, end_x, end_y, end_x + 6 * Math.cos(angle + turn), end_y + 6 * Math.sin(angle + turn));
}

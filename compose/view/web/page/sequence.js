// The sequence diagram: a lane for the world and for each robot, time across, and the reports between them as arrows.

import { unit } from "./pen.js";
import { plural } from "./words.js";

const LANE = 30;
const TICK = 34;
const MOST_LANES = 6;
const TOP = 18;

export class Sequence {
  /** `box` is the details element that opens the diagram; nothing is drawn while it is closed. */
  constructor(box, canvas, go) {
    Object.assign(this, { box, canvas });
    canvas.addEventListener("click", (event) => {
      go(this.from + Math.floor((event.clientX - canvas.getBoundingClientRect().left - this.inset * unit()) / (TICK * unit())));
    });
  }

  from = 0;
  inset = 60;

  /** Draws the ticks around the current one. Only these are read, so the length of the mission does not matter. */
  draw(store, { tick, focus }) {
    if (!this.box.open) return;
    const { canvas } = this, robots = shown(store.stage.robots, focus);
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
    const count = Math.max(Math.floor((wide - this.inset) / TICK), 1);
    this.from = Math.max(Math.min(tick - Math.floor(count / 2), store.last - count + 1), store.first);
    const to = Math.min(this.from + count - 1, store.last);
    const x = (k) => this.inset + (k - this.from + 0.5) * TICK;
    const rows = new Map([[null, TOP + LANE / 2], ...robots.map((robot, i) => [robot.id, TOP + LANE * (i + 1.5)])]);
    pen.fillStyle = of("grid");
    pen.fillRect(x(tick) - TICK / 2, 0, TICK, tall);
    for (const [id, y] of rows) {
      pen.fillStyle = of("faint");
      pen.fillText(id ?? "world", 4, y + 4);
      pen.strokeStyle = of(id === null ? "faint" : `robot-${store.stage.robots[store.places.get(id)].role}`);
      pen.lineWidth = 2;
      for (let k = this.from; k <= to; k++) if (!store.player(k, id)?.down) line(pen, x(k) - TICK / 2, y, x(k) + TICK / 2, y);
    }
    pen.textAlign = "center";
    pen.beginPath();
    pen.rect(this.inset, 0, wide - this.inset, tall); // an arrow may begin before the first tick that is shown
    pen.clip();
    const told = [];
    for (let k = this.from; k <= to; k++) {
      const scene = store.scene(k);
      pen.fillStyle = of(k === tick ? "ink" : "faint");
      pen.fillText(String(k), x(k), 12);
      for (const passage of scene?.passages ?? []) {
        const fate = fate_of(passage, k), start = rows.get(passage.sender), end = rows.get(passage.receiver);
        if (!fate || start === undefined || end === undefined) continue;
        if (k === tick) told.push(`${passage.sender}'s report of tick ${passage.tick} to ${passage.receiver}: ${fate}`);
        arrow(pen, x(passage.tick) - 7, start, x(fate === "lost" ? passage.tick : k) + 7, end, fate, of);
      }
      for (const { kind, robot } of scene?.events ?? []) {
        const sign = { late: "◔", down: "⊘", back: "●" }[kind], y = rows.get(robot);
        if (!sign || y === undefined) continue;
        pen.fillStyle = of(kind === "back" ? "ink" : "fault");
        pen.fillText(sign, x(k), y + 4);
      }
    }
    const late = (store.scene(tick)?.events ?? []).filter(({ kind }) => ["late", "down", "back"].includes(kind)).map((event) => event.text);
    const hidden = store.stage.robots.length - robots.length;
    const text = `Tick ${tick}. ${[...told, ...late].join(". ") || "No reports"}.${hidden ? ` ${plural(hidden, "robot")} not shown.` : ""}`;
    if (canvas.getAttribute("aria-label") !== text) canvas.setAttribute("aria-label", text);
  }
}

/** Returns the robots with a lane: all if they are few, else the chosen one and its peer. */
function shown(robots, focus) {
  if (robots.length <= MOST_LANES) return robots;
  const chosen = robots.find((robot) => robot.id === focus) ?? robots[0];
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

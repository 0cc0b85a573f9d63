// The timeline: one band of phases per robot with the numbers of its hypotheses, contact shaded, and marks above for contacts, verdicts, and processes that end and return.

import { unit } from "./pen.js";
import { dragged, extent, fresh_pen, number_ticks, palette, resize } from "./strip.js";
import { SIGNS } from "./words.js";

const MARKED = Object.fromEntries(["contact", "claim", "inconsistent", "undecided", "down", "back"].map((kind) => [kind, SIGNS[kind]]));
const MOST_BANDS = 6;
const MOST_GROUP_BANDS = 16;
/** The height of the signs and of the hand below them, and the width of a sign, in pixels. */
const MARKS = 18;
const SIGN = 11;

export class Timeline {
  constructor(box, canvas, scrub, go) {
    Object.assign(this, { box, canvas, scrub });
    dragged(box, (event, began) => {
      const { left, width } = canvas.getBoundingClientRect(), inset = this.inset * unit();
      const share = (event.clientX - left - inset) / Math.max(width - inset - 6, 1);
      go(Math.round(Math.min(Math.max(share, 0), 1) * Math.max(this.last, 0)));
      if (event === began) scrub.focus({ preventScroll: true });
    }, ({ target }) => target !== scrub);
    scrub.addEventListener("input", () => go(Number(scrub.value)));
  }

  /** The kinds of events that have a sign; `several` if numbers of hypotheses are drawn. */
  get kinds() { return new Set([...this.marks.map(([, kind]) => kind), ...(this.counted ? ["several"] : [])]); }

  inset = 30;
  last = 0;

  stage(store) {
    this.store = store;
    this.last = Math.max(store.last, 0);
    this.#limit();
    this.read = 0;
    this.spans = new Map(store.stage.robots.map((robot) => [robot.id, []]));
    this.contacts = new Map(store.stage.robots.map((robot) => [robot.id, []]));
    this.counts = new Map(store.stage.robots.map((robot) => [robot.id, []]));
    this.marks = [];
    this.counted = false;
    this.#key = "";
  }

  /** Adds the scenes that have been loaded since the last call. */
  #read() {
    const { store } = this;
    for (; this.read < store.whole; this.read++) {
      const scene = store.scene(this.read);
      if (!scene) continue;
      for (const player of scene.players) {
        const spans = this.spans.get(player.robot);
        if (!spans) continue; // a robot that has just joined: `stage` is called again when the mission has been read again
        const phase = player.command?.phase ?? Math.abs(spans.at(-1)?.value ?? 1);
        lengthen(spans, this.read, player.down ? -phase : phase, store.grouped ? store.role(this.read, player.robot) : null);
        const count = player.held?.world.length || player.held?.local.length;
        if (count > 1) lengthen(this.counts.get(player.robot), this.read, count);
        if (player.contacts?.length && !store.estimated) lengthen(this.contacts.get(player.robot), this.read, 1);
      }
      for (const event of scene.events) if (event.kind in MARKED) this.marks.push([this.read, event.kind, event.robot]);
    }
  }

  /** Discards the data of `tick` and later, because it has changed. */
  forget(tick) {
    if (tick >= this.read) return;
    this.#key = "";
    for (const spans of [...this.spans.values(), ...this.contacts.values(), ...this.counts.values()]) {
      while (spans.length && spans.at(-1).from >= tick) spans.pop();
      if (spans.length) spans.at(-1).to = Math.min(spans.at(-1).to, tick - 1);
    }
    while (this.marks.length && this.marks.at(-1)[0] >= tick) this.marks.pop();
    this.read = tick;
  }

  draw({ tick, share, focus, moving }, activities) {
    const { store, canvas } = this;
    this.#read();
    this.last = Math.max(store.last, 0);
    const shown = store.few(focus, store.grouped ? MOST_GROUP_BANDS : MOST_BANDS);
    const of = palette(), size = extent(canvas), { wide, ratio } = size;
    const band = shown.length > 3 ? 9 : 14, tall = MARKS + shown.length * (band + 3) + 15;
    resize(canvas, size, tall);
    const now = Math.min(tick + (moving ? share : 0), this.last);
    const key = [store.name, store.revision, this.read, this.last, focus, wide, tall, ratio, of("paper"), shown.map(({ id }) => id)].join();
    if (key !== this.#key) this.#bands(this.#pen(ratio, of, shown), shown, band, wide, of, store);
    this.#key = key;
    const visible = fresh_pen(canvas, ratio, of);
    if (canvas.width && canvas.height) visible.drawImage(this.#drawn, 0, 0, canvas.width / ratio, canvas.height / ratio);
    this.#hand(visible, this.#x(now, wide), tall, of);
    this.#limit();
    if (this.scrub.value !== String(tick)) this.scrub.value = String(tick);
    const said = `tick ${tick} of ${this.last}. ${activities}`;
    if (this.scrub.getAttribute("aria-valuetext") !== said) this.scrub.setAttribute("aria-valuetext", said);
  }

  #key = "";
  #drawn = document.createElement("canvas");

  #x(k, wide) { return this.inset + (k / Math.max(this.last, 1)) * (wide - this.inset - 6); }

  /** Returns the pen of all but the hand, which stays the same while time passes. */
  #pen(ratio, of, shown) {
    Object.assign(this.#drawn, { width: this.canvas.width, height: this.canvas.height });
    const pen = fresh_pen(this.#drawn, ratio, of);
    this.inset = 12 + Math.max(...shown.map((robot) => pen.measureText(robot.id).width));
    return pen;
  }

  #bands(pen, shown, band, wide, of, store) {
    const x = (k) => this.#x(k, wide);
    this.counted = false;
    const ids = new Set(shown.map((robot) => robot.id));
    shown.forEach((robot, row) => {
      const y = MARKS + row * (band + 3);
      pen.fillStyle = of("faint");
      pen.textAlign = "left";
      pen.fillText(robot.id, 4, y + band - (band > 10 ? 3 : 1));
      pen.fillStyle = of("grid");
      pen.fillRect(x(0), y, x(this.last) - x(0), band);
      for (const { from, to, value, role } of this.spans.get(robot.id)) {
        const left = x(from), width = Math.max(x(Math.min(to + 1, this.last)) - left, 1.5);
        const phase = Math.abs(value), inner = { 1: 0.4, 2: 0.62, 3: 1 }[phase] * band;
        pen.fillStyle = pen.strokeStyle = of(`robot-${role ?? robot.role}`);
        if (value < 0) {
          pen.lineWidth = 1;
          pen.strokeRect(left + 0.5, y + (band - inner) / 2 + 0.5, Math.max(width - 1, 0.5), inner - 1);
        } else {
          pen.fillRect(left, y + (band - inner) / 2, width, inner);
        }
        if (value < 0 && width > 54 && band > 10) {
          pen.fillStyle = of("faint");
          pen.fillText("down", left + 5, y + band - 3.5);
        }
      }
      pen.fillStyle = of("shade");
      for (const { from, to } of this.contacts.get(robot.id)) pen.fillRect(x(from), y - 2, Math.max(x(Math.min(to + 1, this.last)) - x(from), 2), band + 4);
      pen.textAlign = "center";
      pen.lineWidth = 3;
      for (const { from, to, value } of band > 10 ? this.counts.get(robot.id) : []) {
        const text = String(value), left = x(from), room = x(Math.min(to + 1, this.last)) - left;
        if (room < pen.measureText(text).width + 2) continue;
        pen.strokeStyle = of("paper");
        pen.fillStyle = of("ink");
        this.counted = true;
        pen.strokeText(text, left + room / 2, y + band - 3);
        pen.fillText(text, left + room / 2, y + band - 3);
      }
    });
    this.#signs(pen, x, of, ids, wide);
    pen.fillStyle = of("faint");
    number_ticks(pen, 0, this.last, x, MARKS + shown.length * (band + 3) + 11, 70);
  }

  /** Draws the hand at the current time. */
  #hand(pen, now, tall, of) {
    pen.fillStyle = of("now");
    pen.fillRect(now - 4, MARKS - 2, 8, tall - MARKS - 13);
    pen.fillStyle = of("ink");
    pen.fillRect(now - 1, MARKS - 6, 2, tall - MARKS - 9);
    pen.beginPath();
    pen.moveTo(now - 5, MARKS - 7); pen.lineTo(now + 5, MARKS - 7); pen.lineTo(now, MARKS); pen.closePath();
    pen.fill();
  }

  /** Draws the signs of each tick side by side, the last first; those that have no room near their tick are left out. */
  #signs(pen, x, of, ids, wide) {
    const ticks = new Map();
    for (const [k, kind, robot] of this.marks) if (robot === null || ids.has(robot)) ticks.set(k, (ticks.get(k) ?? new Set()).add(kind));
    pen.textAlign = "left";
    let free = wide;
    for (const [k, kinds] of [...ticks].reverse()) {
      const room = SIGN * kinds.size, wanted = Math.min(x(k) - room / 2, wide - room), left = Math.min(wanted, free - room);
      if (left < wanted - SIGN) continue;
      [...kinds].forEach((kind, i) => {
        pen.fillStyle = ["contact", "claim", "back"].includes(kind) ? of("ink") : of("fault");
        pen.fillText(MARKED[kind], left + SIGN * i, 10);
      });
      free = left;
    }
  }

  /** Lets the slider move up to the last tick. */
  #limit() {
    if (this.scrub.max !== String(this.last)) this.scrub.max = String(this.last);
  }
}

function lengthen(spans, tick, value, role = null) {
  const latest = spans.at(-1);
  if (latest && latest.value === value && latest.role === role && latest.to === tick - 1) latest.to = tick;
  else spans.push({ from: tick, to: tick, value, role });
}

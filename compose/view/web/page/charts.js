// The charts: six strips with the numbers of a pair of robots over time. A click or a drag goes to a tick.

import * as data from "./data.js";
import { DASHED, unit } from "./pen.js";
import { dragged, extent, fresh_pen, number_ticks, palette, resize, rounded_up } from "./strip.js";
import { metres, probability } from "./words.js";

const TOP = 17;
const TALL = 46;
/** The height of a strip in a window lower than LOW. */
const FLAT = 34;
const LOW = 900;
const AXIS = 16;
const GAP = 26;
const LEFT = 54;
const RIGHT = 8;
const TWO_COLUMNS = 760;
const LEAST_M = 1e-4;
/** The shortest time between two readings while a mission runs, and, next, the time after which a failed one is repeated. */
const REFRESH_MS = 250;
const RETRY_MS = 2000;
/** The dashes of a line by role, so that two robots differ without colour. */
const DASHES = { a: [], b: DASHED };
/** The factors of the ends of scales. */
const STEPS = [1, 2, 3, 5, 10];
/** A strip: its title, its curves, its scale, the text of a value, and the sentence in place of no curves. */
const STRIPS = [
  {
    title: "hypotheses", curves: ["hypotheses"], text: String, none: "no estimates in these ticks",
    scale: ({ most }) => ({ low: 0, high: Math.max(most, 2), marks: [0, Math.max(most, 2)], plain: true }),
  },
  {
    title: "probability of the first", curves: ["probability"], text: (value) => (value === 1 ? "100 %" : probability(value)), none: "no estimates in these ticks",
    scale: () => ({ low: 0, high: 1, marks: [0, 0.5, 1], plain: true }),
  },
  {
    title: "error / 3 sigma", curves: ["position_error_m", "position_bound_m"], text: metres, band: "position_bound_m",
    none: "no estimated position in the world in these ticks", scale: decades,
  },
  {
    title: "ranges", curves: ["anchor_range_m", "mutual_range_m"], text: metres, none: "no ranges in these ticks",
    scale: ({ most }) => {
      const high = rounded_up(most || 1, STEPS);
      return { low: 0, high, marks: [0, high] };
    },
  },
  {
    title: "residuals of ranges to anchors", curves: ["anchor_residual_m"], text: metres, none: "no expected ranges in these ticks",
    scale: both_sides,
  },
  {
    title: "residuals of ranges between robots", curves: ["mutual_residual_m"], text: metres, none: "no expected ranges in these ticks",
    scale: both_sides,
  },
];
/** The curves that the two robots have in common. */
const MUTUAL = new Set(["mutual_range_m", "mutual_residual_m"]);

export class Charts {
  /** `box` is the details element that opens the charts; nothing is read or drawn while it is closed. */
  constructor(box, root, go, changed) {
    Object.assign(this, { box, root, changed });
    this.#summary = box.querySelector("summary");
    [this.canvas, this.cursor] = root.querySelectorAll("canvas");
    const x = ({ clientX }) => (clientX - this.cursor.getBoundingClientRect().left) / unit();
    dragged(this.cursor, (event, began) => go(Math.round(this.#tick(x(event), this.#column(x(began))))));
    box.addEventListener("toggle", changed);
  }

  tall = TALL;
  #columns = 1;
  #series = null;
  #key = "";
  #wanted = null;
  #reading = false;
  #failed = false;
  #read_ms = -Infinity;
  #pause_ms = REFRESH_MS;
  #drawn = "";
  #later = null;
  #summary;

  /** Discards what belongs to another mission. */
  stage(store) {
    this.store = store;
    this.#series = this.#wanted = null;
    this.#key = "";
  }

  /** The first and the last tick; never the same one. */
  get #span() { return [this.store.first, Math.max(this.store.last, this.store.first + 1)]; }

  /** Returns the inner width of a strip. */
  get #wide() { return this.wide / this.#columns - LEFT - RIGHT; }

  #column(x) { return Math.min(Math.max(Math.floor((x * this.#columns) / this.wide), 0), this.#columns - 1); }

  #tick(x, column) {
    const [from, to] = this.#span, share = (x - (column * this.wide) / this.#columns - LEFT) / this.#wide;
    return from + Math.min(Math.max(share, 0), 1) * (to - from);
  }

  #x(tick) {
    const [from, to] = this.#span;
    return LEFT + ((tick - from) / (to - from)) * this.#wide;
  }

  /** Draws the charts of `pair`, the curves only if they have changed, and the cursor. */
  draw(store, view, pair) {
    if (!this.box.open) return;
    const title = store.stage.robots.length > pair.length ? `Charts of ${pair.map((robot) => robot.id).join(" and ")}` : "Charts";
    if (this.#summary.textContent !== title) this.#summary.textContent = title;
    const robots = pair.filter((robot) => view.truth || !view.focus || robot.id === view.focus);
    this.#want(store, robots);
    const size = extent(this.canvas), of = palette();
    this.wide = size.wide;
    this.tall = window.innerHeight < LOW ? FLAT : TALL;
    this.#columns = this.wide >= TWO_COLUMNS ? 2 : 1;
    const rows = STRIPS.length / this.#columns, tall = rows * (TOP + this.tall) + (rows - 1) * (GAP - TOP) + AXIS;
    const look = [this.wide, this.tall, size.ratio, of("paper"), this.#span, view.truth, robots.map(({ id, role }) => id + role), this.#key, this.#failed].join();
    if (look !== this.#drawn) {
      this.#drawn = look;
      for (const canvas of [this.canvas, this.cursor]) resize(canvas, size, tall);
      this.#curves(fresh_pen(this.canvas, size.ratio, of), store, robots, view.truth, of);
    }
    this.#now(fresh_pen(this.cursor, size.ratio, of), store, view, robots, of);
  }

  /** Reads the series if it has changed; while a mission runs, at most once in #pause_ms. */
  #want(store, robots) {
    const ids = robots.map((robot) => robot.id), where = [store.name, ...ids].join("/");
    const key = `${where}/${store.last}/${store.revision}/${store.live}`;
    const recent = store.live && this.#wanted?.where === where && performance.now() - this.#read_ms < this.#pause_ms;
    if (recent) this.#again(this.#pause_ms);
    if (this.#reading || recent || key === this.#wanted?.key || store.last < 0) return;
    this.#wanted = { key, where };
    this.#reading = true;
    this.#read_ms = performance.now();
    data.series(store.name, ids).catch(() => null).then((series) => {
      this.#reading = false;
      this.#pause_ms = Math.max(REFRESH_MS, 10 * (performance.now() - this.#read_ms)); // a long mission takes the server longer
      this.#failed = !series;
      if (series && this.store === store) [this.#series, this.#key] = [series, key];
      if (this.#failed) this.#again(RETRY_MS);
      this.changed();
    });
  }

  /** Draws again after `ms`; a series that could not be read is read again. */
  #again(ms) {
    this.#later ??= setTimeout(() => {
      this.#later = null;
      if (this.#failed) this.#wanted = null;
      this.changed();
    }, ms);
  }

  /** Returns the curves of a strip as {robot, name, low, high}; the range between two robots only once. */
  #of(strip, robots, truth) {
    const found = [];
    for (const robot of robots) {
      const curves = this.#series?.robots.find((one) => one.robot === robot.id)?.curves ?? {};
      for (const name of strip.curves) {
        if (name === "position_error_m" && !truth) continue;
        if (MUTUAL.has(name) && found.some((one) => one.name === name)) continue;
        if (curves[name]) found.push({ robot, name, ...curves[name] });
      }
    }
    return found;
  }

  /** Yields each strip with its left end, its top and its curves. */
  * #strips(robots, truth) {
    for (const [place, strip] of STRIPS.entries()) {
      const column = place % this.#columns, row = Math.floor(place / this.#columns);
      yield { strip, left: (column * this.wide) / this.#columns, top: TOP + row * (this.tall + GAP), curves: this.#of(strip, robots, truth) };
    }
  }

  #curves(pen, store, robots, truth, of) {
    for (const { strip, left, top, curves } of this.#strips(robots, truth)) {
      pen.save();
      pen.translate(left, top);
      pen.fillStyle = of("faint");
      pen.textAlign = "left";
      pen.fillText(this.#title(strip, store, truth), LEFT, -5);
      pen.fillStyle = of("grid");
      pen.fillRect(LEFT, 0, this.#wide, this.tall);
      const values = curves.flatMap(({ low, high }) => [...low, ...high]).filter((value) => value !== null);
      if (values.length) this.#strip(pen, strip, curves, values, of);
      else {
        pen.fillStyle = of("ink");
        pen.textAlign = "center";
        const text = this.#series ? strip.none : this.#failed ? "the series cannot be read" : "reading ...";
        pen.fillText(text, LEFT + this.#wide / 2, this.tall / 2 + 4);
      }
      if (top + this.tall + GAP > (STRIPS.length / this.#columns) * (this.tall + GAP)) {
        pen.fillStyle = of("faint");
        number_ticks(pen, ...this.#span, (tick) => this.#x(tick), this.tall + 12, 60);
      }
      pen.restore();
    }
  }

  /** Returns the title of a strip, with what it cannot show. */
  #title({ title, band }, store, truth) {
    if (!band) return title;
    if (this.#series?.exact) return truth ? "error (exact sensors: no sigma)" : "exact sensors: no sigma";
    return truth ? title : store.has_truth ? "3 sigma" : "3 sigma (no ground truth)";
  }

  #strip(pen, strip, curves, values, of) {
    const scale = strip.scale({ least: Math.min(...values), most: Math.max(...values) });
    const along = scale.log ? (value) => Math.log10(Math.max(value, scale.low) / scale.low) / Math.log10(scale.high / scale.low)
      : (value) => (value - scale.low) / (scale.high - scale.low);
    const y = (value) => this.tall - 3 - along(value) * (this.tall - 6);
    pen.textAlign = "right";
    pen.fillStyle = of("faint");
    for (const mark of scale.marks) {
      const length = mark >= 1e3 ? `${mark / 1e3} km` : metres(mark).replace(/\.0+ /, " ");
      const label = !mark || scale.plain ? String(mark) : `${scale.log && mark === LEAST_M ? "≤ " : ""}${length}`;
      pen.fillText(label, LEFT - 4, y(mark) + (mark === scale.low ? 3 : 5));
    }
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, 0, this.#wide, this.tall);
    pen.clip();
    for (const { robot, name, low, high } of curves) {
      const hue = of(MUTUAL.has(name) ? "link" : `robot-${robot.role}`);
      pen.strokeStyle = pen.fillStyle = hue;
      if (name === strip.band) this.#band(pen, high, y);
      else this.#line(pen, low, high, y, MUTUAL.has(name) ? [] : DASHES[robot.role]);
    }
    pen.restore();
  }

  /** Fills the area below the maxima. */
  #band(pen, high, y) {
    pen.globalAlpha = 0.22;
    for (const [from, to] of runs(high)) {
      pen.beginPath();
      pen.moveTo(this.#middle(from) - 1, this.tall);
      for (let i = from; i <= to; i++) pen.lineTo(this.#middle(i), y(high[i]));
      pen.lineTo(this.#middle(to) + 1, y(high[to]));
      pen.lineTo(this.#middle(to) + 1, this.tall);
      pen.fill();
    }
    pen.globalAlpha = 1;
  }

  /** Draws a line through the middles of the bins, and in each bin one from its minimum to its maximum. */
  #line(pen, low, high, y, dashes) {
    pen.lineWidth = 1.5;
    for (const [from, to] of runs(low)) {
      if (from === to && low[from] === high[from]) {
        pen.beginPath();
        pen.arc(this.#middle(from), y(low[from]), 1.8, 0, 7);
        pen.fill();
        continue;
      }
      pen.setLineDash(dashes);
      pen.beginPath();
      for (let i = from; i <= to; i++) pen.lineTo(this.#middle(i), y((low[i] + high[i]) / 2));
      pen.stroke();
      pen.setLineDash([]);
      pen.beginPath();
      for (let i = from; i <= to; i++) {
        if (low[i] === high[i]) continue;
        pen.moveTo(this.#middle(i), y(low[i]));
        pen.lineTo(this.#middle(i), y(high[i]));
      }
      pen.stroke();
    }
  }

  #middle(bin) {
    const { first, last, step } = this.#series, begin = first + bin * step;
    return this.#x((begin + Math.min(begin + step - 1, last)) / 2);
  }

  /** Draws the cursor and the values of its bin above each strip. */
  #now(pen, store, { tick, truth }, robots, of) {
    const series = this.#series, bin = series ? Math.floor((tick - series.first) / series.step) : -1;
    const told = [];
    for (const { strip, left, top, curves } of this.#strips(robots, truth)) {
      pen.fillStyle = of("ink");
      const x = left + this.#x(tick);
      if (x >= left + LEFT - 1 && x <= left + LEFT + this.#wide + 1) pen.fillRect(x - 0.75, top - 2, 1.5, this.tall + 4);
      const values = curves.filter(({ low }) => (low[bin] ?? null) !== null).map((one) => ({ ...one, text: valued(strip, one, bin) }));
      pen.textAlign = "right";
      let end = left + LEFT + this.#wide;
      const least = left + LEFT + pen.measureText(this.#title(strip, store, truth)).width + 6;
      for (const { robot, name, text } of joined(values).toReversed()) {
        const width = pen.measureText(text).width;
        if (end - width < least) break; // a screen reader is told all values
        pen.fillStyle = of(MUTUAL.has(name) ? "link" : `robot-${robot.role}`);
        pen.fillText(text, end, top - 5);
        end -= width + 10;
      }
      if (values.length) told.push(`${strip.title}: ${values.map(({ robot, name, text }) => `${who(robot, name)} ${text}`).join(", ")}`);
    }
    const text = `Tick ${tick}. ${told.join(". ") || "No numbers"}.`;
    if (this.cursor.getAttribute("aria-label") !== text) this.cursor.setAttribute("aria-label", text);
  }
}

/** Returns the text of a curve in one bin: one value, or the minimum and the maximum. */
function valued({ text }, { low, high }, bin) {
  const [least, most] = [text(low[bin]), text(high[bin])];
  return least === most ? most : `${least} to ${most}`;
}

const who = (robot, name) => (MUTUAL.has(name) ? `${robot.id} to ${robot.peer ?? "the nearest"}` : name === "position_bound_m" ? `${robot.id} 3 sigma` : robot.id);

/** Returns the texts above a strip, with the error and 3 sigma of a robot in one. */
function joined(values) {
  const found = [];
  for (const one of values) {
    const before = found.at(-1);
    if (one.name !== "position_bound_m") found.push({ ...one, text: `${who(one.robot, one.name)} ${one.text}` });
    else if (before?.robot === one.robot) before.text = `${before.text} / ${one.text}`;
    else found.push({ ...one, text: `${one.robot.id} ${one.text}` });
  }
  return found;
}

/** Returns a scale with 0 in its middle. */
function both_sides({ least, most }) {
  const high = rounded_up(Math.max(-least, most, LEAST_M), STEPS);
  return { low: -high, high, marks: [-high, 0, high] };
}

/** Returns a logarithmic scale from a power of ten to another. */
function decades({ least, most }) {
  const high = 10 ** Math.ceil(Math.log10(Math.max(most, 10 * LEAST_M)));
  const low = Math.min(10 ** Math.floor(Math.log10(Math.max(least, LEAST_M))), high / 10);
  return { low, high, marks: [low, high], log: true };
}

/** Returns the stretches [from, to] of consecutive places with values. */
function runs(values) {
  const found = [];
  values.forEach((value, i) => {
    if (value === null) return;
    if (found.at(-1)?.[1] === i - 1) found.at(-1)[1] = i;
    else found.push([i, i]);
  });
  return found;
}

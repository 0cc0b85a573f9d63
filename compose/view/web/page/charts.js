// The charts: six strips with the numbers of a pair of robots over time. A click or a drag goes to a tick.

import * as data from "./data.js";
import { DASHED, unit } from "./pen.js";
import { metres, probability } from "./words.js";

const TOP = 17;
const TALL = 46;
/** The height of a strip in a window lower than LOW. */
const FLAT = 34;
const LOW = 900;
const AXIS = 16;
const GAP = 26;
const LEFT = 46;
const RIGHT = 8;
const TWO_COLUMNS = 760;
/** The smallest visible number of ticks. */
const FEWEST = 8;
const LEAST_M = 1e-4;
/** The shortest time between two readings while a mission runs, and, next, the time after which a failed one is repeated. */
const REFRESH_MS = 250;
const RETRY_MS = 2000;
/** The dashes of a line by role, so that two robots differ without colour. */
const DASHES = { a: [], b: DASHED };
/** A strip: its title, its curves, its scale, the text of a value, and the sentence in place of no curves. */
const STRIPS = [
  {
    title: "hypotheses", curves: ["hypotheses"], text: String, none: "no estimates in these ticks",
    scale: ({ most }) => ({ low: 0, high: Math.max(most, 2), marks: [0, Math.max(most, 2)] }),
  },
  {
    title: "probability of the first", curves: ["probability"], text: (value) => (value === 1 ? "100 %" : probability(value)), none: "no estimates in these ticks",
    scale: () => ({ low: 0, high: 1, marks: [0, 0.5, 1] }),
  },
  {
    title: "error / 3 sigma", curves: ["position_error_m", "position_bound_m"], text: metres, band: "position_bound_m",
    none: "no estimated position in the world in these ticks", scale: decades,
  },
  {
    title: "ranges", curves: ["anchor_range_m", "mutual_range_m"], text: metres, none: "no ranges in these ticks",
    scale: ({ most }) => {
      const high = [1, 2, 3, 5, 10].map((factor) => factor * 10 ** Math.floor(Math.log10(most || 1))).find((one) => one >= most);
      return { low: 0, high, marks: [0, high], unit: " m" };
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
    const x = (event) => (event.clientX - this.cursor.getBoundingClientRect().left) / unit();
    let held = null; // the column in which a drag has begun
    this.cursor.addEventListener("pointerdown", (event) => {
      held = this.#column(x(event));
      this.cursor.setPointerCapture(event.pointerId);
      go(Math.round(this.#tick(x(event), held)));
    });
    this.cursor.addEventListener("pointermove", (event) => { if (held !== null) go(Math.round(this.#tick(x(event), held))); });
    for (const name of ["pointerup", "pointercancel"]) this.cursor.addEventListener(name, () => { held = null; });
    this.cursor.addEventListener("wheel", (event) => {
      event.preventDefault();
      if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) this.#shift((event.deltaX || event.deltaY) * 0.001);
      else this.zoom(Math.exp(-event.deltaY * 0.0015), this.#tick(x(event), this.#column(x(event))));
    }, { passive: false });
    root.addEventListener("keydown", (event) => {
      const action = { "+": 1.6, "=": 1.6, "-": 1 / 1.6 }[event.key];
      if (event.ctrlKey || event.metaKey || event.altKey || !(action || event.key === "0")) return;
      event.preventDefault();
      event.stopPropagation(); // else the plane zooms as well
      if (action) this.zoom(action);
      else this.reset();
    });
    for (const button of root.querySelectorAll("button")) {
      button.addEventListener("click", () => (button.value ? this.zoom(Number(button.value)) : this.reset()));
    }
    box.addEventListener("toggle", changed);
  }

  /** The visible ticks, [from, to]; null for all. */
  span = null;
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
  #at = null;
  #later = null;
  #summary;

  /** Discards what belongs to another mission. */
  stage(store) {
    Object.assign(this, { store, span: null });
    this.#series = this.#wanted = null;
    this.#key = "";
  }

  reset() {
    this.span = null;
    this.changed();
  }

  /** Magnifies the time axis by `factor` around `tick`, or around the current tick. */
  zoom(factor, tick = this.#at) {
    if (!this.store) return;
    const [from, to] = this.#span, whole = this.#whole, wide = Math.max((to - from) / factor, FEWEST);
    const share = to > from ? Math.min(Math.max((tick - from) / (to - from), 0), 1) : 0.5;
    this.span = wide >= whole[1] - whole[0] ? null : within([tick - share * wide, tick + (1 - share) * wide], whole);
    this.changed();
  }

  #shift(share) {
    if (!this.span) return;
    const by = share * (this.span[1] - this.span[0]);
    this.span = within(this.span.map((tick) => tick + by), this.#whole);
    this.changed();
  }

  get #whole() { return [this.store.first, Math.max(this.store.last, this.store.first + 1)]; }
  get #span() { return this.span ?? this.#whole; }

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
    if (this.#at !== view.tick && this.span && (view.tick < this.span[0] || view.tick > this.span[1])) {
      const half = (this.span[1] - this.span[0]) / 2;
      this.span = within([view.tick - half, view.tick + half], this.#whole);
    }
    this.#at = view.tick;
    const title = store.stage.robots.length > pair.length ? `Charts of ${pair.map((robot) => robot.id).join(" and ")}` : "Charts";
    if (this.#summary.textContent !== title) this.#summary.textContent = title;
    const robots = pair.filter((robot) => view.truth || !view.focus || robot.id === view.focus);
    this.#want(store, robots);
    const scale = unit(), ratio = (window.devicePixelRatio || 1) * scale;
    this.wide = this.canvas.clientWidth / scale;
    this.tall = window.innerHeight < LOW ? FLAT : TALL;
    this.#columns = this.wide >= TWO_COLUMNS ? 2 : 1;
    const rows = STRIPS.length / this.#columns, tall = rows * (TOP + this.tall) + (rows - 1) * (GAP - TOP) + AXIS;
    const style = getComputedStyle(document.documentElement), of = (name) => style.getPropertyValue(`--${name}`).trim();
    const look = [this.wide, this.tall, ratio, of("paper"), this.#span, view.truth, robots.map(({ id, role }) => id + role), this.#key, this.#failed].join();
    if (look !== this.#drawn) {
      this.#drawn = look;
      for (const canvas of [this.canvas, this.cursor]) {
        canvas.style.height = `${Math.round(tall * scale)}px`;
        canvas.width = Math.round(this.wide * ratio);
        canvas.height = Math.round(tall * ratio);
      }
      this.#curves(this.#pen(this.canvas, ratio, tall, of), store, robots, view.truth, of);
    }
    this.#now(this.#pen(this.cursor, ratio, tall, of), store, view, robots, of);
  }

  #pen(canvas, ratio, tall, of) {
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, this.wide, tall);
    pen.font = `11px ${of("font")}`;
    return pen;
  }

  /** Reads the series of the visible ticks if they have changed; while a mission runs, at most once in #pause_ms. */
  #want(store, robots) {
    const [from, to] = this.span ? [Math.max(Math.floor(this.span[0]) - 1, store.first), Math.ceil(this.span[1]) + 1] : [store.first, store.last];
    const ids = robots.map((robot) => robot.id), where = [store.name, ...ids, from, this.span ? to : "last"].join("/");
    const key = `${where}/${store.last}/${store.revision}/${store.live}`;
    const recent = store.live && this.#wanted?.where === where && performance.now() - this.#read_ms < this.#pause_ms;
    if (recent) this.#again(this.#pause_ms);
    if (this.#reading || recent || key === this.#wanted?.key || store.last < 0) return;
    this.#wanted = { key, where };
    this.#reading = true;
    this.#read_ms = performance.now();
    data.series(store.name, ids, from, Math.min(to, store.last)).catch(() => null).then((series) => {
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
      const values = curves.flatMap(({ low, high }) => [...this.#visible(low), ...this.#visible(high)]);
      if (values.length) this.#strip(pen, strip, curves, values, of);
      else {
        pen.fillStyle = of("ink");
        pen.textAlign = "center";
        const text = this.#series ? strip.none : this.#failed ? "the series cannot be read" : "reading ...";
        pen.fillText(text, LEFT + this.#wide / 2, this.tall / 2 + 4);
      }
      if (top + this.tall + GAP > (STRIPS.length / this.#columns) * (this.tall + GAP)) this.#ticks(pen, of("faint"));
      pen.restore();
    }
  }

  /** Returns the title of a strip, with what it cannot show. */
  #title({ title, band }, store, truth) {
    if (!band) return title;
    if (this.#series?.exact) return truth ? "error (exact sensors: no sigma)" : "exact sensors: no sigma";
    return truth ? title : store.has_truth ? "3 sigma" : "3 sigma (no ground truth)";
  }

  /** Returns the values of the bins in the visible ticks. */
  #visible(values) {
    const { first, step } = this.#series, [from, to] = this.#span;
    return values.filter((value, i) => value !== null && first + (i + 1) * step > from && first + i * step <= to);
  }

  #strip(pen, strip, curves, values, of) {
    const scale = strip.scale({ least: Math.min(...values), most: Math.max(...values) });
    const along = scale.log ? (value) => Math.log10(Math.max(value, scale.low) / scale.low) / Math.log10(scale.high / scale.low)
      : (value) => (value - scale.low) / (scale.high - scale.low);
    const y = (value) => this.tall - 3 - along(value) * (this.tall - 6);
    pen.textAlign = "right";
    pen.fillStyle = of("faint");
    for (const mark of scale.marks) {
      const label = scale.log ? `${mark === LEAST_M ? "≤ " : ""}${mark >= 1e3 ? `${mark / 1e3} km` : metres(mark).replace(/\.0+ /, " ")}` : `${Number(mark.toPrecision(3))}${mark ? scale.unit ?? "" : ""}`;
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

  #ticks(pen, colour) {
    const [from, to] = this.#span, raw = ((to - from) * 60) / this.#wide, power = 10 ** Math.floor(Math.log10(Math.max(raw, 1)));
    const every = [1, 2, 5, 10].find((factor) => factor * power >= raw) * power;
    pen.fillStyle = colour;
    for (let k = Math.ceil(from / every) * every; k <= to; k += every) {
      const x = this.#x(k), end = LEFT + this.#wide;
      pen.textAlign = x < LEFT + 12 ? "left" : x > end - 12 ? "right" : "center";
      pen.fillText(String(k), x, this.tall + 12);
    }
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
  const size = Math.max(-least, most, LEAST_M), power = 10 ** Math.floor(Math.log10(size));
  const high = [1, 2, 3, 5, 10].map((factor) => factor * power).find((one) => one >= size);
  return { low: -high, high, marks: [-high, 0, high], unit: " m" };
}

/** Returns a logarithmic scale from a power of ten to another. */
function decades({ least, most }) {
  const high = 10 ** Math.ceil(Math.log10(Math.max(most, 10 * LEAST_M)));
  const low = Math.min(10 ** Math.floor(Math.log10(Math.max(least, LEAST_M))), high / 10);
  return { low, high, marks: [low, high], log: true };
}

/** Moves a span into the bounds, and keeps its width if it fits. */
function within([from, to], [first, last]) {
  const by = Math.max(first - from, 0) || Math.min(last - to, 0);
  return [Math.max(from + by, first), Math.min(to + by, last)];
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

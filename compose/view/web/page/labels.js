// The labels of the plane, placed so that none overlaps another.

const GAP = 2;
const LEAST_ALPHA = 0.9;
/** The opacity of the ground of a label, under which lines are pale, and how far it reaches around the text. */
export const GROUND_ALPHA = 0.65, AROUND = 2;
/** The distance of the points of a line of which labels keep clear, and half of its width, in pixels. */
const EVERY = 6, HALF = 4;
const MOST_PARTS = 60;
/** The rank of the names of robots. */
export const NAME = 2;
/** The widths of texts in pixels, by font and text, so that each is measured once. */
const widths = {};

export class Labels {
  /** Starts a picture of `width` x `height`; labels keep clear of `obstacles`, [left, top, right, bottom]. */
  constructor(pen, look, width, height, obstacles) {
    Object.assign(this, { pen, look, width, height, placed: [...obstacles], lines: [], asked: [] });
    /** The drawn labels as { text, box }. */
    this.drawn = [];
  }

  /**
   * Asks for a label at (x, y). A label is left out where there is no room for it; those of higher `rank` are placed first,
   * and names over lines rather than not at all.
   *
   * `align` is "left", "right" or "center"; `around` is the distance to what is labelled, for places on its other sides;
   * `others` are further positions [x, y].
   */
  put(text, x, y, colour, align, { font = this.look.font, rank = 0, around = 0, others = [] } = {}) {
    this.asked.push({ text, x, y, colour, align, font, rank, around, others, alpha: this.pen.globalAlpha });
  }

  /** Keeps labels clear of the line between two points. */
  avoid([x, y], [to_x, to_y]) {
    const parts = Math.min(Math.ceil(Math.hypot(to_x - x, to_y - y) / EVERY), MOST_PARTS);
    for (let k = 0; k <= parts; k++) {
      const at = [x + (k / Math.max(parts, 1)) * (to_x - x), y + (k / Math.max(parts, 1)) * (to_y - y)];
      this.lines.push([at[0] - HALF, at[1] - HALF, at[0] + HALF, at[1] + HALF]);
    }
  }

  draw() {
    const { pen } = this;
    for (const one of [...this.asked].sort((a, b) => b.rank - a.rank)) {
      pen.font = one.font;
      const wide = widths[one.font + one.text] ??= pen.measureText(one.text).width, tall = Number(/(\d+(\.\d+)?)px/.exec(one.font)[1]);
      const spots = [[one.x, one.y], ...one.others].flatMap(([x, y]) => this.#spots({ ...one, x, y }, tall));
      const places = spots.map(([x, y, align]) => ({ x, y, align, box: box_of(x, y, align, wide, tall) }));
      const spot = places.find(({ box }) => this.#free(box, this.placed) && this.#free(box, this.lines)) ?? (one.rank === NAME && places.find(({ box }) => this.#free(box, this.placed)));
      if (!spot) continue;
      this.placed.push(spot.box);
      this.drawn.push({ text: one.text, box: spot.box });
      const [left, top, right, bottom] = spot.box;
      pen.globalAlpha = GROUND_ALPHA;
      pen.fillStyle = this.look.paper;
      pen.fillRect(left - AROUND, top - AROUND, right - left + 2 * AROUND, bottom - top + 2 * AROUND);
      pen.globalAlpha = Math.max(one.alpha, LEAST_ALPHA);
      pen.textAlign = spot.align;
      pen.lineWidth = 3.5;
      pen.strokeStyle = this.look.paper;
      pen.strokeText(one.text, spot.x, spot.y);
      pen.fillStyle = one.colour;
      pen.fillText(one.text, spot.x, spot.y);
    }
    pen.globalAlpha = 1;
  }

  /** Returns places for a label: where it is asked for, then mirrored, then farther away. */
  #spots({ x, y, align, around, rank }, tall) {
    const other = { left: "right", right: "left", center: "center" }[align], beside = align === "left" ? -2 * around : 2 * around;
    const mirrored = align === "center" ? [x, y, align] : [x + beside, y, other];
    const spots = [[x, y, align], mirrored];
    for (let row = 1; row <= (rank ? 4 : 2); row++) {
      for (const dy of [row * (tall + GAP), -row * (tall + GAP)]) spots.push([x, y + dy, align], [mirrored[0], y + dy, other]);
    }
    return spots;
  }

  #free([left, top, right, bottom], taken) {
    if (left < 0 || top < 0 || right > this.width || bottom > this.height) return false;
    return taken.every(([l, t, r, b]) => right + GAP <= l || r + GAP <= left || bottom + GAP <= t || b + GAP <= top);
  }
}

function box_of(x, y, align, wide, tall) {
  const left = { left: x, center: x - wide / 2, right: x - wide }[align];
  return [left, y - 0.8 * tall, left + wide, y + 0.25 * tall];
}

// Drawing primitives for a canvas: colours, fonts, robot shapes and opacities.

import { TAU } from "./geometry.js";

/** The scale of drawings in CSS pixels per unit: 1, and more on very large screens. */
export const unit = () => Math.max(1, window.innerWidth / 2200);

/** Traces a robot: pointed for role a, round with a nose for role b, so that they differ without colour. */
export function shape(pen, role, x, y, heading, size) {
  const c = Math.cos(heading), s = -Math.sin(heading);
  const to = (ahead, left) => [x + size * (ahead * c + left * s), y + size * (ahead * s - left * c)];
  pen.beginPath();
  if (role === "a") {
    pen.moveTo(...to(1.25, 0)); pen.lineTo(...to(-0.85, 0.85)); pen.lineTo(...to(-0.4, 0)); pen.lineTo(...to(-0.85, -0.85));
  } else {
    const angle = Math.atan2(s, c);
    pen.arc(x, y, 0.82 * size, angle + 0.55, angle + TAU - 0.55);
    pen.lineTo(...to(1.4, 0));
  }
  pen.closePath();
}

/** Returns the opacity of a range, which fades until the next tick. */
export const fading = (share, moving) => (moving ? Math.max(0, 1 - 1.6 * share) : 1);

/** The two styles of broken lines in pixels: what is searched or unknown is dotted, what is planned or possible is dashed. */
export const DOTTED = [1.5, 5], DASHED = [7, 5];
/** The dashes of the outline of a robot. */
export const OUTLINED = [3, 2.2];

/** Strokes the path of `pen`. */
export function stroked(pen, colour, width, dash = []) {
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  if (dash.length) pen.setLineDash(dash);
  pen.stroke();
  if (dash.length) pen.setLineDash([]);
}

/** Draws a line through `points`, in pixels. */
export function line(pen, points, colour, width, dash = []) {
  pen.beginPath();
  for (const point of points) pen.lineTo(...point);
  stroked(pen, colour, width, dash);
}

/** Draws a full circle; all in pixels. */
export function dot(pen, [x, y], radius, colour) {
  pen.beginPath();
  pen.arc(x, y, radius, 0, TAU);
  pen.fillStyle = colour;
  pen.fill();
}

/** Draws a circle about a place of the plane; `radius` is in m, `width` and `dash` are in pixels. */
export function circle(plane, centre, radius, colour, width, dash = []) {
  plane.context.beginPath();
  plane.context.arc(...plane.at(centre), radius * plane.scale, 0, TAU);
  stroked(plane.context, colour, width, dash);
}

/** Draws the outline of a robot. */
export function outlined(pen, role, [x, y], heading, size, colour, width, dash = []) {
  shape(pen, role, x, y, heading, size);
  stroked(pen, colour, width, dash);
}

/** Draws a cross over a robot. */
export function cross(pen, x, y, size, look) {
  const r = 0.7 * size;
  pen.beginPath();
  for (const side of [-r, r]) { pen.moveTo(x - r, y - side); pen.lineTo(x + r, y + side); }
  stroked(pen, look.fault, 2);
}

export class Look {
  #pale = {};

  /** `of` returns the value of a colour or of the font by its name. */
  constructor(of) {
    this.of = of;
    for (const name of ["ink", "paper", "faint", "grid", "disc", "ring", "orbit", "ghost", "cloud", "range", "link", "fault", "now"]) {
      this[name] = of(name);
    }
    this.robot = { a: of("robot-a"), b: of("robot-b") };
    this.tints = [1, 2, 3, 4, 5, 6].map((i) => of(`tint-${i}`));
    const family = of("font");
    const size = 12.5;
    this.font = `${size}px ${family}`;
    this.bold = `600 ${size + 2.5}px ${family}`;
  }

  /** Returns the colour `#rrggbb` with an opacity of `percent` on the paper. */
  pale(colour, percent) {
    const part = (hex, at) => parseInt(hex.slice(at, at + 2), 16), mixed = (at) => part(this.paper, at) + (percent / 100) * (part(colour, at) - part(this.paper, at));
    return this.#pale[colour + percent] ??= `rgb(${[1, 3, 5].map((at) => Math.round(mixed(at)))})`;
  }

  /** Returns the colour of a configuration by its number from 0. */
  tint(number) { return this.tints[number] ?? this.ghost; }
}

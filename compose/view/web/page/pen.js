// Drawing primitives for a canvas: colours, fonts, robot shapes and labels.

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

/** Draws a cross over a robot. */
export function cross(pen, x, y, size, look) {
  const r = 0.7 * size;
  pen.strokeStyle = look.fault;
  pen.lineWidth = 2;
  pen.beginPath();
  pen.moveTo(x - r, y - r); pen.lineTo(x + r, y + r); pen.moveTo(x + r, y - r); pen.lineTo(x - r, y + r);
  pen.stroke();
}

export function label(pen, text, x, y, colour, align, look, font = look.font) {
  pen.font = font;
  pen.textAlign = align;
  pen.lineWidth = 3.5;
  pen.strokeStyle = look.paper;
  pen.strokeText(text, x, y);
  pen.fillStyle = colour;
  pen.fillText(text, x, y);
}

export class Look {
  constructor(style) {
    const of = (name) => style.getPropertyValue(`--${name}`).trim();
    for (const name of ["ink", "paper", "faint", "grid", "disc", "ring", "orbit", "ghost", "cloud", "range", "link", "fault"]) {
      this[name] = of(name);
    }
    this.robot = { a: of("robot-a"), b: of("robot-b") };
    const family = of("font");
    const size = 12.5;
    this.font = `${size}px ${family}`;
    this.bold = `600 ${size + 2.5}px ${family}`;
  }
}

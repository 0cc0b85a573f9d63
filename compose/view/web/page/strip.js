// The parts that drawings share: canvases, the colours of the page, round numbers, and the pointer.

import { unit } from "./pen.js";

let present = null;
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { present = null; });

/** Returns a function that returns the present value of a colour or of the font of the page, by its name; the same one while these stay. */
export const palette = () => present ??= values();

function values() {
  const style = getComputedStyle(document.documentElement), known = {};
  return (name) => known[name] ??= style.getPropertyValue(`--${name}`).trim();
}

/** Returns the width of a canvas in units of drawings, and the number of its pixels per unit. */
export const extent = (canvas) => ({ wide: canvas.clientWidth / unit(), ratio: (window.devicePixelRatio || 1) * unit() });

/** Gives a canvas the height `tall`, in units of drawings. */
export function resize(canvas, { wide, ratio }, tall) {
  const height = `${Math.round(tall * unit())}px`, size = { width: Math.round(wide * ratio), height: Math.round(tall * ratio) };
  if (canvas.style.height !== height) canvas.style.height = height;
  for (const [name, pixels] of Object.entries(size)) if (canvas[name] !== pixels) canvas[name] = pixels;
}

/** Clears a canvas, and returns its pen. */
export function fresh_pen(canvas, ratio, of) {
  const pen = canvas.getContext("2d");
  pen.setTransform(1, 0, 0, 1, 0, 0);
  pen.clearRect(0, 0, canvas.width, canvas.height);
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.font = `11px ${of("font")}`;
  return pen;
}

/** Returns the least round number from `value` on: a power of ten times one of `factors`. */
export function rounded_up(value, factors = [1, 2, 5, 10]) {
  const power = 10 ** Math.floor(Math.log10(value));
  return factors.find((factor) => factor * power >= value) * power;
}

/** Writes numbers of ticks from `first` to `last` at the places that `x` returns, at least `apart` from each other. */
export function number_ticks(pen, first, last, x, y, apart) {
  const left = x(first), right = x(last), every = Math.max(rounded_up(((last - first) * apart) / Math.max(right - left, 1)), 1);
  for (let k = Math.ceil(first / every) * every; k <= last; k += every) {
    pen.textAlign = x(k) < left + 12 ? "left" : x(k) > right - 12 ? "right" : "center";
    pen.fillText(String(k), x(k), y);
  }
}

/** Calls `to` with each event of a pointer that drags on `element`, and with the first event of the drag, which `takes` may refuse. */
export function dragged(element, to, takes = () => true) {
  let began = null;
  element.addEventListener("pointerdown", (event) => {
    if (!takes(event)) return;
    began = event;
    element.setPointerCapture(event.pointerId);
    to(event, began);
  });
  element.addEventListener("pointermove", (event) => { if (began) to(event, began); });
  for (const name of ["pointerup", "pointercancel"]) element.addEventListener(name, () => { began = null; });
}

// The address of the page: #show=…&tick=46&robot=a&select=hypothesis.a.0&view=4.2_-1_38.5&truth=0.

import { read } from "./selection.js";

/** Returns what the address asks for; `tick` is null if it names none. */
export function address_state() {
  const fields = new URLSearchParams(location.hash.slice(1));
  const tick = fields.get("tick");
  return {
    show: fields.get("show"),
    tick: tick !== null && /^\d+$/.test(tick) ? Number(tick) : null,
    robot: fields.get("robot"),
    selected: read(fields.get("select")),
    /** The centre in m and the scale in pixels per m; null if the address has none. */
    view: view_of(fields.get("view")),
    truth: fields.get("truth") !== "0",
  };
}

function view_of(text) {
  const numbers = (text ?? "").split("_").map(Number);
  return text && numbers.length === 3 && numbers.every(Number.isFinite) && numbers[2] > 0 ? numbers : null;
}

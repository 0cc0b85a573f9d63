// The help and the legend.

import { make } from "./cards.js";
import { KEYS, MEANINGS } from "./words.js";

/** Fills the lists of keys and symbols, and the legend. */
export function fill_help(keys, signs, legend) {
  keys.append(...KEYS.flatMap(([key, action]) => [make("dt", {}, make("kbd", { textContent: key })), make("dd", { textContent: action })]));
  signs.append(...MEANINGS.map(([sign, meaning]) => make("li", {}, make("b", { textContent: sign }), `: ${meaning}`)));
  for (const role of ["a", "b"]) {
    const item = make("li", { textContent: `role ${role}` });
    item.dataset.role = role;
    legend.append(item);
  }
  for (const phase of [1, 2, 3]) {
    const item = make("li", { textContent: `phase ${phase}` });
    item.dataset.phase = phase;
    legend.append(item);
  }
  const outlined = make("li", { textContent: "outlined: a possible pose" });
  outlined.dataset.sign = "outlined";
  legend.append(outlined);
}

// The help.

import { make } from "./cards.js";
import { KEYS, MEANINGS } from "./words.js";

/** Fills the lists of keys and symbols. */
export function fill_help(keys, signs) {
  keys.append(...KEYS.flatMap(([key, action]) => [make("dt", {}, make("kbd", { textContent: key })), make("dd", { textContent: action })]));
  signs.append(...MEANINGS.map(([sign, meaning]) => make("li", {}, make("b", { textContent: sign }), `: ${meaning}`)));
}

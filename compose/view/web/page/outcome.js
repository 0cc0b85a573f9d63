// The outcome of a mission in a list, with a sign of its own.

import { make } from "./cards.js";

export const SIGNS = { localised: "★", undecided: "?", inconsistent: "≠", wrong: "✕", failed: "!" };

/** Returns the state of a mission, with a sign if it has an outcome. */
export function outcome_chip(outcome, state) {
  const chip = make("span", { className: "chip outcome", textContent: `${SIGNS[outcome] ? `${SIGNS[outcome]} ` : ""}${state}` });
  if (outcome) chip.dataset.result = outcome;
  return chip;
}

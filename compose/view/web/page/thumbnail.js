// The parts of a list of missions: a thumbnail of the paths, and the outcome with a sign of its own.

import { make } from "./cards.js";

export const SIGNS = { localised: "★", undecided: "?", inconsistent: "≠", wrong: "✕", failed: "!" };

/** Returns the picture of a mission's paths. */
export function thumbnail(name) {
  style();
  return make("img", { className: "thumbnail", src: `/api/shows/${encodeURIComponent(name)}/thumbnail`, alt: "", loading: "lazy", width: 160, height: 100 });
}

/** Returns the state of a mission, with a sign if it has an outcome. */
export function outcome_chip(outcome, state) {
  const chip = make("span", { className: "chip outcome", textContent: `${SIGNS[outcome] ? `${SIGNS[outcome]} ` : ""}${state}` });
  if (outcome) chip.dataset.result = outcome;
  return chip;
}

/** Adds the style of lists and sweeps, once. */
export function style() {
  if (!document.getElementById("sweep-style")) document.head.append(make("link", { id: "sweep-style", rel: "stylesheet", href: "/page/sweep.css" }));
}

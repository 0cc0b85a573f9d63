// The list of missions, if the server has several, and the state of a mission in a few words.

import { make } from "./cards.js";
import { plural } from "./words.js";

const SIGNS = { localised: "★", undecided: "?", inconsistent: "≠", wrong: "✕", failed: "!" };

/** Fills `root` with the missions of a server's list. */
export function list_missions(root, { shows, network }) {
  root.hidden = false;
  const where = network.map(({ endpoint, reached }) => `${endpoint}${reached ? "" : " (no router yet)"}`);
  root.replaceChildren(
    ...(where.length ? [make("p", { className: "note", textContent: `Listening on ${where.join(", ")}.` })] : []),
    make("ul", {}, ...shows.map((one) => {
      const link = make("a", { href: `#show=${encodeURIComponent(one.name)}` },
        make("b", { textContent: one.name }), " ",
        ...(one.title !== one.name ? [make("span", { textContent: one.title }), " "] : []),
        make("span", { textContent: plural(one.robots, "robot") }), " ",
        outcome_chip(one.end?.outcome, state_of(one.live, one.last, one.end)));
      return make("li", {}, link);
    })),
  );
}

/** Returns the outcome of a mission, or how far it is. */
export function state_of(live, last, end) {
  if (end) return `${end.outcome} after ${end.tick} ticks`;
  if (live) return `● running, tick ${Math.max(last, 0)}`;
  return `incomplete, ends at tick ${last}`;
}

/** Returns the state of a mission, with a sign if it has an outcome. */
function outcome_chip(outcome, state) {
  const chip = make("span", { className: "chip outcome", textContent: `${SIGNS[outcome] ? `${SIGNS[outcome]} ` : ""}${state}` });
  if (outcome) chip.dataset.result = outcome;
  return chip;
}

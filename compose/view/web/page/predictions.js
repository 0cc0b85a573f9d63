// The distances that the configurations of a pair predict, as a list over the plane: they are crossed out as they are
// ruled out.

import { make } from "./cards.js";
import { predicted, shown } from "./configurations.js";
import { joined } from "./tints.js";
import { metres } from "./words.js";

const MOST = 8;

export class Predictions {
  constructor(root, plane) {
    this.root = root;
    this.plane = plane;
    this.key = "";
  }

  /** Shows those of `pair`, a robot of role a and its peer. */
  draw(view, store, pair) {
    const found = pair.length === 2 ? this.#found({ ...view, truth: view.truth, store }, pair.find(({ role }) => role === "a") ?? pair[0]) : null;
    const key = JSON.stringify(found);
    if (key === this.key) return;
    this.key = key;
    this.root.hidden = !found;
    if (!found) return;
    const items = found.all.slice(0, MOST).map(({ tint, at, out }) => {
      const item = make("li", { className: out ? "out" : "", textContent: `${tint + 1}: ${at}` });
      item.style.setProperty("--tint", `var(--tint-${tint + 1}, var(--ghost))`);
      return item;
    });
    const measured = found.measured ? [make("li", { className: "measured", textContent: `measured ${found.measured}` })] : [];
    const value = found.least ? [make("li", { className: "value", textContent: `nearest two differ by ${found.least}` })] : [];
    this.root.replaceChildren(make("li", { className: "title", textContent: found.title }), ...items, ...measured, ...value);
  }

  #found(view, robot) {
    const { store, tick, eliminated } = view, { tints } = this.plane, now = joined(store.scene(tick), robot?.id);
    if (!robot || (view.focus && !view.truth)) return null;
    const listed = (all) => all.map(({ tint, predicted: length, out }) => ({ tint, at: metres(length), out })).sort((a, b) => a.tint - b.tint);
    if (eliminated < 1) {
      const { all, measured } = shown(view, robot, tints);
      if (all.length > 1 && measured !== null) return { title: "predicted", all: listed(all), measured: metres(measured) };
    }
    if (!now || now.count < 2 || !view.planned) return null;
    const all = predicted(store, tick, robot, tints);
    const lengths = all.map((one) => one.predicted).sort((a, b) => a - b);
    const least = now.manoeuvre && metres(Math.min(...lengths.slice(1).map((length, i) => length - lengths[i])));
    return all.length ? { title: "predicted", all: listed(all), least } : null;
  }
}

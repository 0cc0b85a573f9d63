// The distances that the configurations of a pair predict, as a list over the plane: they are crossed out as they are
// ruled out.

import { make } from "./cards.js";
import { predicted, shown } from "./configurations.js";
import { joined } from "./tints.js";
import { metres, number, turning } from "./words.js";

const MOST = 8;
/** The width and height of the strip in pixels. */
const WIDE = 110, TALL = 30;

/** Returns J of the last manoeuvre, and J over its turn rates as a picture with a mark at the chosen one. */
function strip({ reachable, separation_m2 }, omega) {
  const [low, high] = [reachable[0].omega, reachable.at(-1).omega], most = Math.max(separation_m2, ...reachable.map((one) => one.separation_m2));
  const at = (turn, value) => `${(2 + ((WIDE - 4) * (turn - low)) / (high - low || 1)).toFixed(1)} ${(TALL - 3 - ((TALL - 7) * value) / (most || 1)).toFixed(1)}`;
  const [x, y] = at(omega, separation_m2).split(" "), said = `J over the turn rate from ${number(low, 1)} to ${number(high, 1)} rad/s; chosen: ${turning(omega)}, ${separation_m2.toPrecision(3)} m²`;
  return `J over turn rate: ${separation_m2.toPrecision(3)}\u00a0m² at ${turning(omega)} <svg viewBox="0 0 ${WIDE} ${TALL}" width="${WIDE}" height="${TALL}" role="img" aria-label="${said}"><title>${said}</title><path d="M${reachable.map((one) => at(one.omega, one.separation_m2)).join("L")}" fill="none" stroke="var(--faint)" stroke-width="1.5"/>`
    + `<path d="M${x} ${TALL - 2}V${y}" stroke="var(--ink)"/><circle cx="${x}" cy="${y}" r="3" fill="var(--ink)"/></svg>`;
}

export class Predictions {
  constructor(root, plane) {
    Object.assign(this, { root, plane, key: "" });
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
    const picture = make("li", { className: "strip" });
    if (found.strip) picture.innerHTML = found.strip;
    const value = found.least ? [make("li", { className: "value", textContent: `nearest two differ by ${found.least}` })] : [];
    this.root.replaceChildren(make("li", { className: "title", textContent: found.title }), ...items, ...measured, ...value, ...(found.strip ? [picture] : []));
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
    const drawn = now.manoeuvre?.reachable.length > 1 && strip(now.manoeuvre, store.player(tick, now.manoeuvre.robot).command.omega);
    return all.length ? { title: "predicted", all: listed(all), least, strip: drawn } : null;
  }
}

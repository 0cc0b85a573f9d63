// The tints of the configurations of a pair: a configuration keeps its tint while it is possible.

import { distance, step } from "./geometry.js";

const NEAR = 0.2; // of the sensing range, from where a configuration was driven to where it is in the next tick
const MOST_TICKS = 400;

/** The configurations of a pair in a scene, if its robots hold the same ones. */
export function joined(scene, robot) {
  if (!scene?.configurations) return undefined;
  if (!pairs.has(scene)) pairs.set(scene, new Map(scene.configurations.toReversed().flatMap((one) => one.robots.map((id) => [id, one]))));
  return pairs.get(scene).get(robot);
}
const pairs = new WeakMap();

export class Tints {
  #known = new Map();

  forget() { this.#known.clear(); }

  /** Returns the tint of each configuration of the pair of `robot` in `tick`, as numbers from 0; empty if there are none. */
  of(store, tick, robot) {
    const pair = joined(store.scene(tick), robot);
    if (!pair) return [];
    const key = `${pair.robots[0]}/${tick}`, known = this.#known.get(key);
    if (known) return known;
    let from = tick;
    while (from > store.first && tick - from < MOST_TICKS && joined(store.scene(from - 1), robot)) {
      from -= 1;
      if (this.#known.has(`${pair.robots[0]}/${from}`)) break;
    }
    for (let k = from; k <= tick; k++) {
      const at = `${pair.robots[0]}/${k}`;
      if (!this.#known.has(at)) this.#known.set(at, this.#next(store, k, pair.robots));
    }
    const found = this.#known.get(key);
    if (store.whole <= tick) this.forget(); // an earlier scene may still be missing
    return found;
  }

  #next(store, tick, robots) {
    const now = poses_of(store, tick, robots), before = this.#known.get(`${robots[0]}/${tick - 1}`);
    if (!before) return now.map((_, i) => i);
    const { period, sensing_range } = store.stage.mission;
    const driven = robots.map((robot) => store.player(tick, robot)?.executed ?? [0, 0]);
    const ahead = poses_of(store, tick - 1, robots).map((pair) => pair.map((pose, r) => step(pose, ...driven[r], period)));
    const near = [];
    ahead.forEach((one, i) => now.forEach((other, j) => {
      const off = Math.max(distance(one[0], other[0]), distance(one[1], other[1]));
      if (off < NEAR * sensing_range) near.push([off, i, j]);
    }));
    const tints = now.map(() => null), used = new Set();
    for (const [, i, j] of near.sort((a, b) => a[0] - b[0])) {
      if (tints[j] === null && !used.has(i)) { tints[j] = before[i]; used.add(i); }
    }
    let fresh = 0;
    return tints.map((tint) => {
      if (tint !== null) return tint;
      while (before.includes(fresh) || tints.includes(fresh)) fresh += 1;
      return fresh++;
    });
  }
}

/** Returns the poses of the pair in each configuration. */
export function poses_of(store, tick, robots) {
  const [a, b] = robots.map((robot) => store.player(tick, robot).held.world);
  return a.map((pose, i) => [pose, b[i]]);
}

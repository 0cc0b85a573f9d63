// The hypotheses of a robot, interpolated between two ticks.

import { between, compose, distance, frame_of, wrap } from "./geometry.js";

/** The largest distance (a fraction of the sensing range) and angle (rad) of a driven pose to its successor. */
const NEAR = 0.05, TURNED = 0.5;

/** True if the first pose is the only one, or more probable than all others together. */
export const leads = ({ world, local, probability }) => (world.length || local.length) === 1 || probability[0] > 0.5;

/** The least probability of the first pose relative to the anchor from which on the others do not count. */
const SURE = 0.99;
/** True if a robot knows its path, but neither its bearing from the anchor nor, so, its place in the world. */
export const lacks_bearing = ({ world, local, probability }) => (
  !world.length && local.length > 0 && (probability[0] ?? 1 / local.length) > SURE
);

/** Returns the robot's hypotheses on the plane and the first one's covariance; null without an estimate. */
export function held_now({ store, scene, truth, tick, share, moving }, robot) {
  const held = scene.players[store.places.get(robot.id)]?.held;
  if (!held) return null;
  const frame = frame_of(robot, truth);
  const poses = placed(held, frame);
  if (!moving || share <= 0) return { poses, covariance: held.covariance };
  const next = store.player(tick + 1, robot.id), { period, sensing_range } = store.stage.mission;
  if (!next?.executed) return { poses, covariance: held.covariance };
  const goals = next.held && (next.held.world.length > 0) === (held.world.length > 0) ? placed(next.held, frame) : [];
  if (followed.get(held)?.next !== next) followed.set(held, { next, pairs: matched(poses, goals, next.executed, period, NEAR * sensing_range) });
  const { pairs } = followed.get(held);
  return {
    poses: poses.map((pose, i) => {
      const driven = between(pose, null, next.executed, share, period);
      return pairs[i] === null ? driven : between(pose, goals[pairs[i]], next.executed, share, period);
    }),
    covariance: pairs[0] === 0 ? mixed(held.covariance, next.held.covariance, share) : held.covariance,
  };
}

/** The successors of the hypotheses of a tick in the `next` one. */
const followed = new WeakMap();

const placed = (held, frame) => (held.world.length ? held.world : held.local.map((local) => compose(frame, local)));

const mixed = (one, other, share) => (one && other ? one.map((value, i) => value + share * (other[i] - value)) : one);

/** Returns for each of `poses` the index of its successor in `goals`, or null if it has none. */
function matched(poses, goals, driven, period, near) {
  const free = new Set(goals.keys());
  return poses.map((pose) => {
    const ahead = between(pose, null, driven, 1, period);
    let found = null, least = near;
    for (const i of free) {
      const off = distance(ahead, goals[i]);
      if (off <= least && Math.abs(wrap(ahead[2] - goals[i][2])) <= TURNED) { found = i; least = off; }
    }
    free.delete(found);
    return found;
  });
}

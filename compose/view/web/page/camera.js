// The camera of guided play: the whole pair during the search, and all that counts from the encounter on.

import { crossing, mirrored } from "./construction.js";
import { compose, distance, frame_of } from "./geometry.js";

const AROUND = 0.25; // of the sensing range, around each pose

/** Returns the true pose of a player and the one that it reports, as far as there are such. */
export const true_and_reported = (player) => [player?.pose, player?.reported?.pose].filter(Boolean);

/**
 * Returns the discs [position, radius] of the scenario: the anchors of `robots` with their ranges and orbits.
 *
 * With a robot that has no anchor, these are also the corners of the area in which it is. In a team, they are those of
 * all anchors; without any, those around the starts of the robots, or around the origin if these are unknown.
 */
export function scenario_discs(robots, store) {
  const { mission: { sensing_range }, sweep, anchors, team } = store.stage;
  if (team) {
    const known = anchors.map((one) => store.anchor_at(one, true)).filter(Boolean);
    const starts = known.length ? [] : store.stage.robots.map(({ id }) => store.player(store.first, id)?.pose).filter(Boolean);
    const discs = [...known, ...starts].map((at) => [at, (store.estimated ? 0.3 : known.length ? 1 : 0.6) * sensing_range]);
    return discs.length ? discs : [[[0, 0], sensing_range * Math.sqrt(store.stage.robots.length)]];
  }
  const anchored = robots.filter(({ anchor }) => anchor), discs = anchored.map(({ anchor, orbit }) => [anchor, Math.max(sensing_range, orbit[0])]);
  if (anchored.length < robots.length) discs.push([[sweep[0], sweep[1]], 0], [[sweep[2], sweep[3]], 0]);
  return discs;
}

/**
 * Returns the discs that the story needs in view in this tick.
 *
 * In a group, they are the robots that the captions tell of when they meet or claim, else all; in a team, all with their hypotheses. While a robot has two mirror images relative to its anchor, these are what they follow from. From the encounter on, these are the robots and all poses that they consider possible, now and in the next tick, and
 * those that are being ruled out. Once the pair has finished, these are all pairs.
 */
export function story_discs({ store, tick, focus, truth, eliminated, turned, told }, pair) {
  const { robots, mission: { sensing_range } } = store.stage;
  if (store.grouped && !focus) {
    if (store.stage.team) {
      const players = robots.map(({ id }) => store.player(tick, id)), poses = players.flatMap((player) => [...(truth ? true_and_reported(player) : []), ...(player?.held?.world ?? [])]);
      return [...scenario_discs(robots, store).map(([at]) => at), ...poses].map((at) => [at, AROUND * sensing_range]);
    }
    const met = told.filter(({ kind }) => ["contact", "claim"].includes(kind)).flatMap((one) => one.robots).flatMap((id) => true_and_reported(store.player(tick, id)));
    return met.length ? met.map((pose) => [pose, sensing_range]) : scenario_discs(robots, store);
  }
  const finished = pair.every((robot) => store.player(tick - 1, robot.id)?.command?.verdict);
  if (finished && truth && robots.length > pair.length) return scenario_discs(robots, store);
  const shown = truth || !focus ? pair : pair.filter((robot) => robot.id === focus);
  const discs = scenario_discs(shown, store);
  for (const robot of shown) {
    const found = mirrored(store, tick, robot, truth);
    if (found) return found.ranges.map(([, range]) => [robot.anchor, 1.2 * range]);
  }
  if (!pair.some((robot) => store.phase(tick, robot.id) === 3)) return discs;
  const poses = [];
  for (const robot of shown) {
    const ticks = [tick, tick + 1, ...(eliminated < 1 ? [tick - 1] : [])];
    const players = ticks.map((k) => store.player(k, robot.id));
    if (truth) poses.push(...players.flatMap(true_and_reported));
    for (const player of players) poses.push(...(player?.held?.world ?? []));
    const held = store.player(tick, robot.id)?.held;
    if (!truth && held && !held.world.length) poses.push(...held.local.map((local) => compose(frame_of(robot, truth), local)));
  }
  const found = truth && turned !== null && turned < 1 ? crossing(store, tick, pair.find(({ role }) => role === "a") ?? pair[0]) : null;
  if (found) return [found.circle, ...found.places.map((place) => [found.anchor, distance(place, found.anchor)])];
  return poses.length ? poses.map((pose) => [pose, AROUND * sensing_range]) : discs;
}

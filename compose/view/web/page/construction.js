// Why exact distances leave several hypotheses: the mirror images of phase 1, and the crossings of an encounter.

import { compose, distance, frame_of, step, TAU, wrap } from "./geometry.js";
import { circle, DASHED, dot, DOTTED, line } from "./pen.js";
import { joined, poses_of } from "./tints.js";
import { metres } from "./words.js";

/** The length of the mirror axis on each side of the anchor, in radii of the largest circle. */
const AXIS = 1.15;
/** The angle in rad by which a path that is turned passes the pose of a hypothesis while it is marked. */
const PASSING = 0.12;

const reflected = ([x, y], [ax, ay], [bx, by]) => {
  const along = ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / ((bx - ax) ** 2 + (by - ay) ** 2);
  return [2 * (ax + along * (bx - ax)) - x, 2 * (ay + along * (by - ay)) - y];
};

/**
 * Returns the ticks, ranges to the anchor and poses of a robot that has two mirror images relative to its anchor or has
 * just lost one, as { ranges: [[tick, range], ...], ways: [[pose, ...], ...] }, the last tick first; else null.
 */
export function mirrored(store, tick, robot, truth) {
  const doubtful = (held) => held?.local.length === 2 && !held.world.length && !held.probability.length;
  const [now, before] = [tick, tick - 1].map((k) => store.player(k, robot.id)), { period } = store.stage.mission;
  const ruled_out = now?.held?.local.length === 1 && !now.held.world.length && doubtful(before?.held);
  if (!robot.anchor || !(doubtful(now?.held) || ruled_out)) return null;
  const frame = frame_of(robot, truth), driven = now.executed ?? [0, 0], ranges = [];
  const ways = (ruled_out ? before : now).held.local.map((local) => [ruled_out ? step(compose(frame, local), ...driven, period) : compose(frame, local)]);
  for (let k = tick; k >= store.first; k--) {
    const player = store.player(k, robot.id);
    if (player?.anchor_range !== undefined) ranges.push([k, player.anchor_range]);
    if (k === store.first || !player?.executed) break;
    const [v, omega] = player.executed;
    for (const way of ways) way.push(step(way.at(-1), -v, -omega, period));
  }
  return ranges.length > 1 ? { ranges, ways } : null;
}

/**
 * Returns what two distances of a robot that drives to one that stands leave: the driven straight, the two places of the
 * one that stands relative to it, both anchors and the turns about the driver's anchor that fit; null in other ticks.
 */
export function crossing(store, tick, robot) {
  if (!joined(store.scene(tick), robot.id) || joined(store.scene(tick - 1), robot.id)) return null;
  const pair = [robot.id, robot.peer], robots = pair.map((id) => store.stage.robots[store.places.get(id)]);
  if (robots.some((one) => !one?.anchor)) return null;
  const [now, before] = [tick, tick - 1].map((k) => store.player(k, robot.id)?.contacts?.[0]?.[1]);
  const driven = pair.map((id) => store.player(tick, id)?.executed ?? [0, 0]), mover = driven.findIndex(([v]) => v !== 0);
  const all = poses_of(store, tick, pair), held = store.player(tick, robot.id)?.held;
  if (!now || !before || mover < 0 || all.length < 2 || held?.probability.length || driven[1 - mover].some((one) => one !== 0)) return null;
  const [v, omega] = driven[mover], end = all[0][mover], start = step(end, -v, -omega, store.stage.mission.period), other = all[0][1 - mover];
  const turns = all.map((poses) => { const turn = wrap(poses[mover][2] - end[2]); return turn < -1e-9 ? turn + TAU : turn; });
  return {
    path: [start, end], distances: [before, now], places: [other, reflected(other, start, end)], turns,
    anchor: robots[mover].anchor, circle: [robots[1 - mover].anchor, distance(other, robots[1 - mover].anchor)],
  };
}

export class Construction {
  constructor(plane) { this.plane = plane; }

  /** Draws the circles of the distances to the anchor, both ways that fit them, and the axis between these. */
  mirror({ store, tick, truth, look }, robot) {
    const found = mirrored(store, tick, robot, truth), pen = this.plane.context;
    if (!found) return;
    const [x, y] = robot.anchor, largest = Math.max(...found.ranges.map(([, range]) => range));
    for (const [k, range] of found.ranges) {
      circle(this.plane, robot.anchor, range, look.ghost, 2, DOTTED);
      if (k !== tick) this.plane.labels.put(metres(range), ...this.plane.at([x, y - range]), look.ghost, "center");
    }
    const start = found.ways[0].find((pose, i) => distance(pose, found.ways[1][i]) < 1e-6);
    if (start) {
      const reach = (AXIS * largest) / Math.max(distance(start, [x, y]), 1e-9), end = (sign) => this.plane.at([x + sign * reach * (start[0] - x), y + sign * reach * (start[1] - y)]);
      line(pen, [end(-1), end(1)], look.faint, 1, DASHED);
    }
    for (const way of found.ways) line(pen, way.map((pose) => this.plane.at(pose)), look.ghost, 1.6);
    for (const mark of ["places", "way", ...(start ? ["axis"] : [])]) this.plane.marks.add(mark);
    pen.globalAlpha = 1;
  }

  /**
   * Draws the path of the robot that drove, turned about its anchor by the part `turned` of a whole turn, and where the other can
   * stand. Returns whether the i-th hypothesis has been passed.
   */
  crossings({ store, tick, truth, look, turned }, robot) {
    const found = turned === null || !truth ? null : crossing(store, tick, robot), pen = this.plane.context;
    if (!found) return () => true;
    const angle = turned * TAU, about = ([x, y]) => compose([...found.anchor, angle], [x - found.anchor[0], y - found.anchor[1], 0]);
    this.plane.marks.add("crossing");
    circle(this.plane, ...found.circle, look.ghost, 2, DOTTED);
    for (const place of found.places) circle(this.plane, found.anchor, distance(place, found.anchor), look.ghost, 1, DASHED);
    if (turned < 1) {
      const path = found.path.map(about), met = found.turns.some((turn) => Math.abs(wrap(turn - angle)) < PASSING);
      found.distances.forEach((range, i) => circle(this.plane, path[i], range, met ? look.ink : look.link, met ? 2 : 1.2));
      line(pen, [found.anchor, ...path].map((one) => this.plane.at(one)), look.ink, 1.6);
      for (const place of found.places.map(about)) dot(pen, this.plane.at(place), 4.5, look.ink);
    }
    pen.globalAlpha = 1;
    return (i) => turned >= 1 || found.turns[i] <= turned * TAU;
  }
}

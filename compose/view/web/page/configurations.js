// The configurations of a pair: each in its tint, joined by a line, with the distance that it predicts as a circle
// around the robot that drives, and the manoeuvres between which that robot has chosen.

import { between, compose, distance, step } from "./geometry.js";
import { held_now } from "./held.js";
import { circle, DASHED, line } from "./pen.js";
import { joined, poses_of } from "./tints.js";

const MOST = 12; // configurations that are drawn
/** The angle in rad from the number of a configuration on its circle to that of the next one. */
const NEXT_NUMBER = 0.35;
const BENDS = 16, HEAD_PX = 12;
const THICK = 6; // the width in pixels of the reachable arc where J is largest
const HALO = 3; // the width in pixels of the ground on each side of the arc and the arrow

/**
 * Returns the configurations to show, of the pair of `robot` of role a.
 *
 * While a range rules some out, these are those of the tick before, after the drive: they are crossed out in the order
 * of the distances that they predict, the most wrong first.
 */
export function shown(view, robot, tints) {
  const { store, tick, eliminated } = view, pair = [robot.id, robot.peer], scene = store.scene(tick);
  const now = joined(scene, robot.id), before = joined(store.scene(tick - 1), robot.id);
  const measured = store.player(tick, robot.id)?.contacts?.[0]?.[1] ?? null;
  const left = tints.of(store, tick, robot.id);
  const none = pair.every((id) => !store.player(tick, id)?.held?.world.length);
  if (before && (now || none) && eliminated < 1 && before.count > (now?.count ?? 0)) {
    const had = tints.of(store, tick - 1, robot.id), { period } = store.stage.mission;
    const driven = pair.map((id) => store.player(tick, id)?.executed ?? [0, 0]);
    const all = poses_of(store, tick - 1, pair).map((poses, i) => {
      const [a, b] = poses.map((pose, r) => step(pose, ...driven[r], period));
      return { tint: had[i], a, b, predicted: distance(a, b), out: false };
    });
    const gone = all.filter(({ tint }) => !left.includes(tint));
    gone.sort((one, other) => Math.abs(other.predicted - measured) - Math.abs(one.predicted - measured));
    gone.forEach((one, i) => { one.out = eliminated >= (i + 1) / (gone.length + 1); });
    return { all, measured };
  }
  if (!now) return { all: [], measured };
  const robots = pair.map((id) => store.stage.robots[store.places.get(id)]);
  const [a, b] = robots.map((one) => held_now({ ...view, scene, truth: true }, one).poses);
  return { all: a.map((pose, i) => ({ tint: left[i], a: pose, b: b[i], predicted: distance(pose, b[i]), out: false })), measured };
}

/** Returns the distances that the configurations of `tick` predict for after the commands of that tick. */
export function predicted(store, tick, robot, tints) {
  const { period } = store.stage.mission, pair = [robot.id, robot.peer];
  const commands = pair.map((id) => store.player(tick, id)?.command);
  if (commands.some((command) => !command)) return [];
  return poses_of(store, tick, pair).map((poses, i) => {
    const [a, b] = poses.map((pose, r) => step(pose, commands[r].v, commands[r].omega, period));
    return { tint: tints.of(store, tick, robot.id)[i], predicted: distance(a, b), out: false };
  });
}

export class Configurations {
  constructor(plane) { this.plane = plane; }

  /** Draws the lines and circles of the pair of `robot` of role a. */
  draw(view, robot) {
    const { store, tick, look, truth, places, focus } = view, pen = this.plane.context;
    if (focus && !truth) return;
    const { all, measured } = shown(view, robot, this.plane.tints), live = all.slice(0, MOST);
    if (live.length < 2) return;
    this.plane.marks.add("configuration");
    for (const { tint, a, b, out } of live.filter((_, i) => view.passed.get(robot.id)?.(i) !== false)) {
      pen.globalAlpha = out ? 0.25 : 0.9;
      line(pen, [this.plane.at(a), this.plane.at(b)], look.tint(tint), 1.3);
    }
    const ruling = view.eliminated < 1 && measured !== null;
    const driving = view.moving && view.share > 0 && store.player(tick, robot.id)?.contacts?.length;
    if (ruling || driving) {
      const last = joined(store.scene(ruling ? tick - 1 : tick), robot.id)?.manoeuvre;
      const mover = last?.robot ?? robot.peer, of_a = mover === robot.id; // b if both drive
      if (ruling && truth && places.get(mover)) {
        this.plane.marks.add("measured");
        pen.globalAlpha = 0.2;
        circle(this.plane, places.get(mover), measured, look.ink, 9);
      }
      live.forEach((one, i) => {
        const centre = truth ? places.get(mover) : of_a ? one.a : one.b, still = of_a ? one.b : one.a;
        const opposite = truth ? places.get(of_a ? robot.peer : robot.id) ?? still : still;
        if (!centre) return;
        this.plane.marks.add("predicted");
        // Numbers are on the far side of the circles: near the other robot are its name and its poses.
        const away = Math.atan2(opposite[1] - centre[1], centre[0] - opposite[0]);
        const colour = look.tint(one.tint), angle = away + (i - (live.length - 1) / 2) * NEXT_NUMBER;
        pen.globalAlpha = one.out ? 0.2 : 0.9;
        circle(this.plane, centre, one.predicted, colour, 1.6, DASHED);
        const [x, y] = this.plane.at(centre), radius = one.predicted * this.plane.scale;
        if (one.out) return;
        pen.globalAlpha = 1;
        this.plane.labels.put(String(one.tint + 1), x + radius * Math.cos(angle), y + radius * Math.sin(angle) + 4, colour, "center");
      });
    }
    pen.globalAlpha = 1;
  }

  /** Draws an arrow along poses of a robot that drives with the speed `v`; `halo` is the width of its ground. */
  #arrow(way, v, colour, halo = 0) {
    const pen = this.plane.context, [x, y] = this.plane.at(way.at(-1)), course = way.at(-1)[2] + (v < 0 ? Math.PI : 0);
    const back = (angle) => [x - HEAD_PX * Math.cos(course + angle), y + HEAD_PX * Math.sin(course + angle)];
    line(pen, way.map((pose) => this.plane.at(pose)), colour, 2.4 + 2 * halo);
    pen.fillStyle = colour;
    pen.beginPath();
    pen.moveTo(x, y); pen.lineTo(...back(0.45)); pen.lineTo(...back(-0.45)); pen.closePath();
    pen.fill();
    pen.lineWidth = 2 * halo;
    if (halo) pen.stroke();
  }

  /**
   * Draws the last manoeuvre of the pair of `robot` of role a, above all configurations, until its distance has ruled configurations
   * out: where the robot can be after it, the wider the larger J, and an arrow to where it will be.
   */
  manoeuvre(view, robot) {
    const { store, tick, truth, focus, eliminated } = view, at = eliminated < 1 ? tick - 1 : tick;
    const found = joined(store.scene(at), robot.id)?.manoeuvre;
    if (!found || !view.planned || (focus && !truth) || shown(view, robot, this.plane.tints).all.length < 2) return;
    for (const mark of ["reachable", "choice"]) this.plane.marks.add(mark);
    const player = store.player(at, found.robot), poses = poses_of(store, at, [robot.id, robot.peer]).slice(0, MOST);
    const starts = truth && player.pose ? [player.pose] : poses.map(([a, b]) => (found.robot === robot.id ? a : b));
    for (const start of starts) this.#arc(view, found, player.command, start);
  }

  #arc({ store, look, eliminated }, { reachable, separation_m2 }, command, start) {
    const pen = this.plane.context, { period } = store.stage.mission, most = Math.max(separation_m2, 1e-9);
    const ends = reachable.map(({ x, y }) => this.plane.at(compose(start, [x, y, 0])));
    const way = [...Array(BENDS + 1).keys()].map((k) => between(start, null, [command.v, command.omega], k / BENDS, period));
    // Once its range is measured, the label of that range counts more.
    if (eliminated >= 1) for (let i = 2; i < ends.length; i += 2) this.plane.labels.avoid(ends[i - 2], ends[i]);
    pen.globalAlpha = 1;
    for (const [colour, halo] of [[look.paper, HALO], [look.faint, 0]]) {
      for (let i = 1; i < ends.length; i++) line(pen, ends.slice(i - 1, i + 1), colour, 0.8 + THICK * Math.min(reachable[i].separation_m2 / most, 1) + halo);
    }
    this.#arrow(way, command.v, look.paper, 0.5 * HALO);
    this.#arrow(way, command.v, look.ink);
  }
}

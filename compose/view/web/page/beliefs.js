// The poses that robots consider possible, and those that they have just ruled out.

import { shown } from "./configurations.js";
import { between, compose, distance, ellipse, frame_of, step, TAU } from "./geometry.js";
import { held_now, lacks_bearing } from "./held.js";
import { NAME } from "./labels.js";
import { circle, cross, dot, DOTTED, fading, OUTLINED, outlined, shape, stroked } from "./pen.js";
import { metres, probability } from "./words.js";

const FADING = 3;
const SIGMAS = 3;
const LEGIBLE = 2.5;

export class Beliefs {
  constructor(plane) { this.plane = plane; }

  belief(view, robot) {
    const { store, scene, truth, look, size, tick } = view;
    const player = scene.players[store.places.get(robot.id)], held = player?.held;
    if (!held) return this.#somewhere(view, robot, player);
    if (this.#eliminating(view, robot)) return undefined;
    const pen = this.plane.context, { poses, covariance } = held_now(view, robot), { labels } = this.plane;
    const tints = this.plane.tints.of(store, tick, robot.id);
    if (!poses.length) return this.#somewhere(view, robot, player);
    this.#ruled_out(view, robot);
    if (!held.world.length && !truth) this.#around(look, robot, distance(poses[0], robot.anchor), 0.5, 2, "bearing unknown");
    // At the true bearing, which the robot does not know, the outline of its only pose would say that it does.
    const bearing_unknown = truth && lacks_bearing(held);
    if (!bearing_unknown) this.plane.marks.add(tints.length ? "configuration" : "pose");
    poses.slice(0, 60).forEach((pose, place) => {
      if (view.passed.get(robot.id)?.(place) === false) return;
      const chance = held.probability[place] ?? 1 / poses.length;
      const [x, y] = this.plane.at(pose);
      pen.globalAlpha = tints.length ? 0.55 + 0.45 * Math.sqrt(chance) : 0.3 + 0.7 * Math.sqrt(chance);
      if (place === 0 && held.arc) this.#arc(pose, held, look);
      else if (place === 0 && covariance && held.world.length) this.#ellipse(pose, covariance, look);
      const grown = truth ? size * 1.45 : size * 1.15;
      this.plane.targets.push({ kind: "hypothesis", robot: robot.id, place, at: [x, y], radius: grown });
      if (bearing_unknown) return;
      if (!truth && poses.length === 1) {
        shape(pen, robot.role, x, y, pose[2], grown);
        pen.fillStyle = player.down ? look.paper : look.robot[robot.role];
        pen.fill();
      }
      if (!truth || (tints.length && size > 6)) labels.placed.push([x - size, y - size, x + size, y + size]);
      const colour = tints.length ? look.tint(tints[place]) : look.ghost;
      outlined(pen, robot.role, [x, y], pose[2], grown, colour, tints.length ? 2.6 : 2);
      const many = held.probability.length > 1 && chance > 0.01;
      const parts = [...(tints.length > 1 ? [String(tints[place] + 1)] : []), ...(many ? [probability(chance)] : [])];
      if (parts.length && place < 6 && size > 6) labels.put(parts.join(": "), x - grown - 4, y + grown + 8, colour, "right", { around: grown + 4 });
      if (!truth && place === 0 && player.down) cross(pen, x, y, grown, look);
      if (!truth && place === 0) {
        const name = player.down ? `${robot.id} is down` : robot.id;
        labels.put(name, x + grown + 3, y - grown, look.ink, "left", { font: look.bold, rank: NAME, around: grown + 3 });
      }
    });
    pen.globalAlpha = 1;
    return undefined;
  }

  /** Draws where a robot estimates the anchors that are not surveyed, with three sigmas: one robot's, as all share their ranges. */
  anchors(view, robots) {
    const { store, scene, look, truth } = view, pen = this.plane.context, { labels, marks, scale } = this.plane;
    const held = robots.map(({ id }) => scene.players[store.places.get(id)]?.held).find((one) => one?.anchors);
    for (const [id, position, sigma] of held?.anchors ?? []) {
      const [x, y] = this.plane.at(position), radius = SIGMAS * sigma * scale;
      if (SIGMAS * sigma > store.stage.mission.sensing_range) continue; // it is hardly anywhere
      marks.add("estimated");
      pen.beginPath();
      pen.arc(x, y, Math.max(radius, 3), 0, TAU);
      this.#cloud(look);
      dot(pen, [x, y], 2.5, look.ghost);
      if (truth) continue; // it has a name where it stands
      const text = `${id} ± ${metres(sigma)}`, away = Math.max(radius, 5), side = away + 4 + pen.measureText(text).width / 2;
      labels.put(text, x, y + away + 13, look.ink, "center", { others: [[x, y - away - 5], [x + side, y + 4], [x - side, y + 4]] });
    }
  }

  /** Draws the configurations while a range rules some out, one by one; returns whether it does. */
  #eliminating(view, robot) {
    if (view.eliminated >= 1) return false;
    const { look, size, store } = view, pen = this.plane.context;
    const of_a = robot.role === "a" ? robot : store.stage.robots.find(({ id }) => id === robot.peer);
    if (!of_a) return false;
    const { all } = shown(view, of_a, this.plane.tints), grown = 1.45 * size;
    if (all.length < 2) return false;
    for (const { tint, out, [robot.role]: pose } of all) {
      const [x, y] = this.plane.at(pose), colour = look.tint(tint);
      pen.globalAlpha = out ? 0.5 : 1;
      outlined(pen, robot.role, [x, y], pose[2], grown, colour, 2.6);
      this.plane.marks.add(out ? "ruled-out" : "configuration");
      if (out) cross(pen, x, y, size, look);
      if (out && size > 6) this.plane.labels.placed.push([x - grown, y - grown, x + grown, y + grown]);
      if (!out && size > 6) this.plane.labels.put(String(tint + 1), x - grown - 4, y + grown + 8, colour, "right", { around: grown + 4 });
    }
    pen.globalAlpha = 1;
    return true;
  }

  /** Draws the circle on which the robot is, or its anchor's sensing range, before it has a pose. */
  #somewhere({ look, truth, store, moving, share }, robot, player) {
    if (!player || !robot.anchor || (truth && player.anchor_range === undefined)) return;
    const range = player.anchor_range ?? store.stage.mission.sensing_range;
    this.#around(look, robot, range, truth ? fading(share, moving) : 1, 3, truth ? "" : "position unknown"); // the true robot leaves the circle
  }

  /** Draws the circle of possible positions of a robot at a distance of its anchor. */
  #around(look, robot, radius, alpha, width, unknown) {
    this.plane.marks.add("places");
    const pen = this.plane.context, [x, y] = this.plane.at(robot.anchor);
    pen.globalAlpha = alpha;
    circle(this.plane, robot.anchor, radius, look.ghost, width, DOTTED);
    pen.globalAlpha = 1;
    if (unknown) this.plane.labels.put(`${robot.id}: ${unknown}`, x, y - radius * this.plane.scale - 6, look.ghost, "center");
  }

  /** Draws the poses ruled out in the last FADING ticks, propagated by odometry to the current tick. */
  #ruled_out(view, robot) {
    const { store, truth, look, size, tick, share, moving } = view;
    const pen = this.plane.context, period = store.stage.mission.period;
    let poses = null;
    for (let age = 1; age <= FADING && tick - age >= 0; age++) {
      const held = store.player(tick - age, robot.id)?.held;
      const later = store.player(tick - age + 1, robot.id)?.held;
      if (!held || !later || held.world.length + held.local.length < 2) continue;
      const frame = frame_of(robot, truth), in_world = held.world.length > 0;
      if (in_world !== later.world.length > 0) continue;
      const had = in_world ? held.world : held.local.map((local) => compose(frame, local));
      const has = in_world ? later.world : later.local.map((local) => compose(frame, local));
      if (has.length >= had.length) continue;
      poses ??= held_now({ ...view, moving: false }, robot).poses;
      for (let pose of had.slice(0, 60)) {
        for (let k = tick - age + 1; k <= tick; k++) {
          const driven = store.player(k, robot.id)?.executed;
          if (driven) pose = step(pose, driven[0], driven[1], period);
          if (k === tick - age + 1 && has.some((one) => distance(one, pose) < 0.15)) { pose = null; break; }
        }
        if (!pose || poses.some((one) => distance(one, pose) < 0.15)) continue;
        if (moving) pose = between(pose, null, store.player(tick + 1, robot.id)?.executed, share, period);
        const [x, y] = this.plane.at(pose);
        pen.globalAlpha = 0.75 / age;
        outlined(pen, robot.role, [x, y], pose[2], size * 1.3, look.ghost, 1.4, OUTLINED);
        cross(pen, x, y, size, look);
        this.plane.marks.add("ruled-out");
        if (size > 6) this.plane.labels.placed.push([x - size, y - size, x + size, y + size]);
      }
      pen.globalAlpha = 1;
    }
  }

  #ellipse(pose, covariance, look) {
    const { major, minor, turn } = ellipse(covariance, SIGMAS), pen = this.plane.context;
    if (major * this.plane.scale < LEGIBLE) return;
    this.plane.marks.add("ellipse");
    const [x, y] = this.plane.at(pose);
    pen.beginPath();
    pen.ellipse(x, y, major * this.plane.scale, Math.max(minor * this.plane.scale, 0.5), -turn, 0, TAU);
    this.#cloud(look);
  }

  /** Draws where the robot may be if that is along an arc; between two ticks, the arc moves with its `pose`. */
  #arc(pose, { arc, world: [start] }, look) {
    this.plane.marks.add("arc");
    this.plane.context.beginPath();
    for (const [x, y] of arc) this.plane.context.lineTo(...this.plane.at([x + pose[0] - start[0], y + pose[1] - start[1]]));
    this.plane.context.closePath();
    this.#cloud(look);
  }

  #cloud(look) {
    const pen = this.plane.context;
    pen.fillStyle = look.cloud;
    pen.fill();
    stroked(pen, look.ghost, 1.5);
  }
}

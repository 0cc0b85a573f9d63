// Drawings of measured ranges, contacts and reports.

import { distance } from "./geometry.js";
import { held_now, leads } from "./held.js";
import { circle, cross, DASHED, dot, fading, line, OUTLINED, stroked } from "./pen.js";
import { metres } from "./words.js";

const MOST_ORIGINS = 6;
const LEGIBLE = 46; // the least length in pixels of a line that has its label in any case
const GLOW = 8; // the width in pixels of the line below a measurement, in the one colour of what is now
const BESIDE = 10; // the distance in pixels of a label from its line
/** The share of a tick after which the distance of its beginning has no label any more. */
const LABELLED = 0.2;

export class Signals {
  constructor(plane) { this.plane = plane; }

  /** Returns the hypotheses at the measurement: the leading one, or up to MOST_ORIGINS if none leads. */
  #origins(view, robot) {
    const held = view.scene.players[view.store.places.get(robot.id)]?.held;
    if (!held) return [];
    return held_now({ ...view, moving: false }, robot).poses.slice(0, leads(held) ? 1 : MOST_ORIGINS);
  }

  anchor_range(view, robot) {
    const { scene, store, share, moving } = view;
    const { anchor_range, anchors, pose: true_pose } = scene.players[store.places.get(robot.id)] ?? {};
    const poses = view.truth ? [true_pose].filter(Boolean) : this.#origins(view, robot);
    const ranges = new Map(anchors ?? []), found = anchor_range === undefined ? [] : [[robot.anchor, anchor_range]];
    for (const one of store.stage.anchors) if (ranges.has(one.id)) found.push([store.anchor_at(one, view.truth), ranges.get(one.id)]);
    for (const [at, range] of found) if (at) for (const pose of poses) this.#anchor_line(pose, at, range, view, fading(share, moving));
  }

  #anchor_line(pose, anchor, range, { look, size }, alpha) {
    const pen = this.plane.context, from = this.plane.at(pose), to = this.plane.at(anchor);
    this.plane.marks.add("distance");
    pen.globalAlpha = alpha;
    line(pen, [from, to], look.now, GLOW);
    line(pen, [from, to], look.range, 1.8);
    if (size > 6) this.plane.labels.avoid(from, to);
    const length = distance(from, to), x = (from[0] + to[0]) / 2, y = (from[1] + to[1]) / 2;
    if (alpha > 1 - 1.6 * LABELLED && (length > LEGIBLE || (size > 6 && length > 1))) {
      const across = [(to[1] - from[1]) / length, (from[0] - to[0]) / length].map((one) => BESIDE * one);
      const spots = [[x + across[0], y + across[1] + 4], [x - across[0], y - across[1] + 4]].sort((a, b) => a[1] - b[1]);
      const [spot, other] = spots, steep = Math.abs(across[0]) > 0.5 * BESIDE;
      const align = !steep ? "center" : spot[0] > x ? "left" : "right";
      this.plane.labels.put(metres(range), ...spot, look.range, align, { around: steep ? BESIDE : 0, others: steep ? [] : [other] });
    }
    pen.globalAlpha = 1;
  }

  /** Draws a mutual range as a circle around the believed pose, for views that hide the ground truth. */
  mutual_ring(view, robot) {
    const { scene, store, look, share, moving } = view;
    const contacts = scene.players[store.places.get(robot.id)]?.contacts ?? [];
    const contact = contacts.find((one) => one[0] === robot.peer) ?? contacts[0];
    const poses = this.#origins(view, robot);
    if (!contact || contact[1] === null || !poses.length) return;
    this.plane.marks.add("measured");
    const pen = this.plane.context, [x, y] = this.plane.at(poses[0]);
    pen.globalAlpha = fading(share, moving) * (poses.length > 1 ? 0.6 : 1);
    for (const pose of poses) circle(this.plane, pose, contact[1], look.link, 1.5, DASHED);
    this.plane.labels.put(`${contact[0]}: ${metres(contact[1])}`, x, y + contact[1] * this.plane.scale + 14, look.link, "center");
    pen.globalAlpha = 1;
  }

  /** Draws the contact of `robot` with `peer`, and the reports between them. */
  contact(view, robot, peer) {
    const { scene, store, look, places, size, focus, moving, share } = view;
    const player = scene.players[store.places.get(robot.id)];
    const contact = player?.contacts?.find((one) => one[0] === peer);
    const from = places.get(robot.id), to = places.get(peer);
    if (!contact || !from || !to) return;
    const pen = this.plane.context, one = this.plane.at(from), other = this.plane.at(to), length = distance(one, other);
    if (length < 1) return;
    const across = [-(other[1] - one[1]) / length, (other[0] - one[0]) / length];
    pen.globalAlpha = focus && robot.id !== focus && peer !== focus ? 0.4 : 1;
    if (contact[1] !== null && !(moving && share > LABELLED)) line(pen, [one, other], look.now, GLOW);
    for (const side of [-3.5, 3.5]) line(pen, [one, other].map(([x, y]) => [x + side * across[0], y + side * across[1]]), look.link, 1.4);
    this.plane.marks.add("contact");
    this.#reach(view, robot, peer, from);
    if (size > 6) this.plane.labels.avoid(one, other);
    if (contact[1] !== null && length > LEGIBLE && !(moving && share > LABELLED)) {
      const x = (one[0] + other[0]) / 2 + 16 * across[0], y = (one[1] + other[1]) / 2 + 16 * across[1];
      this.plane.labels.put(metres(contact[1]), x, y, look.link, across[0] < 0 ? "right" : "left", { around: 16 * Math.abs(across[0]) });
    }
    if (length > 3 * size && size > 6 && !store.estimated) {
      this.#reports(view, robot.id, peer, one, other, across, 3.5);
      this.#reports(view, peer, robot.id, other, one, across, -3.5);
    }
    pen.globalAlpha = 1;
  }

  /** Draws how far `robot`, which is at `place`, can range `peer`, in the tick in which they come in range. */
  #reach({ store, tick, share, moving, look }, robot, peer, place) {
    const alpha = fading(share, moving), earlier = store.player(tick - 1, robot.id);
    if (store.estimated || !earlier || earlier.contacts?.some(([id]) => id === peer) || alpha <= 0) return;
    const pen = this.plane.context, before = pen.globalAlpha;
    this.plane.marks.add("reach");
    pen.globalAlpha = 0.6 * alpha * before;
    circle(this.plane, place, store.stage.mission.sensing_range, look.link, 1.2, DASHED);
    pen.globalAlpha = before;
  }

  /** Draws the reports on one lane, from `from` to `to`; reports in flight are in its middle. */
  #reports({ scene, share, moving, look, store, tick, size }, sender, receiver, from, to, across, side) {
    const passages = scene.passages.filter((one) => one.sender === sender && one.receiver === receiver);
    const here = new Map();
    for (const one of passages) here.set(one.tick, [...(here.get(one.tick) ?? []), one.what]);
    const progress = moving ? Math.min(1, share / 0.75) : null;
    const spot = (way) => [
      from[0] + way * (to[0] - from[0]) + side * across[0],
      from[1] + way * (to[1] - from[1]) + side * across[1],
    ];
    let waiting = 0;
    for (const [sent, what] of here) {
      const arrives = what.includes("heard") || what.includes("damaged"), late = sent < tick;
      const start = late ? 0.5 : 0.12;
      const goal = arrives ? 0.86 : 0.5;
      const way = progress === null ? (arrives ? 0.72 : 0.5) : start + progress * (goal - start);
      const lost = what.includes("lost") && !arrives;
      const sign = lost ? "lost" : what.includes("damaged") ? "damaged" : arrives ? (late ? "late" : "heard") : "waiting";
      if (sign === "waiting" && !store.live && progress === null) waiting += 1;
      const alpha = progress !== null && lost ? Math.max(0.15, 1 - 0.8 * progress) : 1;
      this.#report(spot(way - 0.05 * waiting), sign, alpha, spot(way - 0.12), look, size);
    }
  }

  #report([x, y], sign, alpha, behind, look, size) {
    const pen = this.plane.context, before = pen.globalAlpha;
    pen.globalAlpha = before * alpha;
    this.plane.marks.add(sign === "heard" ? "report" : sign);
    if (sign === "late") line(pen, [behind, [x, y]], look.link, 4);
    dot(pen, [x, y], Math.min(5, 0.5 * size), sign === "heard" || sign === "late" ? look.link : look.paper);
    stroked(pen, sign === "lost" || sign === "damaged" ? look.fault : look.link, 1.8, sign === "lost" ? OUTLINED : []);
    if (sign === "damaged") cross(pen, x, y, 5, look);
    pen.globalAlpha = before;
  }
}

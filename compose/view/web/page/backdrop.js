// What stays the same between two ticks: the grid, the anchors with their ranges and orbits, and the trails up to the
// tick. But for the grid, it is drawn once for many pictures: while the camera eases, the last one moves with it.

import { TAU } from "./geometry.js";
import { draw_tree } from "./group.js";
import { DASHED, line, stroked } from "./pen.js";
import { rounded_up } from "./strip.js";
import { metres } from "./words.js";

const FEW = 4; // anchors of a team whose ranges are drawn in full colours
const LEGIBLE = 26; // the least radius in pixels of an anchor's range with which the anchor has a label
const PAD = 128; // the pixels of the canvas around the plane that are drawn, too
const ZOOMED = 0.15; // by which the picture is scaled at most while the camera eases

export class Backdrop {
  constructor(plane, trails) {
    Object.assign(this, { plane, trails, canvas: document.createElement("canvas") });
    this.pen = this.canvas.getContext("2d");
  }

  #told = "";
  /** The camera with which the picture is drawn. */
  #centre = [0, 0];
  #scale = 1;

  /**
   * Draws the grid, copies the backdrop to the plane, and adds the labels and targets of the robots that are `near`.
   *
   * The backdrop is drawn again if something in it has changed, or the camera; while that eases, only once it has moved far.
   */
  draw(view, robots, near, ratio) {
    const { plane } = this, { store, tick, focus, truth, look } = view, { width, height } = plane.canvas;
    const known = [store.name, store.revision, store.last, Math.min(store.whole, tick + 1), Boolean(view.scene), robots.length];
    const told = [...known, tick, focus, truth, plane.fine, width, height, ratio, look.paper].join();
    this.#grid(look);
    const moved = String([...plane.centre, plane.scale]) !== String([...this.#centre, this.#scale]);
    if (told !== this.#told || (moved && (!plane.easing || this.#far()))) {
      if (told !== this.#told) this.styles = truth ? this.trails.styles(view, robots) : [];
      plane.padded(PAD / ratio, () => this.#picture(view, robots, ratio));
      [this.#told, this.#centre, this.#scale] = [told, plane.centre, plane.scale];
    }
    const zoom = plane.scale / this.#scale, size = [width, height].map((one) => zoom * (one + 2 * PAD));
    const corner = plane.at(this.#centre).map((one, i) => ratio * one - size[i] / 2);
    plane.context.save();
    plane.context.setTransform(1, 0, 0, 1, 0, 0);
    plane.context.drawImage(this.canvas, ...(zoom === 1 ? corner.map(Math.round) : corner), ...size);
    plane.context.restore();
    plane.labels.placed.push(this.bar);
    for (const robot of near) if (robot.anchor) this.#name(view, robot, `anchor of ${robot.id}`);
    for (const one of this.#shared(view)) this.#name(view, one, one.id);
    const { anchors } = store.stage, marks = anchors.some(({ position }) => !position) && truth ? ["unsurveyed"] : [];
    if (!store.stage.team) marks.push("anchor", "orbit");
    else if (anchors.some(({ position }) => position)) marks.push("anchor");
    for (const mark of [...marks, ...this.paths]) plane.marks.add(mark);
  }

  /** Returns whether the camera is too far from that of the picture: part of the plane would be empty, or the picture blurred. */
  #far() {
    const { plane } = this, size = [plane.width, plane.height], zoom = plane.scale / this.#scale, pad = (PAD * plane.width) / plane.canvas.width;
    const covered = (one, i) => Math.abs(one - size[i] / 2) + size[i] / 2 <= zoom * (size[i] / 2 + pad);
    return Math.abs(zoom - 1) > ZOOMED || !plane.at(this.#centre).every(covered);
  }

  /** Draws the picture, on a plane with the pixels around it. */
  #picture(view, robots, ratio) {
    const { plane, pen, canvas } = this, { store, look } = view, { width, height } = plane.canvas;
    const size = { width: width + 2 * PAD, height: height + 2 * PAD };
    if (Object.entries(size).some(([name, pixels]) => canvas[name] !== pixels)) Object.assign(canvas, size);
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.clearRect(0, 0, canvas.width, canvas.height);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.lineCap = pen.lineJoin = "round";
    if (store.grouped && view.truth) draw_tree(pen, plane, view);
    for (const robot of robots) if (robot.anchor) this.#anchor(view, robot);
    for (const one of this.#shared(view)) this.#anchor(view, one);
    this.trails.trails(pen, view, this.styles);
    this.paths = [...plane.marks]; // the trails have named them
  }

  /** Returns the anchors of a team that are drawn: those that no robot knows with the ground truth only. */
  #shared({ store, truth }) {
    return store.stage.anchors.map((one) => ({ id: one.id, anchor: store.anchor_at(one, truth), told: one.position, sigma: one.sigma }))
      .filter(({ anchor }) => anchor);
  }

  /** Draws the grid, and a bar with its unit. */
  #grid(look) {
    const { plane } = this, { width, height, scale, centre, context: pen } = plane;
    const unit = rounded_up(Math.min(80, width / 9) / scale);
    pen.beginPath();
    const left = centre[0] - width / 2 / scale, right = left + width / scale;
    const low = centre[1] - height / 2 / scale, high = low + height / scale;
    for (let x = Math.ceil(left / unit) * unit; x <= right; x += unit) {
      const px = Math.round(plane.at([x, 0])[0]) + 0.5;
      pen.moveTo(px, 0); pen.lineTo(px, height);
    }
    for (let y = Math.ceil(low / unit) * unit; y <= high; y += unit) {
      const py = Math.round(plane.at([0, y])[1]) + 0.5;
      pen.moveTo(0, py); pen.lineTo(width, py);
    }
    stroked(pen, look.grid, 1);
    const bar = unit * scale, x = width - 14, y = height - 14;
    line(pen, [[x - bar, y - 4], [x - bar, y], [x, y], [x, y - 4]], look.faint, 2);
    pen.fillStyle = look.faint;
    pen.textAlign = "right";
    pen.fillText(unit >= 1 ? `${unit} m` : metres(unit), x - 5, y - 5);
    this.bar = [x - Math.max(bar, 60), y - 18, x, y + 4];
  }

  /** Draws the range of an anchor, and its robot's orbit or, in a team, three sigmas of its position. */
  #anchor(view, robot) {
    const { pen, plane } = this, { look } = view, { at: [x, y], reach, alpha } = this.#place(view, robot);
    const [mx, my] = robot.anchor, far = Math.max(reach / plane.scale, robot.orbit?.[0] ?? 0);
    if (view.store.estimated || (robot.orbit && !plane.sees([mx - far, my - far], [mx + far, my + far]))) return;
    pen.globalAlpha = alpha * Math.min(1, FEW / view.store.stage.anchors.length);
    pen.beginPath();
    pen.arc(x, y, reach, 0, TAU);
    pen.fillStyle = look.disc;
    pen.fill();
    const localised = view.store.grouped && robot.role === "a";
    stroked(pen, localised ? look.robot.a : look.ring, localised ? 2.2 : 1.2);
    pen.beginPath();
    pen.arc(...(robot.told ? plane.at(robot.told) : [x, y]), (robot.orbit?.[0] ?? 3 * robot.sigma) * plane.scale, 0, TAU);
    stroked(pen, look.orbit, 1, DASHED);
    pen.globalAlpha = 1;
  }

  /** Draws all anchors, above paths and poses that are ruled out. */
  beacons(view, robots) {
    for (const robot of robots) if (robot.anchor) this.#beacon(view, robot);
    for (const one of this.#shared(view)) this.#beacon(view, one);
  }

  #beacon(view, robot) {
    const pen = this.plane.context, { at: [x, y], radius: r, alpha } = this.#place(view, robot);
    pen.globalAlpha = alpha;
    pen.beginPath();
    pen.moveTo(x, y - r); pen.lineTo(x + r, y + r * 0.75); pen.lineTo(x - r, y + r * 0.75); pen.closePath();
    stroked(pen, view.look.paper, 2.5);
    const hollow = robot.told === null;
    pen.fillStyle = hollow ? view.look.paper : view.look.ink;
    pen.fill();
    if (hollow) stroked(pen, view.look.ink, 1.4);
    pen.globalAlpha = 1;
  }

  /** Asks for the label of an anchor, and adds its target. */
  #name(view, robot, label) {
    const { plane } = this, { at, reach, radius, alpha } = this.#place(view, robot);
    plane.targets.push({ kind: "anchor", robot: robot.id, at, radius });
    plane.context.globalAlpha = alpha;
    const [x, y] = at, below = [x, y + radius + 12], { team } = view.store.stage, above = [x, y - (team ? radius : reach) - 5];
    if (reach > LEGIBLE) plane.labels.put(label, ...(team ? below : above), view.look.faint, "center", { around: radius + 4, others: [team ? above : below] });
    plane.context.globalAlpha = 1;
  }

  #place({ store, focus }, robot) {
    const reach = store.stage.mission.sensing_range * this.plane.scale;
    const mine = !focus || robot.id === focus || robot.peer === focus || robot.sigma !== undefined;
    return { at: this.plane.at(robot.anchor), reach: store.estimated ? LEGIBLE + 1 : reach, radius: reach > 40 ? 6 : 4, alpha: mine ? 1 : 0.45 };
  }
}

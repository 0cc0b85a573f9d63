// What stays the same between two ticks: the grid, the anchors with their ranges and orbits, and the trails up to the
// tick. But for the grid, it is a layer.

import { TAU } from "./geometry.js";
import { draw_tree } from "./group.js";
import { AROUND, GROUND_ALPHA } from "./labels.js";
import { Layer } from "./layer.js";
import { DASHED, line, stroked } from "./pen.js";
import { rounded_up } from "./strip.js";
import { metres } from "./words.js";

const FEW = 4; // anchors of a team whose ranges are drawn in full colours
const LEGIBLE = 26; // the least radius in pixels of an anchor's range with which the anchor has a label
const ZOOMED = 0.15; // by which the picture is scaled at most while the camera eases

export class Backdrop {
  constructor(plane, trails) { Object.assign(this, { plane, trails, layer: new Layer(plane, ZOOMED) }); }

  #told = "";

  /** Draws the grid and the backdrop, and adds the labels and targets of the robots that are `near`. */
  draw(view, robots, near) {
    const { plane } = this, { store, truth, look } = view, told = [view.known, robots.length, plane.fine].join();
    this.#grid(look);
    if (told !== this.#told) this.styles = truth ? this.trails.styles(view, robots) : [];
    this.#told = told;
    this.layer.show(told, view.ratio, () => this.#picture(view, robots));
    plane.labels.placed.push(this.bar);
    for (const robot of near) if (robot.anchor) this.#name(view, robot, `anchor of ${robot.id}`);
    for (const one of this.#shared(view)) this.#name(view, one, one.id);
    const { anchors } = store.stage, marks = anchors.some(({ position }) => !position) && truth ? ["unsurveyed"] : [];
    if (!store.stage.team) marks.push("anchor", "orbit");
    else if (anchors.some(({ position }) => position)) marks.push("anchor");
    for (const mark of [...marks, ...this.paths]) plane.marks.add(mark);
  }

  #picture(view, robots) {
    if (view.store.grouped && view.truth) draw_tree(this.plane, view);
    for (const robot of robots) if (robot.anchor) this.#anchor(view, robot);
    for (const one of this.#shared(view)) this.#anchor(view, one);
    this.trails.trails(view, this.styles);
    this.paths = [...this.plane.marks]; // the trails have named them
  }

  /** Returns the anchors of a team that are drawn: those that no robot knows with the ground truth only. */
  #shared({ store, truth }) {
    return store.stage.anchors.map((one) => ({ id: one.id, anchor: store.anchor_at(one, truth), told: one.position, sigma: one.sigma }))
      .filter(({ anchor }) => anchor);
  }

  /** Draws the grid. */
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
    this.unit = unit;
    this.bar = [width - 14 - Math.max(unit * scale, 60), height - 32, width - 14, height - 10];
  }

  /** Draws the length of a unit of the grid, over paths that run behind it. */
  scale_bar(pen, look) {
    const [left, top, x, bottom] = this.bar, bar = this.unit * this.plane.scale, y = bottom - 4;
    pen.globalAlpha = GROUND_ALPHA;
    pen.fillStyle = look.paper;
    pen.fillRect(left - AROUND, top, x - left + 2 * AROUND, bottom - top);
    pen.globalAlpha = 1;
    line(pen, [[x - bar, y - 4], [x - bar, y], [x, y], [x, y - 4]], look.faint, 2);
    pen.fillStyle = look.faint;
    pen.textAlign = "right";
    pen.fillText(this.unit >= 1 ? `${this.unit} m` : metres(this.unit), x - 5, y - 5);
  }

  /** Draws the range of an anchor, and its robot's orbit or, in a team, three sigmas of its position. */
  #anchor(view, robot) {
    const { plane } = this, pen = plane.context, { look } = view, { at: [x, y], reach, alpha } = this.#place(view, robot);
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

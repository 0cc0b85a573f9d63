// The plane in one tick: anchors, trails, robots, ranges, reports and posteriors.

import { Backdrop } from "./backdrop.js";
import { Beliefs } from "./beliefs.js";
import { Configurations } from "./configurations.js";
import { Construction } from "./construction.js";
import { scenario_discs, story_discs, true_and_reported } from "./camera.js";
import { distance, TAU } from "./geometry.js";
import { heads, links } from "./group.js";
import { Labels, NAME } from "./labels.js";
import { Layer } from "./layer.js";
import { cross, dot, line, Look, OUTLINED, outlined, shape, stroked, unit } from "./pen.js";
import { palette } from "./strip.js";
import { same, under } from "./selection.js";
import { Signals } from "./signals.js";
import { Tints } from "./tints.js";
import { LEAST_GAP_M, pose_now, REPORTED, stands, Trails, TRUE } from "./trails.js";
import { metres } from "./words.js";

/** The time in s in which the camera covers most of the way to where it is needed. */
const EASE_S = 0.45;
/** The distance in pixels from which on the camera is where it is needed. */
const NEAR_PX = 0.5;
/** The height in pixels down to the end of a caption, the largest share of the plane that it counts for, and the part of it that is in the margin. */
const CAPTION_PX = 92, CAPTION_SHARE = 0.3, CLEAR_PX = 12;
/** The distance in pixels that a pointer moves before it drags the plane instead of selecting what is there. */
const DRAG_PX = 4;
const VISIBLE_PX = 2; // the sensing range from which on poses and measurements can be told from the robots
const ALL_DRAWN = 8; // robots that are all drawn, also those that are out of view
/** Robots in view from which on those that stand are a layer, and the part by which that is scaled at most while the camera eases. */
const LAYERED = 80, STANDING_ZOOMED = 0.06;
/** The least width and height in pixels of a picture: a lower window shows a part of it. */
const LEAST_PX = 40;
/** The sides of the small map of a group as shares of the plane's, and the least zoom of the camera with which it is drawn. */
const INSET = 0.2, ZOOMED = 2.5;
/** The largest number of robots of a group that always have their names; those of one pair have them, too. */
const NAMED = 20;
/** The texts over the plane. */
const OVER = [...document.querySelectorAll("#stage :is(p, ul), #legend :is(summary, ul)")];

/** The map from the world to the canvas, with pan and zoom, and the order in which things are drawn. */
export class Plane {
  /** `choose` is called with the target of each click that is no drag, or undefined if there is none. */
  constructor(canvas, redraw, choose = () => {}) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.centre = [0, 0];
    this.scale = 40;
    this.fitted = true;
    /** True if the camera follows the story of guided play. */
    this.following = false;
    /** True if the user has moved the camera, which then does not follow the story by itself. */
    this.freed = false;
    this.easing = false;
    /** The drawn robots, anchors and hypotheses as { kind, robot, place, at, radius }, in pixels. */
    this.targets = [];
    this.#redraw = redraw;
    this.#trails = new Trails(this);
    this.#backdrop = new Backdrop(this, this.#trails);
    this.#standing = new Layer(this, STANDING_ZOOMED);
    this.#beliefs = new Beliefs(this);
    this.#signals = new Signals(this);
    this.#configurations = new Configurations(this);
    this.#construction = new Construction(this);
    this.tints = new Tints();
    /** The names of the marks that are drawn, for the legend. */
    this.marks = new Set();
    /** What is drawn above all else and can be dragged; see Changes. */
    this.handles = null;
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * 0.0015), [event.offsetX / unit(), event.offsetY / unit()]);
    }, { passive: false });
    let held = null, dragged = false, handle = null;
    const there = (event) => [event.offsetX / unit(), event.offsetY / unit()];
    canvas.addEventListener("pointerdown", (event) => {
      held = [event.clientX, event.clientY];
      dragged = false;
      handle = this.handles?.taken(there(event), this);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!held) return void this.#point(event.pointerType === "mouse" ? there(event) : null);
      const moved = [event.clientX - held[0], event.clientY - held[1]];
      if (!dragged && Math.hypot(...moved) < DRAG_PX) return;
      dragged = true;
      this.#point(null);
      if (handle) return void handle(this.world(there(event)));
      this.shift(moved[0] / unit(), moved[1] / unit());
      held = [event.clientX, event.clientY];
    });
    canvas.addEventListener("pointerup", (event) => {
      if (held && !dragged && !handle) choose(under(this.targets, there(event)));
    });
    canvas.addEventListener("pointerleave", () => this.#point(null));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { held = null; });
  }

  #redraw;
  #trails;
  #backdrop;
  #standing;
  #size = [0, 0];
  #beliefs;
  #signals;
  #configurations;
  #construction;
  #look = null;
  #revision = -1;
  #pointer = null;

  /** The target under the pointer; undefined if there is none. */
  get hovered() { return this.#pointer ? under(this.targets, this.#pointer) : undefined; }

  #point(at) {
    const before = this.hovered;
    this.#pointer = at;
    if (this.hovered !== before) this.#redraw();
  }

  /** The view that the user has chosen, as [x, y, scale] in m and pixels per m; null if the page chooses it. */
  get chosen_view() { return this.freed && !this.fitted && !this.following ? [...this.centre, this.scale] : null; }

  /** Shows the view [x, y, scale]. */
  look_at([x, y, scale]) {
    this.#free();
    Object.assign(this, { centre: [x, y], scale });
  }

  get width() { return this.#size[0]; }
  get height() { return this.#size[1]; }

  /** Reads the size of the canvas, which the browser may have to compute. */
  #measure() { this.#size = [this.canvas.clientWidth / unit(), this.canvas.clientHeight / unit()]; }

  #free() {
    this.fitted = this.following = this.easing = false;
    this.freed = true;
  }

  shift(dx, dy) {
    this.#free();
    this.centre = [this.centre[0] - dx / this.scale, this.centre[1] + dy / this.scale];
    this.#redraw();
  }

  zoom(factor, [x, y] = [this.width / 2, this.height / 2]) {
    this.#free();
    const dx = (x - this.width / 2) / this.scale, dy = -(y - this.height / 2) / this.scale;
    const scale = Math.min(Math.max(this.scale * factor, 1e-4), 1e6);
    const share = 1 - this.scale / scale;
    this.centre = [this.centre[0] + dx * share, this.centre[1] + dy * share];
    this.scale = scale;
    this.#redraw();
  }

  /** Zooms to the whole scenario, or to the pair of the selected robot if there are several pairs. */
  fit(store, focus, truth = true) {
    this.fitted = true;
    this.following = this.easing = false;
    const { robots, mission } = store.stage, reach = mission.sensing_range;
    const { anchor, orbit } = robots.find((robot) => robot.id === focus) ?? {};
    if (!truth && anchor) return this.#frame([[anchor, Math.max(reach, orbit[0]) + reach]], this.#texts());
    const chosen = focus && robots.length > 2 ? robots.filter((r) => r.id === focus || r.peer === focus) : robots;
    return this.#frame(scenario_discs(chosen, store), this.#texts());
  }

  /** Zooms to the robots and to all poses that they consider possible, or to those of the selected robot's pair. */
  near(store, { tick, focus, truth }) {
    const reach = store.stage.mission.sensing_range, discs = [];
    for (const robot of store.stage.robots) {
      if (focus && robot.id !== focus && (robot.peer !== focus || !truth)) continue;
      const player = store.player(tick, robot.id);
      const poses = [...(truth ? true_and_reported(player) : []), ...(player?.held?.world ?? [])];
      discs.push(...(poses.length ? poses.map((pose) => [pose, 0.3 * reach]) : scenario_discs([robot], store)));
    }
    this.#frame(discs, this.#texts(document.querySelector("#predictions")));
    this.#free();
    this.#redraw();
  }

  /** Eases the camera to what the story needs in view; without delay if `now`, in ms, is null. */
  follow(view, store, pair, now) {
    this.fitted = false;
    this.#measure();
    const { scale, centre } = this.#framed(story_discs({ ...view, truth: view.truth, store }, pair), this.#texts(document.querySelector("#predictions")));
    const s = now === null ? Infinity : Math.min(now - (this.easing || now - 16), 250) / 1000;
    const part = 1 - Math.exp(-s / EASE_S);
    this.scale *= (scale / this.scale) ** part;
    this.centre = this.centre.map((one, i) => one + part * (centre[i] - one));
    const off = Math.max(Math.abs(Math.log(scale / this.scale)) * this.width, distance(centre, this.centre) * this.scale);
    this.easing = off > NEAR_PX ? now : false;
    if (!this.easing) Object.assign(this, { scale, centre });
  }

  /** Returns the height in pixels of the texts over the plane, of which the camera keeps clear: a caption, and a list if there is one. */
  #texts(list = null) {
    const { top, height } = this.canvas.getBoundingClientRect(), { bottom } = list?.getBoundingClientRect() ?? { bottom: 0 };
    return Math.max(bottom - top, Math.min(CAPTION_PX, CAPTION_SHARE * height)) / unit() - CLEAR_PX;
  }

  #frame(discs, top) { Object.assign(this, this.#framed(discs, top)); }

  /** Returns the scale and the centre with which `discs` are in view, below the uppermost `top` pixels. */
  #framed(discs, top = 0) {
    const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    for (const [[x, y], radius] of discs) {
      low[0] = Math.min(low[0], x - radius); low[1] = Math.min(low[1], y - radius);
      high[0] = Math.max(high[0], x + radius); high[1] = Math.max(high[1], y + radius);
    }
    const margin = Math.min(28, 0.05 * this.width);
    const wide = Math.max(high[0] - low[0], 1e-6), tall = Math.max(high[1] - low[1], 1e-6);
    const width = Math.max(this.width - 2 * margin, LEAST_PX), height = Math.max(this.height - 2 * margin - 24 - top, LEAST_PX);
    const scale = Math.min(width / wide, height / tall);
    return { scale, centre: [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2 + (top / 2 - 8) / scale] };
  }

  at([x, y]) {
    return [
      this.width / 2 + (x - this.centre[0]) * this.scale,
      this.height / 2 - (y - this.centre[1]) * this.scale,
    ];
  }

  /** Returns the position in m of a pixel. */
  world([x, y]) {
    return [this.centre[0] + (x - this.width / 2) / this.scale, this.centre[1] - (y - this.height / 2) / this.scale];
  }

  /** Returns whether the box with the corners `least` and `most`, in m, is in view. */
  sees(least, most) {
    const [x, y] = this.centre, wide = this.width / 2 / this.scale, tall = this.height / 2 / this.scale;
    return least[0] <= x + wide && most[0] >= x - wide && least[1] <= y + tall && most[1] >= y - tall;
  }

  /** Calls `draw` while all is drawn with `pen`, on a plane that is larger by `pad` pixels on each side. */
  padded(pad, pen, draw) {
    const { context } = this, size = this.#size;
    [this.context, this.#size] = [pen, size.map((one) => one + 2 * pad)];
    draw();
    [this.context, this.#size] = [context, size];
  }

  /** The parts of a metre that are at most a pixel long: a power of two. */
  get fine() { return 2 ** Math.ceil(Math.log2(this.scale)); }

  draw(store, { tick, share, focus, truth, moving, eliminated, planned, turned, selected }) {
    this.#measure();
    const ratio = (window.devicePixelRatio || 1) * unit();
    const width = Math.round(this.width * ratio), height = Math.round(this.height * ratio);
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
    if (this.fitted) this.fit(store, focus, truth);
    this.targets = [];
    this.marks.clear();
    if (this.#revision !== store.revision) {
      this.#trails.forget();
      this.tints.forget();
      this.#revision = store.revision;
    }
    const of = palette(), look = this.#look?.of === of ? this.#look : this.#look = new Look(of), pen = this.context;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, this.width, this.height);
    pen.lineCap = pen.lineJoin = "round";
    pen.font = look.font;
    const view = { store, tick, share, focus, truth, moving, eliminated, planned, turned, look, ratio, scene: store.scene(tick) };
    view.known = [store.name, store.revision, store.last, Math.min(store.whole, tick + 1), Boolean(view.scene), tick, focus, truth, width, height, ratio, look.paper].join();
    this.labels = new Labels(pen, look, this.width, this.height, this.#overlays());
    const shown = (robot) => truth || !focus || robot.id === focus;
    const all = store.stage.robots.filter(shown), robots = view.scene && all.length > ALL_DRAWN ? this.#in_view(view, all) : all;
    this.#backdrop.draw(view, all, robots);
    const near = store.stage.mission.sensing_range * this.scale < VISIBLE_PX ? [] : robots;
    if (truth) this.#trails.newest(view, near);
    for (const robot of near) this.#trails[truth ? "turned" : "believed_trail"](view, robot);
    if (view.scene) this.#scene(view, all, robots);
    else this.#backdrop.beacons(view, robots);
    this.#ring(this.targets.find((one) => same(one, selected)), look);
    const cursor = this.hovered ? "pointer" : "";
    if (this.canvas.style.cursor !== cursor) this.canvas.style.cursor = cursor;
    this.labels.draw();
    this.#backdrop.scale_bar(pen, look);
    this.handles?.draw(this, look, store.stage.robots);
    this.canvas.labels = this.labels.drawn;
    this.canvas.targets = this.targets;
  }

  /** Returns the robots of which something may be in view, with their peers: their anchors and poses are near it. */
  #in_view({ store, scene }, robots) {
    const { sensing_range } = store.stage.mission, [x, y] = this.centre;
    const far = [this.width, this.height].map((size) => size / 2 / this.scale + 2 * sensing_range);
    const near = ([px, py], more = 0) => Math.abs(px - x) < far[0] + more && Math.abs(py - y) < far[1] + more;
    const found = new Set(robots.filter(({ id, anchor, orbit }) => {
      const { pose, reported, held } = scene.players[store.places.get(id)];
      const reach = anchor ? Math.max(orbit[0], ...(held?.local ?? []).map(([px, py]) => Math.hypot(px, py))) : 0;
      return !(pose || held) || (anchor && near(anchor, reach)) || [pose, reported?.pose, ...(held?.world ?? [])].some((one) => one && near(one));
    }).map(({ id }) => id));
    return robots.filter(({ id, peer }) => found.has(id) || found.has(peer));
  }

  /** Draws a ring around the selected target. */
  #ring(target, look) {
    if (!target) return;
    const pen = this.context;
    pen.beginPath();
    pen.arc(...target.at, target.radius + 5, 0, TAU);
    stroked(pen, look.ink, 1.5);
  }

  /** Returns the size in pixels with which robots are drawn. */
  robot_size(store) { return Math.max(4.5, Math.min(11, 0.18 * store.stage.mission.sensing_range * this.scale)); }

  #scene(view, all, robots) {
    const { store, truth, focus } = view;
    view.size = this.robot_size(store);
    view.places = new Map(all.map((robot) => [robot.id, pose_now(view, robot, TRUE)]));
    if (store.stage.mission.sensing_range * this.scale < VISIBLE_PX) return void this.#foreground(view, all, robots);
    for (const robot of robots) if (!focus || robot.id === focus) this.#construction.mirror(view, robot);
    view.passed = new Map();
    for (const robot of robots.filter(({ role }) => role === "a")) {
      const passed = this.#construction.crossings(view, robot);
      for (const id of [robot.id, robot.peer]) view.passed.set(id, passed);
    }
    for (const robot of robots) if (store.grouped ? heads(view, robot) : robot.role === "a") this.#configurations.draw(view, robot);
    for (const robot of robots) if (!focus || robot.id === focus) this.#beliefs.belief(view, robot);
    this.#beliefs.anchors(view, focus ? robots.filter(({ id }) => id === focus) : robots);
    for (const robot of robots) this.#signals.anchor_range(view, robot);
    const pairs = store.grouped ? links(view) : robots.filter(({ role }) => role === "a").map((robot) => [robot, robot.peer]);
    if (truth) for (const [robot, peer] of pairs) this.#signals.contact(view, robot, peer);
    if (!truth) for (const robot of robots) this.#signals.mutual_ring(view, robot);
    if (truth) for (const robot of robots) this.#reported(view, robot);
    for (const robot of robots) if (robot.role === "a") this.#configurations.manoeuvre(view, robot);
    this.#foreground(view, all, robots);
    if (truth && store.stage.visits?.length) this.#inset(view);
  }

  /** Draws anchors and robots; of many, all anchors and the robots that stand are a layer. */
  #foreground(view, all, robots) {
    const many = robots.length > LAYERED, shown = view.truth ? robots : [], standing = new Set(many && view.truth ? all.filter((robot) => stands(view, robot)) : []);
    const drawn = () => { this.#backdrop.beacons(view, many ? all : robots); for (const robot of standing) this.#robot(view, robot); };
    if (many) this.#standing.show([view.known, view.moving, standing.size].join(), view.ratio, drawn);
    else drawn();
    for (const robot of shown) if (!standing.has(robot)) this.#robot(view, robot);
    for (const robot of shown) this.#name(view, robot);
  }

  /** Draws a small map of a group in a corner, with a frame around what is in view, unless most is. */
  #inset({ store, look, places }) {
    const { robots } = store.stage, whole = this.#framed(scenario_discs(robots, store)), pen = this.context, share = INSET * whole.scale;
    if (this.scale < ZOOMED * whole.scale) return;
    const wide = INSET * this.width, tall = INSET * this.height, left = this.width - wide - 14, top = this.height - tall - 38;
    const at = ([x, y]) => [left + wide / 2 + share * (x - whole.centre[0]), top + tall / 2 - share * (y - whole.centre[1])];
    const [x, y] = at(this.centre), half = [this.width, this.height].map((size) => (share * size) / this.scale / 2);
    this.marks.add("inset");
    this.labels.placed.push([left, top, left + wide, top + tall]);
    pen.fillStyle = look.paper;
    pen.strokeStyle = look.ring;
    pen.lineWidth = 1;
    pen.fillRect(left, top, wide, tall);
    pen.strokeRect(left, top, wide, tall);
    for (const { id, role } of robots) if (places.get(id)) dot(pen, at(places.get(id)), 3, look.robot[role]);
    pen.strokeStyle = look.ink;
    pen.strokeRect(x - half[0], y - half[1], 2 * half[0], 2 * half[1]);
  }

  /** Draws the pose that an attacker reports, and how far it is from the true one. */
  #reported(view, robot) {
    const { look, size, focus } = view, pen = this.context;
    const pose = pose_now(view, robot, REPORTED), true_pose = view.places.get(robot.id);
    if (!pose || !true_pose || distance(pose, true_pose) < LEAST_GAP_M) return;
    const [x, y] = this.at(pose), [to_x, to_y] = this.at(true_pose);
    this.marks.add("reported");
    pen.globalAlpha = alpha_of(robot, focus);
    line(pen, [[x, y], [to_x, to_y]], look.fault, 1);
    shape(pen, robot.role, x, y, pose[2], size);
    pen.fillStyle = look.paper;
    pen.fill();
    outlined(pen, robot.role, [x, y], pose[2], size, look.fault, 1.5, OUTLINED);
    const text = `${robot.id} reported, ${metres(distance(pose, true_pose))} off`;
    const half = pen.measureText(text).width / 2;
    const along = (part) => [Math.min(Math.max(x + part * (to_x - x), half), this.width - half), y + part * (to_y - y) - 12];
    this.labels.put(text, ...along(0.5), look.fault, "center", { rank: 1, others: [along(0), along(1)] });
    if (size > 6) this.labels.placed.push([x - size, y - size, x + size, y + size]);
    pen.globalAlpha = 1;
  }

  /** Returns the boxes of the texts over the plane, as [left, top, right, bottom]. */
  #overlays() {
    const { left, top } = this.canvas.getBoundingClientRect(), scale = unit();
    const seen = OVER.filter((one) => one.firstChild && !one.hidden && (one.tagName !== "UL" || one.parentElement.open !== false));
    return seen.map((one) => one.getBoundingClientRect()).map((box) => [box.left - left, box.top - top, box.right - left, box.bottom - top].map((side) => side / scale));
  }

  // --- robots ---

  #robot({ look, size, focus, scene, store, places }, robot) {
    const pose = places.get(robot.id);
    if (!pose) return;
    const pen = this.context, [x, y] = this.at(pose), { down } = scene.players[store.places.get(robot.id)];
    pen.globalAlpha = alpha_of(robot, focus);
    outlined(pen, robot.role, [x, y], pose[2], size, look.paper, size > 6 ? 4.5 : 3);
    pen.fillStyle = down ? look.paper : look.robot[robot.role];
    pen.fill();
    stroked(pen, down ? look.robot[robot.role] : look.ink, down ? 3 : size > 6 ? 1.6 : 1);
    if (down) cross(pen, x, y, size, look);
    pen.globalAlpha = 1;
  }

  /** Asks for the label of a robot, and adds its target. */
  #name({ look, size, focus, scene, store, places }, robot) {
    const pose = places.get(robot.id);
    if (!pose) return;
    const [x, y] = this.at(pose), { down } = scene.players[store.places.get(robot.id)];
    this.marks.add(down ? "down" : `robot-${robot.role}`);
    this.targets.push({ kind: "robot", robot: robot.id, at: [x, y], radius: size });
    if (size > 6) this.labels.placed.push([x - size, y - size, x + size, y + size]);
    if (size > 6 || down || robot.id === focus || store.places.size <= (store.grouped ? NAMED : 2)) {
      this.context.globalAlpha = alpha_of(robot, focus);
      const name = down ? `${robot.id} is down` : robot.id;
      this.labels.put(name, x + size + 4, y - size - 2, look.ink, "left", { font: look.bold, rank: NAME, around: size + 4 });
      this.context.globalAlpha = 1;
    }
  }
}

/** Returns the opacity of a robot: those that do not meet the selected one are pale. */
const alpha_of = ({ id, peer }, focus) => (focus && id !== focus && peer !== focus ? 0.45 : 1);

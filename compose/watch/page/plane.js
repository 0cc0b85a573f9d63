// The plane: anchors, trails, robots, what they measure, say and believe, in one tick.

import { between, compose, distance, ellipse, inverse, step, TAU } from "./geometry.js";
import { metres, odds } from "./words.js";

const TRAIL = { 1: { dash: [1.5, 4.5], width: 2.4 }, 2: { dash: [], width: 1.6 }, 3: { dash: [], width: 4 } };
const CHUNK = 64;
const BENDS = 6;
const FADING = 3;
const SIGMAS = 3;
const LEGIBLE = 2.5;

/** What is drawn where: world to canvas, and the pointer that shifts it. */
export class Plane {
  constructor(canvas, redraw) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.centre = [0, 0];
    this.scale = 40;
    this.fitted = true;
    this.#redraw = redraw;
    this.#chunks = new Map();
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * 0.0015), [event.offsetX / unit(), event.offsetY / unit()]);
    }, { passive: false });
    let held = null;
    canvas.addEventListener("pointerdown", (event) => {
      held = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!held) return;
      this.shift((event.clientX - held[0]) / unit(), (event.clientY - held[1]) / unit());
      held = [event.clientX, event.clientY];
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { held = null; });
  }

  #redraw;
  #chunks;
  #revision = -1;

  get width() { return this.canvas.clientWidth / unit(); }
  get height() { return this.canvas.clientHeight / unit(); }

  shift(dx, dy) {
    this.fitted = false;
    this.centre = [this.centre[0] - dx / this.scale, this.centre[1] + dy / this.scale];
    this.#redraw();
  }

  zoom(factor, [x, y] = [this.width / 2, this.height / 2]) {
    this.fitted = false;
    const dx = (x - this.width / 2) / this.scale, dy = -(y - this.height / 2) / this.scale;
    const scale = Math.min(Math.max(this.scale * factor, 1e-4), 1e6);
    const share = 1 - this.scale / scale;
    this.centre = [this.centre[0] + dx * share, this.centre[1] + dy * share];
    this.scale = scale;
    this.#redraw();
  }

  /** Show all that there is; of a pair, if one is chosen among many. */
  fit(store, focus, truth = true) {
    this.fitted = true;
    const { robots, mission } = store.stage, reach = mission.sensing_range;
    if (!truth && focus) {
      const { anchor, orbit } = robots.find((robot) => robot.id === focus);
      return this.#frame([[anchor, Math.max(reach, orbit[0]) + reach]]);
    }
    const chosen = focus && robots.length > 2 ? robots.filter((r) => r.id === focus || r.peer === focus) : robots;
    return this.#frame(chosen.map((robot) => [robot.anchor, Math.max(reach, robot.orbit[0])]));
  }

  /** Show the robots of now from near: of a pair, if one is chosen. */
  near(store, { tick, focus, truth }) {
    const reach = store.stage.mission.sensing_range, discs = [];
    for (const robot of store.stage.robots) {
      if (focus && robot.id !== focus && (robot.peer !== focus || !truth)) continue;
      const player = store.player(tick, robot.id);
      const pose = (truth && player?.pose) || player?.held?.world[0];
      if (pose) discs.push([pose, 0.6 * reach]);
      else discs.push([robot.anchor, reach]);
    }
    this.#frame(discs);
    this.fitted = false;
    this.#redraw();
  }

  #frame(discs) {
    const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    for (const [[x, y], radius] of discs) {
      low[0] = Math.min(low[0], x - radius); low[1] = Math.min(low[1], y - radius);
      high[0] = Math.max(high[0], x + radius); high[1] = Math.max(high[1], y + radius);
    }
    const margin = Math.min(28, 0.05 * this.width);
    const wide = Math.max(high[0] - low[0], 1e-6), tall = Math.max(high[1] - low[1], 1e-6);
    this.scale = Math.min((this.width - 2 * margin) / wide, (this.height - 2 * margin - 24) / tall);
    this.centre = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2 - 8 / this.scale];
  }

  at([x, y]) {
    return [
      this.width / 2 + (x - this.centre[0]) * this.scale,
      this.height / 2 - (y - this.centre[1]) * this.scale,
    ];
  }

  draw(store, { tick, share, focus, truth, moving }) {
    const ratio = (window.devicePixelRatio || 1) * unit();
    const width = Math.round(this.width * ratio), height = Math.round(this.height * ratio);
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
    if (this.fitted) this.fit(store, focus, truth);
    if (this.#revision !== store.revision) {
      this.#chunks.clear();
      this.#revision = store.revision;
    }
    const look = new Look(getComputedStyle(document.documentElement));
    const pen = this.context;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, this.width, this.height);
    pen.lineCap = pen.lineJoin = "round";
    pen.font = look.font;
    const view = { store, tick, share, focus, truth, moving, look, scene: store.scene(tick) };
    this.#grid(view);
    const shown = (robot) => truth || !focus || robot.id === focus;
    const robots = store.stage.robots.filter(shown);
    for (const robot of robots) this.#anchor(view, robot);
    if (truth) for (const robot of robots) this.#trail(view, robot);
    else for (const robot of robots) this.#believed_trail(view, robot);
    if (!view.scene) return;
    const size = Math.max(4.5, Math.min(11, 0.18 * store.stage.mission.sensing_range * this.scale));
    view.size = size;
    view.places = new Map(store.stage.robots.map((robot) => [robot.id, this.#place(view, robot)]));
    for (const robot of robots) if (!focus || robot.id === focus) this.#belief(view, robot);
    for (const robot of robots) this.#anchor_range(view, robot);
    if (truth) for (const robot of robots) if (robot.role === "a") this.#contact(view, robot);
    if (!truth) for (const robot of robots) this.#mutual_ring(view, robot);
    if (truth) for (const robot of robots) this.#robot(view, robot, view.places.get(robot.id));
  }

  // --- what stands still ---

  #grid({ look }) {
    const pen = this.context, raw = Math.min(80, this.width / 9) / this.scale, power = 10 ** Math.floor(Math.log10(raw));
    const unit = [1, 2, 5, 10].find((factor) => factor * power >= raw) * power;
    pen.strokeStyle = look.grid;
    pen.lineWidth = 1;
    pen.beginPath();
    const left = this.centre[0] - this.width / 2 / this.scale, right = left + this.width / this.scale;
    const low = this.centre[1] - this.height / 2 / this.scale, high = low + this.height / this.scale;
    for (let x = Math.ceil(left / unit) * unit; x <= right; x += unit) {
      const px = Math.round(this.at([x, 0])[0]) + 0.5;
      pen.moveTo(px, 0); pen.lineTo(px, this.height);
    }
    for (let y = Math.ceil(low / unit) * unit; y <= high; y += unit) {
      const py = Math.round(this.at([0, y])[1]) + 0.5;
      pen.moveTo(0, py); pen.lineTo(this.width, py);
    }
    pen.stroke();
    const bar = unit * this.scale, x = this.width - 14, y = this.height - 14;
    pen.strokeStyle = pen.fillStyle = look.faint;
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(x - bar, y - 4); pen.lineTo(x - bar, y); pen.lineTo(x, y); pen.lineTo(x, y - 4);
    pen.stroke();
    pen.textAlign = "right";
    pen.fillText(unit >= 1 ? `${unit} m` : metres(unit), x - 5, y - 5);
  }

  #anchor(view, robot) {
    const { look, store, focus } = view, pen = this.context;
    const [x, y] = this.at(robot.anchor), reach = store.stage.mission.sensing_range * this.scale;
    const mine = !focus || robot.id === focus || robot.peer === focus;
    pen.globalAlpha = mine ? 1 : 0.45;
    pen.beginPath();
    pen.arc(x, y, reach, 0, TAU);
    pen.fillStyle = look.disc;
    pen.fill();
    pen.setLineDash([]);
    pen.lineWidth = 1.2;
    pen.strokeStyle = look.ring;
    pen.stroke();
    pen.beginPath();
    pen.arc(x, y, robot.orbit[0] * this.scale, 0, TAU);
    pen.setLineDash([7, 4, 1.5, 4]);
    pen.lineWidth = 1;
    pen.strokeStyle = look.orbit;
    pen.stroke();
    pen.setLineDash([]);
    const r = reach > 40 ? 6 : 4;
    pen.beginPath();
    pen.moveTo(x, y - r); pen.lineTo(x + r, y + r * 0.75); pen.lineTo(x - r, y + r * 0.75); pen.closePath();
    pen.fillStyle = look.ink;
    pen.fill();
    if (reach > 26) this.#label(`anchor of ${robot.id}`, x, y + r + 12, look.faint, "center", look);
    pen.globalAlpha = 1;
  }

  // --- trails ---

  #trail({ store, tick, share, look, focus, moving }, robot) {
    const pen = this.context, last = Math.min(tick, store.last);
    const faint = focus && robot.id !== focus;
    pen.save();
    pen.globalAlpha = faint ? 0.4 : 0.95;
    const ratio = (window.devicePixelRatio || 1) * unit(), s = this.scale;
    const map = () => pen.setTransform(
      ratio * s, 0, 0, -ratio * s,
      ratio * (this.width / 2 - this.centre[0] * s), ratio * (this.height / 2 + this.centre[1] * s),
    );
    const stroke = (path, phase) => {
      const { dash, width } = TRAIL[phase] ?? TRAIL[2];
      pen.lineWidth = (faint ? 0.7 * width : width) / s;
      pen.setLineDash(dash.map((length) => length / s));
      pen.strokeStyle = look.phase[phase];
      pen.stroke(path);
    };
    map();
    for (let from = store.first; from < last; from += CHUNK) {
      const to = Math.min(from + CHUNK, last);
      for (const [phase, path] of this.#pieces(store, robot, from, to, to === from + CHUNK)) stroke(path, phase);
    }
    if (moving && share > 0) {
      const player = store.player(tick, robot.id), next = store.player(tick + 1, robot.id);
      if (player?.pose && next?.pose) {
        const path = new Path2D(), bends = bends_of(next.executed, store.stage.mission.period);
        path.moveTo(player.pose[0], player.pose[1]);
        for (let k = 1; k <= bends; k++) {
          const way = (share * k) / bends;
          const pose = between(player.pose, next.pose, next.executed, way, store.stage.mission.period);
          path.lineTo(pose[0], pose[1]);
        }
        stroke(path, player.drive?.phase ?? 1);
      }
    }
    pen.restore();
    pen.setLineDash([]);
  }

  /** The trail from tick `from` to `to`, a path a phase; kept once it is whole. */
  #pieces(store, robot, from, to, whole) {
    const key = `${robot.id}/${from}`, kept = this.#chunks.get(key);
    if (kept && whole) return kept;
    const pieces = [], period = store.stage.mission.period;
    let path = null, phase = null, complete = true;
    for (let k = from; k < to; k++) {
      const here = store.player(k, robot.id), next = store.player(k + 1, robot.id);
      if (!here?.pose || !next?.pose) {
        path = null; phase = null;
        complete = complete && Boolean(here && next);
        continue;
      }
      const now = here.drive?.phase ?? phase ?? 1;
      if (now !== phase || !path) {
        path = new Path2D();
        path.moveTo(here.pose[0], here.pose[1]);
        pieces.push([now, path]);
        phase = now;
      }
      const bends = bends_of(next.executed, period);
      for (let bend = 1; bend < bends; bend++) {
        const pose = between(here.pose, next.pose, next.executed, bend / bends, period);
        path.lineTo(pose[0], pose[1]);
      }
      path.lineTo(next.pose[0], next.pose[1]);
    }
    if (whole && complete) this.#chunks.set(key, pieces);
    return pieces;
  }

  /** Where the robot was, if what it now holds likeliest is true. */
  #believed_trail({ store, tick, look }, robot) {
    const now = store.player(tick, robot.id)?.held;
    if (!now?.local.length) return;
    const here = now.world.length ? now.world[0] : compose(frame_of(robot, false), now.local[0]);
    const turn = compose(here, inverse(now.local[0])), pen = this.context;
    const { period } = store.stage.mission;
    let phase = null, last = null;
    pen.save();
    pen.globalAlpha = 0.8;
    for (let k = Math.max(store.first, tick - 4000); k <= tick; k++) {
      const player = store.player(k, robot.id);
      if (!player?.held?.local.length || (player.held.local.length > 1 && k < tick)) continue;
      const there = compose(turn, player.held.local[0]), [x, y] = this.at(there);
      const next = player.drive?.phase ?? 1;
      if (phase !== null && last) {
        const bends = bends_of(player.executed, period);
        for (let bend = 1; bend <= bends; bend++) {
          pen.lineTo(...this.at(between(last, there, player.executed, bend / bends, period)));
        }
      }
      last = there;
      if (next !== phase) {
        if (phase !== null) pen.stroke();
        phase = next;
        const { dash, width } = TRAIL[phase];
        pen.setLineDash(dash);
        pen.lineWidth = width;
        pen.strokeStyle = look.phase[phase];
        pen.beginPath();
        pen.moveTo(x, y);
      }
    }
    if (phase !== null) pen.stroke();
    pen.restore();
    pen.setLineDash([]);
  }

  // --- robots and beliefs ---

  #place({ store, scene, tick, share, moving }, robot) {
    const player = scene.players[store.places.get(robot.id)];
    if (!player?.pose) return null;
    if (!moving) return player.pose;
    const next = store.player(tick + 1, robot.id);
    return between(player.pose, next?.pose, next?.executed, share, store.stage.mission.period);
  }

  #robot({ look, size, focus, scene, store }, robot, pose) {
    if (!pose) return;
    const pen = this.context, [x, y] = this.at(pose);
    const phase = scene.players[store.places.get(robot.id)]?.drive?.phase ?? 1;
    pen.globalAlpha = focus && robot.id !== focus && robot.peer !== focus ? 0.45 : 1;
    this.#shape(robot.role, x, y, pose[2], size);
    pen.lineWidth = size > 6 ? 4.5 : 3;
    pen.strokeStyle = look.paper;
    pen.stroke();
    pen.fillStyle = look.phase[phase];
    pen.fill();
    pen.lineWidth = size > 6 ? 1.6 : 1;
    pen.strokeStyle = look.ink;
    pen.stroke();
    if (size > 6 || robot.id === focus) {
      this.#label(robot.id, x + size + 4, y - size - 2, look.ink, "left", look, look.bold);
    }
    pen.globalAlpha = 1;
  }

  /** a points, b is round with a nose: told apart without colour. */
  #shape(role, x, y, heading, size) {
    const pen = this.context, c = Math.cos(heading), s = -Math.sin(heading);
    const to = (ahead, left) => [x + size * (ahead * c + left * s), y + size * (ahead * s - left * c)];
    pen.beginPath();
    if (role === "a") {
      pen.moveTo(...to(1.25, 0)); pen.lineTo(...to(-0.85, 0.85)); pen.lineTo(...to(-0.4, 0)); pen.lineTo(...to(-0.85, -0.85));
    } else {
      const angle = Math.atan2(s, c);
      pen.arc(x, y, 0.82 * size, angle + 0.55, angle + TAU - 0.55);
      pen.lineTo(...to(1.4, 0));
    }
    pen.closePath();
  }

  #belief(view, robot) {
    const { store, scene, truth, look, size, tick } = view;
    const player = scene.players[store.places.get(robot.id)], held = player?.held;
    if (!held) return this.#somewhere(view, robot, player);
    const pen = this.context, frame = frame_of(robot, truth);
    const poses = held.world.length ? held.world : held.local.map((local) => compose(frame, local));
    if (!poses.length) return this.#somewhere(view, robot, player);
    this.#ruled_out(view, robot, poses, tick);
    if (!held.world.length && !truth) this.#any_bearing(view, robot, held);
    poses.slice(0, 60).forEach((pose, place) => {
      const chance = held.odds[place] ?? 1 / poses.length;
      const [x, y] = this.at(pose);
      pen.globalAlpha = 0.3 + 0.7 * Math.sqrt(chance);
      if (place === 0 && held.covariance && held.world.length) this.#ellipse(pose, held.covariance, look);
      const grown = truth ? size * 1.45 : size * 1.15;
      this.#shape(robot.role, x, y, pose[2], grown);
      if (!truth && poses.length === 1) {
        pen.fillStyle = look.phase[player.drive?.phase ?? 1];
        pen.fill();
      }
      pen.strokeStyle = look.ghost;
      pen.lineWidth = 2;
      pen.setLineDash(held.world.length || !truth ? [] : [3, 3]);
      pen.stroke();
      pen.setLineDash([]);
      if (held.odds.length > 1 && place < 6 && chance > 0.01 && size > 6) {
        this.#label(odds(chance), x - grown - 4, y + grown + 8, look.ghost, "right", look);
      }
      if (!truth && place === 0) this.#label(robot.id, x + grown + 3, y - grown, look.ink, "left", look, look.bold);
    });
    pen.globalAlpha = 1;
    return undefined;
  }

  /** Before anything is known but a range, or nothing: somewhere in the anchor's range. */
  #somewhere({ look, truth, store }, robot, player) {
    if (truth || !player) return;
    const pen = this.context, [x, y] = this.at(robot.anchor);
    const range = player.anchor_range ?? store.stage.mission.sensing_range;
    pen.beginPath();
    pen.arc(x, y, range * this.scale, 0, TAU);
    pen.strokeStyle = look.ghost;
    pen.lineWidth = 3;
    pen.setLineDash([2, 6]);
    pen.stroke();
    pen.setLineDash([]);
    this.#label(`${robot.id} is somewhere here`, x, y - range * this.scale - 6, look.ghost, "center", look);
  }

  /** Its place relative to its anchor is known, the bearing is not: the frame is turned at will. */
  #any_bearing({ look }, robot, held) {
    const pen = this.context, [x, y] = this.at(robot.anchor);
    const radius = Math.hypot(held.local[0][0], held.local[0][1]) * this.scale;
    pen.beginPath();
    pen.arc(x, y, radius, 0, TAU);
    pen.strokeStyle = look.ghost;
    pen.globalAlpha = 0.5;
    pen.lineWidth = 2;
    pen.setLineDash([2, 6]);
    pen.stroke();
    pen.setLineDash([]);
    pen.globalAlpha = 1;
    this.#label(`${robot.id}: here, at any bearing`, x, y - radius - 6, look.ghost, "center", look);
  }

  /** What was held possible up to FADING ticks ago, moved on, and is not any more. */
  #ruled_out({ store, truth, look, size }, robot, poses, tick) {
    const pen = this.context, period = store.stage.mission.period;
    for (let age = 1; age <= FADING && tick - age >= 0; age++) {
      const held = store.player(tick - age, robot.id)?.held;
      const later = store.player(tick - age + 1, robot.id)?.held;
      if (!held || !later || held.world.length + held.local.length < 2) continue;
      const frame = frame_of(robot, truth), in_world = held.world.length > 0;
      if (in_world !== later.world.length > 0) continue;
      const had = in_world ? held.world : held.local.map((local) => compose(frame, local));
      const has = in_world ? later.world : later.local.map((local) => compose(frame, local));
      if (has.length >= had.length) continue;
      for (let pose of had.slice(0, 60)) {
        for (let k = tick - age + 1; k <= tick; k++) {
          const driven = store.player(k, robot.id)?.executed;
          if (driven) pose = step(pose, driven[0], driven[1], period);
          if (k === tick - age + 1 && has.some((one) => distance(one, pose) < 0.15)) { pose = null; break; }
        }
        if (!pose || poses.some((one) => distance(one, pose) < 0.15)) continue;
        const [x, y] = this.at(pose), r = 0.7 * size;
        pen.globalAlpha = 0.75 / age;
        this.#shape(robot.role, x, y, pose[2], size * 1.3);
        pen.strokeStyle = look.ghost;
        pen.lineWidth = 1.4;
        pen.setLineDash([2, 3]);
        pen.stroke();
        pen.setLineDash([]);
        pen.strokeStyle = look.fault;
        pen.lineWidth = 2;
        pen.beginPath();
        pen.moveTo(x - r, y - r); pen.lineTo(x + r, y + r); pen.moveTo(x + r, y - r); pen.lineTo(x - r, y + r);
        pen.stroke();
      }
      pen.globalAlpha = 1;
    }
  }

  #ellipse(pose, covariance, look) {
    const { major, minor, turn } = ellipse(covariance, SIGMAS), pen = this.context;
    if (major * this.scale < LEGIBLE) return;
    const [x, y] = this.at(pose);
    pen.beginPath();
    pen.ellipse(x, y, major * this.scale, Math.max(minor * this.scale, 0.5), -turn, 0, TAU);
    pen.fillStyle = look.cloud;
    pen.fill();
    pen.lineWidth = 1.5;
    pen.strokeStyle = look.ghost;
    pen.stroke();
  }

  // --- what is measured and said ---

  #origin({ truth, scene, store, places }, robot) {
    if (truth) return places.get(robot.id);
    const held = scene.players[store.places.get(robot.id)]?.held;
    if (!held) return null;
    if (held.world.length) return held.world[0];
    return held.local.length ? compose(frame_of(robot, false), held.local[0]) : null;
  }

  #anchor_range(view, robot) {
    const { scene, store, look, share, moving } = view;
    const range = scene.players[store.places.get(robot.id)]?.anchor_range;
    const pose = view.truth ? scene.players[store.places.get(robot.id)]?.pose : this.#origin(view, robot);
    if (range === undefined || !pose) return;
    const pen = this.context, from = this.at(pose), to = this.at(robot.anchor);
    pen.globalAlpha = moving ? Math.max(0, 1 - 1.6 * share) : 1;
    pen.beginPath();
    pen.moveTo(...from); pen.lineTo(...to);
    pen.strokeStyle = look.range;
    pen.lineWidth = 1.8;
    pen.stroke();
    if (distance(from, to) > 46) {
      this.#label(metres(range), (from[0] + to[0]) / 2, (from[1] + to[1]) / 2 - 5, look.range, "center", look);
    }
    pen.globalAlpha = 1;
  }

  /** Without the truth, a range to the peer is a ring. */
  #mutual_ring(view, robot) {
    const { scene, store, look } = view;
    const contact = scene.players[store.places.get(robot.id)]?.contacts?.[0];
    const pose = this.#origin(view, robot);
    if (!contact || contact[1] === null || !pose) return;
    const pen = this.context, [x, y] = this.at(pose), radius = contact[1] * this.scale;
    const held = scene.players[store.places.get(robot.id)].held;
    const poses = held.world.length > 1 && held.world.length <= 6 ? held.world : [pose];
    pen.strokeStyle = look.link;
    pen.lineWidth = 1.5;
    pen.setLineDash([6, 5]);
    for (const one of poses) {
      pen.globalAlpha = one === poses[0] ? 1 : 0.45;
      pen.beginPath();
      pen.arc(...this.at(one), radius, 0, TAU);
      pen.stroke();
    }
    pen.globalAlpha = 1;
    pen.setLineDash([]);
    this.#label(`${contact[0]}: ${metres(contact[1])}`, x, y + radius + 14, look.link, "center", look);
  }

  #contact(view, robot) {
    const { scene, store, look, places, size, focus } = view;
    const player = scene.players[store.places.get(robot.id)];
    const contact = player?.contacts?.find((one) => one[0] === robot.peer);
    const from = places.get(robot.id), to = places.get(robot.peer);
    if (!contact || !from || !to) return;
    const pen = this.context, one = this.at(from), other = this.at(to), length = distance(one, other);
    if (length < 1) return;
    const across = [-(other[1] - one[1]) / length, (other[0] - one[0]) / length];
    pen.globalAlpha = focus && robot.id !== focus && robot.peer !== focus ? 0.4 : 1;
    for (const side of [-3.5, 3.5]) {
      pen.beginPath();
      pen.moveTo(one[0] + side * across[0], one[1] + side * across[1]);
      pen.lineTo(other[0] + side * across[0], other[1] + side * across[1]);
      pen.strokeStyle = look.link;
      pen.lineWidth = 1.4;
      pen.stroke();
    }
    if (contact[1] !== null && length > 60) {
      const x = (one[0] + other[0]) / 2 + 16 * across[0], y = (one[1] + other[1]) / 2 + 16 * across[1];
      this.#label(metres(contact[1]), x, y, look.link, across[0] < 0 ? "right" : "left", look);
    }
    if (length > 3 * size && size > 6) {
      this.#reports(view, robot.id, robot.peer, one, other, across, 3.5);
      this.#reports(view, robot.peer, robot.id, other, one, across, -3.5);
    }
    pen.globalAlpha = 1;
  }

  /** The reports on one lane: from `from` to `to`; those that wait on the way stand in its middle. */
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
    const pen = this.context, before = pen.globalAlpha;
    pen.globalAlpha = before * alpha;
    if (sign === "late") {
      pen.beginPath();
      pen.moveTo(...behind); pen.lineTo(x, y);
      pen.strokeStyle = look.link;
      pen.lineWidth = 4;
      pen.stroke();
    }
    pen.beginPath();
    pen.arc(x, y, Math.min(5, 0.5 * size), 0, TAU);
    pen.fillStyle = sign === "heard" || sign === "late" ? look.link : look.paper;
    pen.fill();
    pen.strokeStyle = sign === "lost" || sign === "damaged" ? look.fault : look.link;
    pen.lineWidth = 1.8;
    pen.setLineDash(sign === "lost" ? [2, 2] : []);
    pen.stroke();
    pen.setLineDash([]);
    if (sign === "damaged") {
      pen.beginPath();
      pen.moveTo(x - 3.5, y - 3.5); pen.lineTo(x + 3.5, y + 3.5); pen.moveTo(x + 3.5, y - 3.5); pen.lineTo(x - 3.5, y + 3.5);
      pen.stroke();
    }
    pen.globalAlpha = before;
  }

  #label(text, x, y, colour, align, look, font = look.font) {
    const pen = this.context;
    pen.font = font;
    pen.textAlign = align;
    pen.lineWidth = 3.5;
    pen.strokeStyle = look.paper;
    pen.strokeText(text, x, y);
    pen.fillStyle = colour;
    pen.fillText(text, x, y);
  }
}

/** CSS pixels that what is drawn takes for one: on a very large screen more. */
export const unit = () => Math.max(1, window.innerWidth / 2200);

/** The frame of its anchor; its bearing is the truth's, or, where only the robot is asked, anything. */
function frame_of(robot, truth) {
  return truth && robot.frame ? robot.frame : [robot.anchor[0], robot.anchor[1], 0];
}

function bends_of(driven, period) {
  if (!driven) return 1;
  return Math.max(1, Math.min(4 * BENDS, Math.ceil(Math.abs(driven[1] * period) * 4 * BENDS)));
}

class Look {
  constructor(style) {
    const of = (name) => style.getPropertyValue(`--${name}`).trim();
    for (const name of ["ink", "paper", "faint", "grid", "disc", "ring", "orbit", "ghost", "cloud", "range", "link", "fault"]) {
      this[name] = of(name);
    }
    this.phase = { 1: of("phase-1"), 2: of("phase-2"), 3: of("phase-3") };
    const family = of("font");
    const size = 12.5;
    this.font = `${size}px ${family}`;
    this.bold = `600 ${size + 2.5}px ${family}`;
  }
}

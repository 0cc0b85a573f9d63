// The trails of the robots: true, as an attacker reports it, or as implied by their most probable current pose. As in the
// figures, the hue is the robot, and the line style the phase: dotted, dashed, solid. Reported ones are in the hue of faults.

import { between, compose, controls, inverse, TAU } from "./geometry.js";
import { held_now, lacks_bearing, leads } from "./held.js";
import { DASHED, DOTTED, fading, outlined, unit } from "./pen.js";

const TRAIL = { 1: { dash: DOTTED, width: 2.4 }, 2: { dash: DASHED, width: 2 }, 3: { dash: [], width: 2.6 } };
const REPORTED_STYLE = { dash: DASHED, width: 1.3 };
const CHUNK = 64;
/** The age in ticks from which on a path fades no more, its opacity then, and the ticks of which one piece has one opacity. */
const OLD = 48, PAST = 0.3, STEP = 8;
const BENDS = 6;
const MOST_TRAILS = 6;
/** The number of directions in which a path is shown, and later a robot, while its bearing from the anchor is unknown. */
const TURNS = 8, LATER_TURNS = 4;
const LEAST_PX = 6; // the size of robots from which on copies of them are drawn

/** The least distance in m between a reported and a true position that counts as a difference. */
export const LEAST_GAP_M = 1e-6;
/** The poses of a trail, the controls between two of them, and whether they differ from the true ones if they should. */
export const TRUE = { name: "true", pose: (player) => player?.pose, driven: (here, next) => next.executed, differs: () => true };
export const REPORTED = {
  name: "reported", pose: (player) => player?.reported?.pose,
  driven: (here, next, period) => controls(here.reported.pose, next.reported.pose, period),
  differs: (here, next) => Math.max(here.reported.gap, next.reported.gap) >= LEAST_GAP_M,
};

/** Returns the pose of `robot` on a trail; between two ticks while time passes. */
export function pose_now({ store, tick, share, moving }, robot, kind) {
  const here = store.player(tick, robot.id), next = store.player(tick + 1, robot.id), pose = kind.pose(here) ?? null;
  if (!pose || !moving || !kind.pose(next)) return pose;
  const { period } = store.stage.mission;
  return between(pose, kind.pose(next), kind.driven(here, next, period), share, period);
}

/** Returns whether `robot` stays where it is until the next tick. */
export function stands({ store, tick, moving }, robot) {
  const here = TRUE.pose(store.player(tick, robot.id)), next = moving && TRUE.pose(store.player(tick + 1, robot.id));
  return !here || !next || next.every((one, i) => one === here[i]);
}

/** Returns the trails of a robot that are known with the truth. */
const kinds_of = (robot) => (robot.attack ? [TRUE, REPORTED] : [TRUE]);

export class Trails {
  constructor(plane) { this.plane = plane; }

  #chunks = new Map();

  /** Discards the cached paths, because the scenes have changed. */
  forget() { this.#chunks.clear(); }

  /** Returns the trails of `robots` up to the tick as { robot, kind, strength, phase, role, pieces }: all pieces of one style together. */
  styles({ store, tick, focus }, robots) {
    const last = Math.min(tick, store.last), styles = new Map();
    for (const robot of robots) for (const kind of kinds_of(robot)) for (let from = store.first, to; from < last; from = to) {
      const long = from + CHUNK <= last - OLD && (from - store.first) % CHUNK === 0, end = from + (long ? CHUNK : STEP);
      const strength = PAST + (1 - PAST) * Math.max(0, 1 - Math.max(0, last - end) / OLD);
      to = Math.min(end, last);
      for (const piece of this.#pieces(store, robot, kind, from, to)) {
        const { phase, role } = piece, key = `${kind.name}/${phase}/${role}/${strength}/${focus && robot.id !== focus}`;
        if (!styles.has(key)) styles.set(key, { robot, kind, strength, phase, role, pieces: [] });
        styles.get(key).pieces.push(piece);
      }
    }
    return [...styles.values()];
  }

  /** Draws the trails of `styles`, as far as they are in view: many short paths are drawn in less time than a long one. */
  trails(view, styles) {
    for (const { robot, kind, strength, phase, role, pieces } of styles) {
      const paths = pieces.filter(({ least, most }) => this.plane.sees(least, most)).map(({ path }) => path);
      this.#stroked(view, robot, kind, (stroke) => stroke({ paths, phase, role }, strength));
    }
  }

  /**
   * Draws faint copies of the robot around its anchor while it knows its path, but not its bearing from the anchor.
   *
   * They are there until it meets its peer; in the tick with the caption about its path, with copies of the path.
   */
  turned(view, robot) {
    const pen = this.plane.context, { store, tick, scene, look, share, moving } = view, player = store.player(tick, robot.id), held = player?.held;
    const told = scene?.captions?.some(({ kind, robots }) => kind === "path" && robots.includes(robot.id));
    const pose = pose_now(view, robot, TRUE), size = this.plane.robot_size(store);
    if (!pose || !held?.local.length || held.world.length) return;
    const searching = [robot.id, robot.peer].every((id) => !store.places.has(id) || store.phase(tick, id) === 2);
    if (!told && (!searching || player.contacts?.length || !lacks_bearing(held) || size <= LEAST_PX)) return;
    this.plane.marks.add("turned");
    const [x, y] = robot.anchor, alpha = told ? fading(share, moving) : 0;
    const pieces = alpha > 0 ? this.#pieces(store, robot, TRUE, store.first, Math.min(tick, store.last)) : [];
    const turns = alpha > 0 ? TURNS : LATER_TURNS;
    for (let i = 1; i < turns; i++) {
      const angle = (i * TAU) / turns, turn = compose([x, y, angle], [-x, -y, 0]);
      this.#stroked(view, robot, TRUE, (stroke) => {
        pen.globalAlpha = 0.35 * alpha;
        pen.transform(Math.cos(angle), Math.sin(angle), -Math.sin(angle), Math.cos(angle), turn[0], turn[1]);
        for (const piece of pieces) stroke(piece);
      });
      const [at_x, at_y, heading] = compose(turn, pose);
      pen.globalAlpha = 0.5;
      outlined(pen, robot.role, this.plane.at([at_x, at_y]), heading, 0.8 * size, look.robot[robot.role], 1.2);
    }
    pen.globalAlpha = 1;
  }

  /** Draws the parts of trails that `robots` have driven since the tick. */
  newest(view, robots) {
    const styles = new Map(), { store, focus } = view;
    for (const robot of view.moving && view.share > 0 ? robots : []) for (const kind of kinds_of(robot)) {
      const path = this.#driven(view, robot, kind), phase = store.phase(view.tick, robot.id), { role } = robot;
      const key = `${kind.name}/${phase}/${role}/${focus && robot.id !== focus}`;
      if (!styles.has(key)) styles.set(key, { robot, kind, phase, role, paths: [] });
      if (path) styles.get(key).paths.push(path);
    }
    for (const { robot, kind, ...style } of styles.values()) if (style.paths.length) this.#stroked(view, robot, kind, (stroke) => stroke(style));
  }

  /** Returns the path of `robot` since the tick; undefined if there is none. */
  #driven({ store, tick, share }, robot, kind) {
    const player = store.player(tick, robot.id), next = store.player(tick + 1, robot.id);
    const start = kind.pose(player), end = kind.pose(next), { period } = store.stage.mission;
    if (!start || !end || !kind.differs(player, next)) return undefined;
    const driven = kind.driven(player, next, period), path = new Path2D(), bends = bends_of(driven, period, this.plane.fine);
    path.moveTo(start[0], start[1]);
    for (let k = 1; k <= bends; k++) {
      const pose = between(start, end, driven, (share * k) / bends, period);
      path.lineTo(pose[0], pose[1]);
    }
    return path;
  }

  /** Calls `draw` with a function that strokes a piece of a trail, whose path is in m, in the style of its phase. */
  #stroked({ look, focus }, robot, kind, draw) {
    const pen = this.plane.context, faint = focus && robot.id !== focus;
    const ratio = (window.devicePixelRatio || 1) * unit(), { scale: s, width: wide, height, centre } = this.plane;
    pen.save();
    pen.globalAlpha = faint ? 0.4 : 0.95;
    pen.setTransform(ratio * s, 0, 0, -ratio * s, ratio * (wide / 2 - centre[0] * s), ratio * (height / 2 + centre[1] * s));
    draw(({ path, paths = [path], phase, role }, strength = 1) => {
      const hue = kind === REPORTED ? look.fault : look.robot[role];
      pen.strokeStyle = strength < 1 ? look.pale(hue, Math.round(100 * strength)) : hue;
      const { dash, width } = kind === REPORTED ? REPORTED_STYLE : TRAIL[phase] ?? TRAIL[2];
      this.plane.marks.add(kind === REPORTED ? "reported" : `path-${phase}`);
      pen.lineWidth = (faint ? 0.7 * width : width) / s;
      pen.setLineDash(dash.map((length) => length / s));
      for (const one of paths) pen.stroke(one);
    });
    pen.restore();
  }

  /**
   * Returns the trail from tick `from` to `to` in pieces { path, least, most, phase, role } of one style; cached once it is complete.
   *
   * `least` and `most` are the corners of a box around `path`.
   */
  #pieces(store, robot, kind, from, to) {
    const { fine } = this.plane, key = `${kind.name}/${robot.id}/${from}/${to - from}/${fine}`, cached = this.#chunks.get(key);
    if (cached) return cached;
    const pieces = [], period = store.stage.mission.period;
    let path = null, phase = null, role = null, complete = true;
    const to_pose = ([x, y]) => {
      const { least, most } = pieces.at(-1);
      path.lineTo(x, y);
      [x, y].forEach((one, i) => { least[i] = Math.min(least[i], one); most[i] = Math.max(most[i], one); });
    };
    for (let k = from; k < to; k++) {
      const here = store.player(k, robot.id), next = store.player(k + 1, robot.id);
      const start = kind.pose(here), end = kind.pose(next);
      if (!start || !end || !kind.differs(here, next)) {
        path = null; phase = null;
        complete = complete && Boolean(here && next);
        continue;
      }
      const now = here.command?.phase ?? phase ?? store.phase(k, robot.id);
      const hue = store.grouped ? store.role(k, robot.id) : robot.role;
      if (now !== phase || hue !== role || !path) {
        path = new Path2D();
        path.moveTo(start[0], start[1]);
        pieces.push({ path, least: start.slice(0, 2), most: start.slice(0, 2), phase: now, role: hue });
        phase = now;
        role = hue;
      }
      const driven = kind.driven(here, next, period), bends = bends_of(driven, period, fine);
      for (let bend = 1; bend < bends; bend++) to_pose(between(start, end, driven, bend / bends, period));
      to_pose(end);
    }
    const found = pieces.filter(({ least, most }) => least.some((one, i) => one !== most[i])); // a robot that stands leaves no path
    if (complete) this.#chunks.set(key, found);
    return found;
  }

  /** Draws the trail implied by the most probable current pose, or one per pose if none leads. */
  believed_trail(view, robot) {
    const { store, tick, share, moving } = view, now = store.player(tick, robot.id)?.held;
    if (!now?.local.length) return;
    const here = held_now({ ...view, moving: false }, robot).poses, there = held_now(view, robot).poses;
    const most = leads(now) ? 1 : MOST_TRAILS;
    const driven = moving && share > 0 ? store.player(tick + 1, robot.id)?.executed : null;
    for (let i = Math.min(here.length, most) - 1; i >= 0; i--) {
      this.#believed(view, robot, compose(here[i], inverse(now.local[now.world.length ? 0 : i])), there[i], driven, most > 1);
    }
  }

  /** Draws one implied trail. `turn` maps the anchor's frame to the plane; the trail ends at `there`. */
  #believed({ store, tick, share, look }, robot, turn, there, driven, faint) {
    const pen = this.plane.context, { period } = store.stage.mission;
    let phase = null, last = null;
    const go = (to, by, part) => {
      const bends = bends_of(by, period);
      for (let bend = 1; bend <= bends; bend++) {
        pen.lineTo(...this.plane.at(between(last, to, by, (part * bend) / bends, period)));
      }
    };
    pen.save();
    pen.globalAlpha = faint ? 0.4 : 0.8;
    for (let k = Math.max(store.first, tick - 4000); k <= tick; k++) {
      const player = store.player(k, robot.id);
      if (!player?.held?.local.length || (player.held.local.length > 1 && k < tick)) continue;
      const pose = compose(turn, player.held.local[0]), next = player.command?.phase ?? phase ?? store.phase(k, robot.id);
      if (phase !== null && last) go(pose, player.executed, 1);
      last = pose;
      if (next !== phase) {
        if (phase !== null) pen.stroke();
        phase = next;
        const { dash, width } = TRAIL[phase];
        this.plane.marks.add(`path-${phase}`);
        pen.setLineDash(dash);
        pen.lineWidth = width;
        pen.strokeStyle = look.robot[robot.role];
        pen.beginPath();
        pen.moveTo(...this.plane.at(pose));
      }
    }
    if (driven && last) {
      go(null, driven, share);
      pen.lineTo(...this.plane.at(there));
    }
    if (phase !== null) pen.stroke();
    pen.restore();
    pen.setLineDash([]);
  }
}

/** Returns the number of straight parts with which an arc is drawn: with `fine` parts in a metre at most. */
function bends_of(driven, period, fine = Infinity) {
  if (!driven) return 1;
  return Math.max(1, Math.min(4 * BENDS, Math.ceil(Math.abs(driven[0] * period) * fine), Math.ceil(Math.abs(driven[1] * period) * 4 * BENDS)));
}

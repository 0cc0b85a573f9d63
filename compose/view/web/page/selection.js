// What is under the pointer or selected on the plane: a robot, an anchor or a hypothesis, and a label with its numbers.

import { distance, wrap } from "./geometry.js";
import { metres, place, probability, rad } from "./words.js";

const REACH = 6; // pixels around the outline of a drawing
const NARROW_PX = 600; // below this width of the plane, the label is in its corner
const KINDS = ["robot", "hypothesis", "anchor"]; // the first one that is under the pointer is selected

/** True if two targets name the same thing. */
export const same = (one, other) => Boolean(one && other) && KINDS.includes(one.kind)
  && one.kind === other.kind && one.robot === other.robot && one.place === other.place;

/** Returns the target under the pointer at [x, y]; undefined if there is none. */
export function under(targets, at) {
  const near = targets.filter((one) => distance(one.at, at) <= one.radius + REACH);
  near.sort((one, other) => KINDS.indexOf(one.kind) - KINDS.indexOf(other.kind) || distance(one.at, at) - distance(other.at, at));
  return near[0];
}

/** Returns a target as in the address, for example "hypothesis.a.0"; null if there is none. */
export const written = (target) => target && [target.kind, target.robot, target.place].filter((part) => part !== undefined).join(".");

/** Returns the anchor or hypothesis that the address names; null if it names none. */
export function read(text) {
  const [kind, robot, at] = (text ?? "").split(".");
  if (kind === "anchor" && robot) return { kind, robot };
  return kind === "hypothesis" && robot && /^\d+$/.test(at) ? { kind, robot, place: Number(at) } : null;
}

/** Returns the lines of a target's label. */
export function numbers({ store, tick, truth }, { kind, robot, place: index }) {
  const player = store.player(tick, robot), setup = store.stage.robots.find(({ id }) => id === robot);
  if (kind === "anchor" && !setup?.anchor) return of_shared(store, tick, truth, robot);
  const range = player?.anchor_range === undefined ? "no range to it in this tick" : `range ${metres(player.anchor_range)}`;
  if (kind === "anchor") return [`anchor of ${robot}: ${place(setup.anchor)}`, range];
  if (kind === "robot") {
    const mutual = (player.contacts ?? []).map(([peer, far]) => `${peer}: ${far === null ? "in range" : `range ${metres(far)}`}`);
    const own = store.stage.team ? (player.anchors ?? []).map(([id, far]) => `${id}: range ${metres(far)}`) : [`anchor: ${range.replace("to it ", "")}`];
    return [`${robot}: ${posed(player.pose)}`, ...own, ...mutual];
  }
  const { held } = player, in_world = held.world.length > 0, poses = in_world ? held.world : held.local, pose = poses[index];
  const chance = held.probability[index] ?? 1 / poses.length;
  const lines = [`${robot}, hypothesis ${index + 1} of ${poses.length}: ${posed(pose)}`];
  lines.push(`probability ${probability(chance)}`);
  if (!in_world) lines.push("in its anchor's frame");
  else if (truth && player.pose) lines.push(`error ${metres(distance(pose, player.pose))}`);
  return lines;
}

/** Returns the lines of an anchor of a team: what the robots know of its position, where it is, and the ranges to it. */
function of_shared(store, tick, truth, id) {
  const { position, sigma, place: at } = store.stage.anchors.find((one) => one.id === id);
  const known = position ? `${id}: ${place(position)}${sigma ? `, sigma ${metres(sigma)}` : ", surveyed"}` : `${id}: position unknown to the robots`;
  const lines = [known, ...(truth && at && (sigma || !position) ? [`in truth at ${place(at)}`] : [])];
  for (const { robot, anchors } of store.scene(tick)?.players ?? []) {
    for (const [anchor, far] of anchors ?? []) if (anchor === id) lines.push(`${robot}: range ${metres(far)}`);
  }
  return lines;
}

const posed = (pose) => `${place(pose)}, ${rad(wrap(pose[2]))}`;

/** The label beside a target. */
export class Tip {
  constructor(element) { this.element = element; }

  /** Shows the numbers of `target`, in a plane of `width` x `height`; hides the label if there is no target. */
  draw(view, target, [width, height], unit) {
    const { element } = this;
    if (element.hidden === Boolean(target)) element.hidden = !target;
    if (!target) return;
    const lines = numbers(view, target).join("\n");
    if (element.textContent !== lines) element.textContent = lines;
    const [x, y] = target.at.map((one) => one * unit), away = (target.radius + REACH) * unit;
    if (width < NARROW_PX) return void Object.assign(element.style, { left: "0.5rem", top: `${height - element.offsetHeight - 8}px` });
    const fits = x + away + element.offsetWidth < width;
    element.style.left = `${Math.max(0, fits ? x + away : x - away - element.offsetWidth)}px`;
    element.style.top = `${Math.max(0, Math.min(y + away, height - element.offsetHeight))}px`;
  }
}

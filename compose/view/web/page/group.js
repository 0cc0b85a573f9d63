// What the page shows of a group: who localises whom, and how many robots are localised.

import { distance } from "./geometry.js";
import { DOTTED, line } from "./pen.js";
import { joined } from "./tints.js";
import { PHASES, plural, STEPS } from "./words.js";

const HEAD = 7; // the length in pixels of an arrow's head
const TRAVELLING = "travelling";

/** The names of marks whose hue says, in a group, whether a robot is localised. */
const HUES = { "robot-a": "localised", "robot-b": "unlocalised" };

/** Returns the names of the marks for the legend of a group. */
export const group_marks = (marks, team) => new Set([...[...marks].map((mark) => HUES[mark] ?? mark), ...(team ? [] : ["meeting"])]);

/** Draws a thin arrow for each meeting, between the anchors: dotted until the visited robot is localised. */
export function draw_tree(plane, { store, tick, look }) {
  const pen = plane.context, reach = store.stage.mission.sensing_range * plane.scale;
  for (const { visitor, visited } of store.stage.visits) {
    const anchors = [visitor, visited].map((id) => store.stage.robots[store.places.get(id)].anchor), [from, to] = anchors.map((one) => plane.at(one));
    if (!plane.sees(...[Math.min, Math.max].map((end) => [0, 1].map((i) => end(...anchors.map((one) => one[i])))))) continue;
    const length = distance(from, to), done = store.role(tick, visited) === "a";
    if (length < 2 * reach) continue;
    const ahead = [(to[0] - from[0]) / length, (to[1] - from[1]) / length];
    const at = (way, across = 0) => [from[0] + way * ahead[0] - across * ahead[1], from[1] + way * ahead[1] + across * ahead[0]];
    const tip = length - reach - 2;
    pen.fillStyle = done ? look.robot.a : look.orbit;
    pen.globalAlpha = done ? 0.75 : 0.8;
    line(pen, [at(reach + 2), at(tip - HEAD)], pen.fillStyle, done ? 1.3 : 1, done ? [] : DOTTED);
    pen.beginPath();
    pen.moveTo(...at(tip)); pen.lineTo(...at(tip - HEAD, 0.4 * HEAD)); pen.lineTo(...at(tip - HEAD, -0.4 * HEAD));
    pen.closePath();
    pen.fill();
  }
  pen.globalAlpha = 1;
}

/** Returns the robots in contact in a scene, each pair once, the one that is named first in the scenario first. */
export function links({ scene, store }) {
  const place = (id) => store.places.get(id);
  return scene.players.flatMap(({ robot, contacts }) =>
    (contacts ?? []).filter(([peer]) => place(peer) > place(robot)).map(([peer]) => [store.stage.robots[place(robot)], peer]));
}

/** Returns whether `robot` is the first one of a pair of a group whose configurations are known in the tick or before it. */
export function heads({ store, scene, tick }, robot) {
  return [scene, store.scene(tick - 1)].some((one) => joined(one, robot.id)?.robots[0] === robot.id);
}

/** Returns what a robot does, in a few words for its button. */
export function task(player, robot) {
  if (!player?.command) return "–";
  const { state, verdict, phase } = player.command;
  if (state === TRAVELLING) return `to ${robot.peer}`;
  if (state === "localised" || (verdict && verdict[0] !== "localised")) return verdict?.[0] ?? state;
  if (waits(player)) return "waiting";
  if (phase === 3 && robot.anchor && state !== "looping") return `meets ${robot.peer}`;
  if (state === "sweeping") return "covers the area";
  return robot.own_planner || state === "looping" ? state : (robot.peer ? PHASES : STEPS)[phase];
}

/** Returns whether a robot waits for another one: beside its anchor, or without an anchor where it is. */
const waits = ({ command }) => (
  (command?.state === "orbiting" && command.v === 0 && command.omega === 0) || (command?.state === "standing" && command.phase === 2)
);

/** Returns how many robots are localised, travel to others, wait for them, and do something else. */
export function counted(players, team) {
  const is = (kind) => players.filter((player) => player?.command?.verdict?.[0] === kind).length;
  const travelling = players.filter((player) => player?.command?.state === TRAVELLING).length;
  const waiting = players.filter((player) => player && waits(player)).length;
  const covering = players.filter((player) => ["sweeping", "looping"].includes(player?.command?.state) && player.command.verdict).length;
  const others = ["inconsistent", "undecided"].filter(is).map((kind) => `${is(kind)} ${kind}`);
  const ways = [`${travelling} travelling`, ...(covering ? [`${covering} covering the area`] : []), `${waiting} waiting`];
  return [...others, `${is("localised")} of ${plural(players.length, "robot")} localised`, ...(team ? [] : ways)].join(", ");
}

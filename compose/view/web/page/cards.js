// The cards beside the plane: each robot's activity, measurements, command and posterior.

import { distance, wrap } from "./geometry.js";
import { counted, task } from "./group.js";
import { leads } from "./held.js";
import { LEAST_GAP_M } from "./trails.js";
import { metres, probability, PHASES, place, rad, speed, STEPS, turning } from "./words.js";

const MOST_PROBABILITIES = 5;
const MANY = 4;
const OUTCOMES = ["inconsistent", "undecided", "running", "localised"]; // the worst first

export class Cards {
  constructor(root, roster, choose) {
    Object.assign(this, { root, roster, choose });
  }

  stage(store) {
    this.store = store;
    this.cards = new Map();
    this.root.replaceChildren();
    this.many = store.stage.robots.length > MANY;
    this.roster.hidden = !this.many;
    this.roster.replaceChildren();
    this.roster.classList.toggle("group", store.grouped);
    this.entries = new Map();
    this.key = this.order = "";
    if (!this.many) return;
    this.counts = this.roster.appendChild(make("p", { id: "counts" }));
    for (const robot of store.stage.robots) {
      const entry = make("button", { type: "button", className: "entry" });
      entry.addEventListener("click", () => this.choose(robot.id));
      this.roster.append(entry);
      entry.dataset.role = robot.role;
      this.entries.set(robot.id, entry);
    }
  }

  /** Shows the robots in `tick`; of many, the one with the `focus` or the first one that is `told` of, and its peer. */
  draw({ tick, focus, truth, told }) {
    const { store } = this, robots = store.stage.robots, subject = focus ?? told.find((one) => one.robots?.length)?.robots[0];
    const key = [tick, focus, subject, truth, store.revision, Math.min(store.whole, tick)].join(), scene = store.scene(tick);
    if (key === this.key && scene === this.scene) return; // the scene of the last tick is replaced when a process ends
    Object.assign(this, { key, scene });
    const shown = store.few(subject, MANY).filter((robot) => truth || !focus || robot.id === focus);
    for (const [id, card] of this.cards) if (!shown.some((robot) => robot.id === id)) { card.root.remove(); this.cards.delete(id); }
    for (const robot of shown) {
      if (!this.cards.has(robot.id)) this.cards.set(robot.id, new Card(robot, this.choose));
      const card = this.cards.get(robot.id);
      if (this.root.children[shown.indexOf(robot)] !== card.root) this.root.append(card.root);
      card.draw(store, tick, truth, focus === robot.id);
    }
    if (!this.many) return;
    this.#rank(tick);
    for (const [id, entry] of this.entries) {
      const player = store.player(tick, id), phase = player ? store.phase(tick, id) : 0;
      const robot = robots[store.places.get(id)], state = task(player, robot);
      const text = `${id} ${player?.down ? "is down" : state}`;
      if (entry.textContent !== text) entry.textContent = text;
      for (const [name, value] of Object.entries({ "data-role": robot.role, "data-phase": phase, "aria-pressed": id === focus, "aria-label": player?.activity ?? id })) attribute(entry, name, String(value));
    }
  }

  /** Counts the robots by outcome in `tick`, and sorts their buttons: the worst first. */
  #rank(tick) {
    const groups = new Map(OUTCOMES.map((outcome) => [outcome, []]));
    for (const id of this.entries.keys()) groups.get(this.store.player(tick, id)?.command?.verdict?.[0] ?? "running").push(id);
    const players = [...this.entries.keys()].map((id) => this.store.player(tick, id));
    const counts = this.store.grouped ? [counted(players, this.store.stage.team)] : OUTCOMES.filter((outcome) => groups.get(outcome).length).map((outcome) => `${groups.get(outcome).length} ${outcome}`);
    if (this.counts.textContent !== counts.join(", ")) this.counts.textContent = counts.join(", ");
    const sorted = [...groups.values()].flat(), order = sorted.join();
    if (order === this.order) return;
    this.order = order;
    const focused = document.activeElement;
    this.roster.append(...sorted.map((id) => this.entries.get(id)));
    if (this.roster.contains(focused)) focused.focus({ preventScroll: true });
  }
}

class Card {
  constructor(robot, choose) {
    this.robot = robot;
    this.root = make("article", { className: "card", tabIndex: -1 });
    this.root.dataset.robot = robot.id;
    this.root.dataset.role = robot.role;
    this.root.setAttribute("aria-label", `Robot ${robot.id}`);
    this.name = make("button", { type: "button", className: "name", textContent: robot.id });
    this.name.addEventListener("click", () => choose(robot.id));
    this.phase = make("span", { className: "phase" });
    this.error = make("span", { className: "error" });
    this.doing = make("p", { className: "doing" });
    this.attack = make("p", { className: "attack", hidden: true });
    this.rows = make("dl", {});
    this.probability = make("ol", { className: "probability" });
    this.root.append(make("div", { className: "line" }, this.name, this.phase, this.error), this.doing, this.attack, this.rows, this.probability);
    this.fields = new Map();
  }

  #row(name, text) {
    if (!this.fields.has(name)) {
      const value = make("dd", {}), title = make("dt", { textContent: name });
      value.dataset.row = title.dataset.row = name;
      this.rows.append(title, value);
      this.fields.set(name, value);
    }
    const value = this.fields.get(name);
    if (value.textContent !== text) value.textContent = text;
  }

  draw(store, tick, truth, chosen) {
    const player = store.player(tick, this.robot.id);
    this.root.classList.toggle("chosen", chosen);
    this.root.dataset.role = this.robot.role;
    this.name.setAttribute("aria-pressed", String(chosen));
    this.name.title = chosen ? "Show all robots (A)" : `Show the posterior of ${this.robot.id}`;
    if (!player) return void (this.doing.textContent = "…");
    const { command, held } = player;
    const phase = store.phase(tick, this.robot.id);
    this.root.dataset.phase = phase;
    this.root.classList.toggle("down", Boolean(player.down));
    const words = store.stage.team ? STEPS[phase] : `phase ${phase}${this.robot.own_planner ? "" : `: ${PHASES[phase]}`}`;
    this.phase.textContent = `${words}${player.down ? "; down" : ""}`;
    if (this.doing.textContent !== player.activity) this.doing.textContent = player.activity;
    const attack = truth && player.reported ? attacked(player) : "";
    if (this.attack.textContent !== attack) this.attack.textContent = attack;
    this.attack.hidden = !attack;
    const [off, range] = truth && player.pose && held?.world.length ? error(held, player.pose) : ["", ""];
    this.error.textContent = off;
    this.error.title = range;
    this.#row("measured", measured(player) || "nothing");
    this.#row("command", command ? commanded(command) : "–");
    this.#row("posterior", held ? believed(held) : "–");
    if (truth) this.#row("true pose", player.pose ? `${place(player.pose)}, ${rad(player.pose[2])}` : "unknown");
    else if (this.fields.has("true pose")) this.#row("true pose", "hidden");
    this.#probability(held);
  }

  #probability(held) {
    const bars = held?.probability.length > 1 ? held.probability.slice(0, MOST_PROBABILITIES) : [];
    this.probability.hidden = !bars.length;
    while (this.probability.children.length > bars.length) this.probability.lastChild.remove();
    bars.forEach((chance, i) => {
      const bar = this.probability.children[i] ?? this.probability.appendChild(make("li", {}, make("i", {}), make("span", {})));
      bar.firstChild.style.width = `${100 * chance}%`;
      bar.lastChild.textContent = probability(chance);
    });
  }
}

/**
 * Returns the position error as text, and its explanation.
 *
 * The error is that of the leading pose, or, if no pose leads, the largest of all hypotheses.
 */
function error(held, pose) {
  const off = held.world.map((one) => distance(one, pose)), least = metres(Math.min(...off)), most = metres(Math.max(...off));
  if (leads(held)) return [`error ${metres(off[0])}`, ""];
  return [`error up to ${most}`, `${least} to ${most}: ${off.length} poses are possible, and none has a probability above 50 %`];
}

/** Returns how far off the position is that an attacker reports. */
const attacked = ({ robot, reported: { gap } }) => `${robot} ${gap < LEAST_GAP_M ? "has reported its true position so far" : `reports a position ${metres(gap)} from its true one`}.`;

/** Returns the odometry and the ranges of a tick, and nothing for what has no range. */
function measured({ sensed, executed, anchor_range, anchors, contacts }) {
  if (!sensed) return "unknown";
  const ranged = ([id, range]) => `${id}\u00a0${range === null ? "in\u00a0range, not measured" : metres(range).replace(" ", "\u00a0")}`;
  const own = anchor_range === undefined ? [] : [["anchor", anchor_range]];
  const ranges = [...own, ...(anchors ?? []), ...(contacts ?? [])].map(ranged).join(", ");
  return [executed && `odometry ${speed(executed[0])}, ${turning(executed[1])}`, ranges].filter(Boolean).join("; ");
}

const commanded = ({ v, omega }) => (v === 0 && omega === 0 ? "stop" : `${speed(v)}, ${turning(omega)}`);

function believed({ local, world, probability: chances, covariance, localised }) {
  const sigma = covariance && world.length ? `, sigma ${metres(Math.sqrt(Math.max(0, covariance[0] + covariance[3])))}` : "";
  if (world.length === 1) {
    const at = `${place(world[0])}, ${rad(wrap(world[0][2]))}${sigma}`;
    return localised ? `localised at ${at}` : `1 hypothesis: ${at}`;
  }
  if (world.length) return `${world.length} hypotheses${chances.length ? "" : ", equally probable"}${sigma}`;
  if (local.length > 1) return `${local.length} hypotheses in the anchor's frame`;
  if (local.length) return `${metres(Math.hypot(local[0][0], local[0][1]))} from its anchor, bearing unknown`;
  return "pose unknown";
}

/** Sets an attribute only if it changes: else the browser computes styles and the layout again. */
export function attribute(element, name, value) {
  if (element.getAttribute(name) !== value) element.setAttribute(name, value);
}

export function make(tag, properties, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

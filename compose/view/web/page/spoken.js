// What screen readers read: the plane in a sentence, and the events of a tick.

import { leads } from "./held.js";
import { place, rad, said } from "./words.js";

const ANNOUNCE_MS = 900;
const MOST_ROBOTS = 4;
const MOST_EVENTS = 6;

const of_robots = (store, { tick, focus }) =>
  (store.scene(tick)?.players ?? []).filter((player) => !focus || player.robot === focus).slice(0, MOST_ROBOTS);

/** Returns what the robots are doing. */
export const activities = (store, view) => of_robots(store, view).map((player) => player.activity).join(". ");

/** Returns where the robots are. */
export function described(store, view) {
  if (!store.scene(view.tick)) return `Tick ${view.tick}, not loaded yet`;
  const at = of_robots(store, view).map((player) => {
    const { robot, held } = player, pose = view.truth ? player.pose : held && leads(held) ? held.world[0] : null;
    if (pose) return `${robot} at ${place(pose)}, heading ${rad(pose[2])}`;
    return held?.world.length > 1 ? `${robot} at one of ${held.world.length} poses` : `${robot} at an unknown pose`;
  });
  return `The plane at tick ${view.tick}: ${at.join("; ")}`;
}

/** Announces the events of each tick, at most once per ANNOUNCE_MS while time passes. */
export class Announcer {
  #tick = null;
  #at = 0;

  /** Returns the text to announce now; null if there is none. */
  text(store, view, now) {
    const scene = store.scene(view.tick), passing = view.playing || view.follow;
    if (!scene || this.#tick === view.tick || (passing && now - this.#at < ANNOUNCE_MS)) return null;
    this.#tick = view.tick;
    this.#at = now;
    const events = scene.events.filter((event) => !view.focus || !event.robot || event.robot === view.focus).slice(0, MOST_EVENTS);
    const texts = events.map((event) => said(event, view.truth));
    return texts.length || !passing ? `Tick ${view.tick}. ${texts.join(". ") || activities(store, view)}` : null;
  }
}

// The client-side copy of one mission: its static data and its scenes by tick. The server pushes the newest
// scenes; the store fetches all others in the background.

import * as data from "./data.js";

export class Store {
  constructor(name, mission, changed) {
    Object.assign(this, { name, stage: mission.stage, state: mission, version: mission.version, onforget: () => {} });
    Object.assign(this, { scenes: [], wanted: 0, closed: false, revision: 0 });
    this.places = new Map(mission.stage.robots.map((robot, place) => [robot.id, place]));
    this.#changed = changed;
    this.#fill();
  }

  #changed;
  #whole = 0;
  #wake = null;
  #failed = 0;
  #near = false;
  #stale = Infinity;

  get last() { return this.state.last; }
  get first() { return this.state.first; }
  get live() { return this.state.live; }
  /** True if the ground truth of any tick is known. */
  get has_truth() { return this.state.has_truth; }
  get end() { return this.state.end; }
  /** The first tick that is not loaded; all earlier ticks are. */
  get whole() { return this.#whole; }

  close() {
    this.closed = true;
    this.#wake?.();
  }

  /** True if the robots form no pairs: they are a group, which meets in turn, or a team. */
  get grouped() { return this.stage.visits?.length > 0 || this.stage.team; }

  /** True for an estimate from recorded ranges: nobody knows how far radios reach, or what robots were told. */
  get estimated() { return this.stage.mode === "estimate"; }

  /** Returns where an anchor of a team is drawn: with the `truth` where it is, else where robots know it; null if nowhere. */
  anchor_at({ position, place }, truth) { return (truth ? place : null) ?? position; }

  scene(tick) { return this.scenes[tick]; }

  player(tick, robot) { return this.scenes[tick]?.players[this.places.get(robot)]; }

  /** Returns the robot's latest command up to `tick`; undefined if there is none. */
  #command(tick, robot) {
    for (let k = tick; k >= this.first; k--) {
      const command = this.player(k, robot)?.command;
      if (command) return command;
    }
    return undefined;
  }

  /** Returns the phase of the robot's latest command up to `tick`; 1 if there is none. */
  phase(tick, robot) { return this.#command(tick, robot)?.phase ?? 1; }

  /** Returns the role of a robot, and in a group "a" once it is localised and "b" before: the hue of what is drawn. */
  role(tick, robot) {
    if (!this.grouped) return this.stage.robots[this.places.get(robot)].role;
    return this.#command(tick, robot)?.verdict?.[0] === "localised" ? "a" : "b";
  }

  /** Gives the robots of a group the role and the peer that they have in `tick`. */
  show(tick) {
    if (!this.grouped || !this.scenes[tick]) return;
    for (const robot of this.stage.robots) {
      robot.role = this.role(tick, robot.id);
      robot.peer = this.player(tick, robot.id)?.peer ?? robot.peer;
    }
  }

  /** Returns the robot with the name `focus`; else the first one, in a group of those that meet first. */
  chosen(focus) {
    const { robots, visits } = this.stage, named = (id) => robots.find((robot) => robot.id === id);
    return named(focus) ?? named(visits?.[0]?.visitor) ?? robots[0];
  }

  /** Returns all robots if they are at most `most`, else the chosen one and its peer. */
  few(focus, most) {
    const { robots } = this.stage, chosen = this.chosen(focus);
    return robots.length <= most ? robots : robots.filter((robot) => robot === chosen || robot.id === chosen.peer);
  }

  /** Gives `tick` priority in the background fetches. */
  want(tick) {
    this.wanted = tick;
    if (!this.scenes[tick]) this.#wake?.();
  }

  /** Applies an update that the server has pushed. */
  update(news) {
    const robots = this.stage.robots.length;
    this.state = news;
    if (news.from !== null && news.from !== undefined) this.#forget(news.from);
    for (const scene of news.scenes) this.scenes[scene.tick] = scene;
    this.#advance();
    this.#wake?.();
    if (news.robots !== robots) this.#restage();
    this.#changed();
  }

  async #restage() {
    const mission = await data.mission(this.name);
    this.stage = mission.stage;
    this.places = new Map(mission.stage.robots.map((robot, place) => [robot.id, place]));
    this.#forget(0);
    this.onstage?.();
  }

  #forget(from) {
    this.#stale = Math.min(this.#stale, from);
    if (from < this.scenes.length) {
      this.scenes.length = from;
      this.revision += 1;
    }
    this.#whole = Math.min(this.#whole, from);
    this.onforget(from);
  }

  #advance() {
    while (this.scenes[this.#whole] || this.#whole < this.first) this.#whole += 1;
  }

  /** Returns the tick from which to fetch; null if none is missing. Ticks near the wanted one and all others take turns. */
  #missing() {
    this.#near = !this.#near;
    const near = Math.max(this.wanted - 3, this.first);
    if (this.#near) for (let tick = near; tick <= Math.min(this.wanted, this.last); tick++) if (!this.scenes[tick]) return tick;
    return this.#whole <= this.last ? this.#whole : null;
  }

  async #fill() {
    while (!this.closed) {
      const from = this.#missing();
      if (from === null) {
        await new Promise((resolve) => { this.#wake = resolve; });
        this.#wake = null;
        continue;
      }
      try {
        this.#stale = Infinity;
        const answer = await data.scenes(this.name, from, this.last);
        for (const scene of answer.scenes) if (scene.tick < this.#stale) this.scenes[scene.tick] = scene;
        for (let tick = answer.from; tick <= Math.min(answer.to, this.#stale - 1); tick++) {
          this.scenes[tick] ??= { tick, players: this.stage.robots.map(unknown), passages: [], events: [] };
        }
        this.#failed = 0;
        this.#advance();
        this.#changed();
      } catch {
        this.#failed += 1;
        await new Promise((resolve) => setTimeout(resolve, Math.min(200 * this.#failed, 3000)));
      }
      if (this.live) await new Promise((resolve) => setTimeout(resolve, 50));
    }
  }
}

const unknown = (robot) => ({ robot: robot.id, activity: `no data of ${robot.id} in this tick` });

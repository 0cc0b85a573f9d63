// Guided play. Time passes fast between the ticks with captions, the beats, and stops at each caption. A mission of any
// length takes about a minute.

const SEARCH_S = 6; // phases 1 and 2 together, and again the time after the pair has finished
const ENCOUNTER_S = 24; // the ticks of phase 3 together
const GROUP_S = 24; // the ticks of a group's mission together
const LONGEST_TICK_S = { search: 0.25, encounter: 1.5 };
const MANOEUVRE_S = 2.5;
/** For how long time stops at least at captions whose contents are shown bit by bit, in s. */
const SHOWN_S = { measured: 3.5, configurations: 6 };
/** How much of an elimination has been shown when all configurations that are ruled out are crossed out. */
const ALMOST = 0.999;
const HOLDS_S = 45; // all captions together
// Captions of kills and faults are no part of the story, which goes on after them. Time stops at each kill, and at the
// first fault of each kind.
const KILLS = new Set(["down", "back", "cut"]);
const FAULTS = new Set([...KILLS, "late", "report-lost", "report-damaged", "report-late", "report-doubled"]);

export class Guide {
  stage(store) {
    Object.assign(this, { store, beats: [], read: 0 });
    this.#span = null;
  }

  #span;

  /** Discards the captions of `tick` and later, because they have changed. */
  forget(tick) {
    this.read = Math.min(this.read, tick);
    while (this.beats.length && this.beats.at(-1).tick >= tick) this.beats.pop();
    this.#span = null;
  }

  /** Returns the robots that the story follows: the pair of the selected robot, or the first one; else a whole group. */
  pair(focus) {
    const { robots } = this.store.stage;
    if (this.store.grouped && !focus) return robots;
    const chosen = robots.find((robot) => robot.id === focus) ?? robots[0];
    return robots.filter((robot) => robot === chosen || robot.id === chosen.peer);
  }

  /** Returns the captions of `tick` about the pair or about all robots. */
  captions({ tick, focus, truth }) {
    return this.#about(this.store.scene(tick)?.captions ?? [], focus).filter((one) => one.text || truth);
  }

  #about(captions, focus) {
    if (this.store.grouped && !focus) return captions;
    const one = this.store.grouped ? focus : this.pair(focus)[0].id;
    return captions.filter(({ robots }) => !robots?.length || robots.includes(one));
  }

  #read() {
    for (; this.read < this.store.whole; this.read++) {
      const captions = this.store.scene(this.read)?.captions ?? [];
      if (captions.length) this.beats.push({ tick: this.read, captions });
    }
  }

  /** Returns the captions to show: the current one, all of the tick if time has stopped, or the latest one. */
  told(view) {
    this.#read();
    const here = this.captions(view);
    if (here.length) return view.beat === null ? here : [here[Math.min(view.beat, here.length - 1)]];
    for (let i = this.beats.length - 1; i >= 0; i--) {
      if (this.beats[i].tick >= view.tick) continue;
      const earlier = this.#about(this.beats[i].captions, view.focus).filter(({ kind }) => !FAULTS.has(kind));
      if (earlier.length) return [earlier.at(-1)];
    }
    return [];
  }

  /** Returns how much of the elimination of configurations has been shown in this tick, from 0 to 1. */
  eliminated(view) {
    if (view.beat === null) return 1;
    const here = this.captions(view), first = here.findIndex(({ kind }) => kind === "measured");
    const last = here.findLastIndex(({ kind }) => kind === "ruled-out");
    if (first < 0 || view.beat > last) return 1;
    if (view.beat !== first) return view.beat < first ? 0 : ALMOST;
    return Math.min(ALMOST, view.held / this.#hold(here[first], view.focus));
  }

  /** Returns whether the last manoeuvre of this tick may be shown: its caption, if there is one, has been reached. */
  planned(view) {
    const place = this.captions(view).findIndex(({ kind }) => kind === "manoeuvre");
    return view.beat === null || view.beat >= place;
  }

  /** Returns the part of a whole turn that the path of a driven robot has been turned about its anchor; null once that is told. */
  turned(view) {
    const here = this.captions(view), place = here.findIndex(({ kind }) => kind === "configurations");
    if (view.beat === null || place < 0) return 1;
    return view.beat === place ? Math.min(ALMOST, view.held / this.#hold(here[place], view.focus)) : null;
  }

  /** Passes `s` seconds. Returns false once the story has ended. */
  advance(view, s) {
    const { store } = this;
    this.#read();
    view.beat ??= 0;
    for (let left = s; left > 0;) {
      if (!store.scene(view.tick)) return true; // it is being loaded
      const here = this.captions(view);
      if (view.beat < here.length) {
        const rest = this.#hold(here[view.beat], view.focus) - view.held;
        if (left < rest) { view.held += left; return true; }
        left -= rest;
        view.beat += 1;
        view.held = 0;
        continue;
      }
      if (view.tick >= store.last) return false;
      const lasts = this.#lasts(view, here), rest = (1 - view.share) * lasts;
      if (left < rest) { view.share += left / lasts; return true; }
      left -= rest;
      Object.assign(view, { tick: view.tick + 1, share: 0, beat: 0, held: 0 });
    }
    return true;
  }

  /** Returns for how many seconds time stops at a caption: long enough to read it. */
  #hold(caption, focus) {
    const seconds = (one) => {
      const reading = Math.min(1 + 0.03 * (one.text.length + (one.truth?.length ?? 0)), 4.5);
      return Math.max(reading, SHOWN_S[one.kind] ?? 0);
    };
    const first = new Map(), told = this.beats.flatMap(({ captions }) => this.#about(captions, focus));
    for (const one of told) if (!first.has(one.kind)) first.set(one.kind, one);
    const stops = (one) => !FAULTS.has(one.kind) || KILLS.has(one.kind) || first.get(one.kind) === one;
    const all = told.reduce((sum, one) => sum + (stops(one) ? seconds(one) : 0), 0);
    return stops(caption) ? seconds(caption) * Math.min(1, HOLDS_S / Math.max(all, 1)) : 0;
  }

  /** Returns the seconds that the robots drive from this tick to the next. */
  #lasts({ tick, focus }, captions) {
    const { store } = this;
    if (store.grouped) return Math.min(GROUP_S / Math.max(store.last - store.first, 1), LONGEST_TICK_S.search);
    const { from, to } = this.#encounter(focus);
    if (tick < from || tick >= to) {
      const ticks = tick < from ? from - store.first : store.last - to;
      return Math.min(SEARCH_S / Math.max(ticks, 1), LONGEST_TICK_S.search);
    }
    const usual = Math.min(ENCOUNTER_S / Math.max(Math.min(to, store.last) - from, 1), LONGEST_TICK_S.encounter);
    return captions.some(({ kind }) => kind === "manoeuvre") ? Math.max(usual, MANOEUVRE_S) : usual;
  }

  /** Returns the tick in which the pair's phase 3 begins, and that in which both have a verdict, as far as known. */
  #encounter(focus) {
    const { store } = this, pair = this.pair(focus), key = pair[0].id;
    if (this.#span?.key !== key) this.#span = { key, read: store.first, from: null, to: null };
    const span = this.#span;
    for (; span.read < store.whole && span.to === null; span.read++) {
      const commands = pair.map((robot) => store.player(span.read, robot.id)?.command);
      const met = (robot) => this.store.player(span.read, robot.id)?.contacts?.length > 0; // a planner of the user has phases of its own
      if (span.from === null && (pair[0].own_planner ? pair.some(met) : commands.some((command) => command?.phase === 3))) span.from = span.read;
      if (commands.every((command) => command?.verdict)) span.to = span.read;
    }
    return { from: span.from ?? span.to ?? store.last, to: span.to ?? Infinity };
  }
}

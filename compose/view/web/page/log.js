// The event log, one line per event; selecting one goes to its tick. Only events near the tick are in the DOM.

import { make } from "./cards.js";
import { SIGNS, said } from "./words.js";

const NEAR = 60;

export class Log {
  constructor(root, states, radio, go) {
    Object.assign(this, { root, states, radio, go });
    for (const box of [states, radio]) box.addEventListener("change", () => { this.dirty = true; this.onchange?.(); });
  }

  stage(store) {
    Object.assign(this, { store, events: [], read: 0, dirty: true });
  }

  #read() {
    const { store } = this;
    for (; this.read < store.whole; this.read++) {
      const events = store.scene(this.read)?.events ?? [];
      if (events.length) { this.events.push(...events); this.dirty = true; }
    }
  }

  /** Discards the events of `tick` and later, because they have changed. */
  forget(tick) {
    if (tick >= this.read) return;
    this.read = tick;
    while (this.events.length && this.events.at(-1).tick >= tick) this.events.pop();
    this.dirty = true;
  }

  #wanted(event, focus) {
    if (!this.states.checked && event.kind === "state") return false;
    if (!this.radio.checked && event.kind.startsWith("report")) return false;
    if (!focus || event.robot === null || event.robot === focus) return true;
    return event.kind.startsWith("contact") && this.store.stage.robots.some((r) => r.id === focus && r.peer === event.robot);
  }

  /** Returns the tick of the nearest visible event before (-1) or after (+1) `tick`. */
  next(tick, direction, focus) {
    this.#read();
    const ticks = this.events.filter((event) => this.#wanted(event, focus)).map((event) => event.tick);
    return direction > 0 ? ticks.find((k) => k > tick) : ticks.findLast((k) => k < tick);
  }

  draw({ tick, focus, truth }) {
    this.#read();
    if (!this.dirty && this.tick === tick && this.focus === focus && this.truth === truth) return;
    const only = truth ? null : focus;
    const wanted = this.events.filter((event) => this.#wanted(event, only ?? focus));
    let now = wanted.findIndex((event) => event.tick >= tick);
    if (now < 0) now = wanted.length;
    const from = Math.max(0, now - NEAR), shown = wanted.slice(from, now + NEAR);
    if (truth !== this.truth) this.#items = new WeakMap();
    const items = new Set(shown.map((event) => this.#item(event, truth)));
    for (const item of [...this.root.children]) if (!items.has(item)) item.remove();
    let after = this.root.firstChild; // only what has come into the list is laid out again
    for (const item of items) if (item === after) after = after.nextSibling; else this.root.insertBefore(item, after);
    let current = null;
    for (const item of this.root.children) {
      const there = Number(item.dataset.tick);
      item.classList.toggle("now", there === tick);
      item.classList.toggle("ahead", there > tick);
      if (there <= tick) current = item;
    }
    if (current && (this.tick !== tick || this.dirty)) {
      const top = current.offsetTop - this.root.offsetTop;
      this.root.scrollTop = Math.max(0, top - this.root.clientHeight + current.offsetHeight + 30);
    }
    Object.assign(this, { dirty: false, tick, focus, truth });
  }

  #items = new WeakMap();

  /** Returns the line of an event; the same one at each call. */
  #item(event, truth) {
    if (this.#items.has(event)) return this.#items.get(event);
    const sign = make("span", { className: "sign", textContent: SIGNS[event.kind] });
    sign.setAttribute("aria-hidden", "true");
    const go = make("button", { type: "button" }, make("b", { textContent: event.tick }), sign, make("span", { textContent: said(event, truth) }));
    go.addEventListener("click", () => this.go(event.tick));
    const item = make("li", {}, go);
    item.dataset.tick = event.tick;
    item.dataset.kind = event.kind;
    this.#items.set(event, item);
    return item;
  }
}

// The form that changes the scenario of a mission and runs it again: values, handles on the plane, and buttons.

import { make } from "./cards.js";
import * as data from "./data.js";
import { distance } from "./geometry.js";
import { circle, DASHED, OUTLINED, shape, stroked } from "./pen.js";

/** The distance in pixels from a handle within which a pointer takes it. */
const REACH_PX = 12;
/** The size in pixels of a start and of an anchor on the plane. */
const START_PX = 9, ANCHOR_PX = 6;
/** The values of the whole mission: name, label, and for its value as recorded the largest one of its slider. */
const COMMON = [
  ["sensing_range", "sensing range R in m", (value) => 2 * value],
  ["sigma", "sigma of ranges in m", (value) => Math.max(4 * value, 0.2)],
  ["loss", "reports lost", () => 1],
];
/** The values of one robot: name and label. */
const OWN = [["x", "start x in m"], ["y", "start y in m"], ["heading", "heading in rad"], ["anchor_x", "anchor x in m"], ["anchor_y", "anchor y in m"]];

export class Changes {
  /** `shown` is called with the name of a mission that has been run; `redraw` after each change. */
  constructor(section, { redraw, shown }) {
    Object.assign(this, { section, redraw, shown });
    this.error = section.querySelector("[role=alert]");
    this.robot = section.querySelector("select");
    const numbers = section.querySelectorAll("dl");
    this.common = COMMON.map(([name, label]) => slider(numbers[0], name, label, (value) => this.#set(name, value)));
    this.own = OWN.map(([name, label]) => number(numbers[1], label, (value) => this.#set_own(name, value)));
    this.robot.addEventListener("change", () => this.#fill());
    const actions = { save: () => this.#save(), reset: () => this.#reset(), close: () => this.close() };
    for (const button of section.querySelectorAll("button[type=button]")) button.addEventListener("click", actions[button.name]);
    section.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#run();
    });
  }

  /** The values as changed; null while the form is closed or they are being loaded. */
  values = null;
  #recorded = null;
  #name = "";
  #title = "";
  #running = false;

  get open() { return !this.section.hidden; }

  /** Opens the form for the mission of `store`, with its values. */
  async stage(store) {
    this.section.hidden = false;
    this.section.closest("main").scrollTop = 0; // in a narrow window, the form is below the plane
    this.values = null;
    this.#name = store.name;
    this.#title = store.stage.name;
    this.#say("");
    const answer = await data.values(store.name);
    if (!this.open || this.#name !== store.name) return;
    if (answer.error) return void this.#say(answer.error);
    this.#recorded = answer;
    const ids = Object.keys(answer.robots), chosen = this.robot.value;
    this.robot.replaceChildren(...ids.map((id) => make("option", { value: id, textContent: id })));
    if (ids.includes(chosen)) this.robot.value = chosen;
    for (const [i, [name, , most]] of COMMON.entries()) this.common[i].limit(most(answer[name]));
    this.#reset();
  }

  close() {
    this.section.hidden = true;
    this.values = null;
    this.redraw();
  }

  #reset() {
    this.values = structuredClone(this.#recorded);
    this.#say("");
    this.#fill();
  }

  #set(name, value) {
    if (this.values) this.values[name] = value;
    this.#fill();
  }

  #set_own(name, value) {
    if (this.values) this.values.robots[this.robot.value][name] = value;
    this.#fill();
  }

  /** Shows the values in all fields except the one that is being edited. */
  #fill() {
    const off = !this.values || this.#running;
    for (const one of this.section.querySelectorAll("input, select, button:not([name=close])")) one.disabled = off;
    if (this.values) {
      for (const [i, [name]] of COMMON.entries()) this.common[i].show(this.values[name]);
      for (const [i, [name]] of OWN.entries()) this.own[i].show(this.values.robots[this.robot.value][name] ?? null);
    }
    this.redraw();
  }

  #say(line) {
    this.error.textContent = line;
    this.error.hidden = !line;
    if (!this.values) this.#fill();
  }

  // --- running and saving ---

  async #asked(what) {
    if (!this.section.reportValidity()) return null; // a field is empty
    const name = this.#name;
    this.#running = true;
    this.#say("");
    this.#fill();
    const answer = await what(name, this.values).catch(() => ({ error: "the server does not answer" }));
    this.#running = false;
    if (!this.open || this.#name !== name) return null;
    this.#fill();
    if (!answer.error) return answer;
    this.#say(answer.error);
    return null;
  }

  async #run() {
    const answer = await this.#asked(data.run_changed);
    if (answer) this.shown(answer.show);
  }

  async #save() {
    const answer = await this.#asked(data.changed_file);
    if (!answer) return;
    const link = make("a", { href: URL.createObjectURL(new Blob([answer.text])), download: `${this.#title}-changed.toml` });
    link.click();
    URL.revokeObjectURL(link.href);
  }

  // --- handles on the plane ---

  /** Returns the handles as { robot, x, y, at }: the names of the coordinates, and the position in m. */
  get #handles() {
    if (!this.open || !this.values) return [];
    return Object.entries(this.values.robots).flatMap(([robot, own]) => [["x", "y"], ["anchor_x", "anchor_y"]].map(([x, y]) => (
      { robot, x, y, at: [own[x], own[y]] }
    ))).filter(({ at: [x] }) => x !== null); // in a team, no robot has an anchor of its own
  }

  /** Returns a function that moves the handle at a pixel to a position in m; null if there is none. */
  taken(pixel, plane) {
    const near = this.#running ? [] : this.#handles.filter(({ at }) => distance(plane.at(at), pixel) <= REACH_PX);
    near.sort((one, other) => distance(plane.at(one.at), pixel) - distance(plane.at(other.at), pixel));
    const [handle] = near;
    if (!handle) return null;
    this.robot.value = handle.robot;
    this.#fill();
    return (position) => {
      const digits = Math.max(0, Math.ceil(Math.log10(plane.scale))); // no more than a pixel tells
      const own = this.values?.robots[handle.robot];
      if (own) [own[handle.x], own[handle.y]] = position.map((one) => Number(one.toFixed(digits)));
      this.#fill();
    };
  }

  /** Draws starts and anchors as changed, and the circle of R around each anchor. */
  draw(plane, look, robots) {
    const pen = plane.context;
    for (const { robot, x, at } of this.#handles) {
      const { role } = robots.find(({ id }) => id === robot), [px, py] = plane.at(at);
      pen.fillStyle = look.paper;
      if (x === "x") shape(pen, role, px, py, this.values.robots[robot].heading, START_PX);
      else {
        pen.beginPath();
        pen.rect(px - ANCHOR_PX, py - ANCHOR_PX, 2 * ANCHOR_PX, 2 * ANCHOR_PX);
      }
      pen.fill();
      stroked(pen, look.robot[role], 2);
      if (robot === this.robot.value) circle({ context: pen, at: () => [px, py], scale: 1 }, at, REACH_PX + 2, look.robot[role], 2, OUTLINED);
      if (x !== "x") circle(plane, at, this.values.sensing_range, look.robot[role], 1.5, DASHED);
    }
  }
}

/** Adds a labelled number field to `list`; returns the field, and a function that shows a value in it. */
function number(list, label, changed) {
  const input = make("input", { type: "number", step: "any", required: true });
  input.id = `change-${label.replaceAll(" ", "-")}`;
  list.append(make("dt", {}, make("label", { htmlFor: input.id }, label)), make("dd", {}, input));
  input.addEventListener("input", () => { if (input.checkValidity()) changed(input.valueAsNumber); });
  const show = (value) => {
    for (const part of [input.parentElement, input.parentElement.previousElementSibling]) part.hidden = value === null;
    if (value === null) input.disabled = true; // else an empty field would be invalid
    else if (input.valueAsNumber !== value && document.activeElement !== input) input.value = value;
  };
  return { input, show };
}

/** Adds a slider and a number field to `list`; returns functions that show a value and set the slider's end. */
function slider(list, name, label, changed) {
  const field = number(list, label, changed);
  const bar = make("input", { type: "range", min: 0, step: "any" });
  bar.setAttribute("aria-label", label);
  bar.name = name;
  field.input.before(bar);
  bar.addEventListener("input", () => {
    const value = Number((Math.round(bar.value / (bar.max / 200)) * (bar.max / 200)).toPrecision(6));
    field.input.value = value;
    changed(value);
  });
  const show = (value) => {
    field.show(value);
    if (document.activeElement !== bar) bar.value = value;
  };
  return { show, limit: (most) => { bar.max = most; } };
}

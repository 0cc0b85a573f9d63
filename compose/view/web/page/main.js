// The entry point of the page: view state, playback, keys, and the address (#show=…&tick=46&robot=a&truth=0).

import { sweep } from "./sweep.js";
import { Cards, make } from "./cards.js";
import * as data from "./data.js";
import { leads } from "./held.js";
import { Log } from "./log.js";
import { Plane } from "./plane.js";
import { Store } from "./store.js";
import { Timeline } from "./timeline.js";
import { KEYS, MEANINGS, place, plural, rad, without_error } from "./words.js";

const SPEEDS = [0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];
const USUAL = 5;
const ANNOUNCE_MS = 900;

const $ = (id) => document.getElementById(id);
const still = matchMedia("(prefers-reduced-motion: reduce)");
let store = null;
const view = {
  tick: 0, share: 0, playing: false, follow: true, focus: null, moving: false, speed: USUAL,
  wanted: true,
  /** True if the ground truth is shown; always false if the run has none. */
  get truth() { return this.wanted && (store?.has_truth ?? true); },
};
let listed = null;
let source = null;
let due = false;
let before = null;

const plane = new Plane($("canvas"), () => draw());
const timeline = new Timeline($("line"), $("bands"), $("scrub"), (tick) => go(tick));
const cards = new Cards($("robots"), $("roster"), (robot) => focus(view.focus === robot ? null : robot));
const log = new Log($("log"), $("states"), $("radio"), (tick) => go(tick));
log.onchange = () => draw();

// --- the address ---

function address_state() {
  const fields = new URLSearchParams(location.hash.slice(1));
  const tick = fields.get("tick");
  return {
    show: fields.get("show"),
    tick: tick !== null && /^\d+$/.test(tick) ? Number(tick) : null,
    robot: fields.get("robot"),
    truth: fields.get("truth") !== "0",
  };
}

function update_address() {
  if (!store) return;
  const fields = new URLSearchParams();
  if (listed && listed.shows.length > 1) fields.set("show", store.name);
  if (!(view.follow && store.live)) fields.set("tick", view.tick);
  if (view.focus) fields.set("robot", view.focus);
  if (!view.wanted) fields.set("truth", "0");
  const hash = `#${fields}`;
  if (location.hash !== hash && (location.hash || String(fields))) history.replaceState(null, "", hash);
}

// --- the mission shown ---

function listen() {
  source?.close();
  source = data.listen(store, (news) => {
    document.body.classList.remove("lost");
    if (news.list) on_list(news.list);
    if (news.show && store) {
      const ahead = store.last;
      store.update(news.show);
      if (view.follow && store.live && store.last !== ahead) view.tick = Math.max(store.last, 0);
      else if (view.follow && !store.live && ahead !== store.last) view.tick = Math.max(store.last, 0);
    }
    draw();
  }, () => {
    document.body.classList.add("lost");
    draw();
  });
}

async function on_list(list) {
  listed = list;
  if (list.sweep) {
    if ($("sweep").hidden) {
      text($("title"), await sweep($("sweep")));
      document.title = `${$("title").textContent} · Tandem`;
      text($("status"), "sweep");
    }
    return;
  }
  const { show } = address_state();
  const chosen = list.shows.find((one) => one.name === show) ?? (list.shows.length === 1 ? list.shows[0] : null);
  if (chosen && chosen.name !== store?.name) await open(chosen.name);
  else if (!chosen && !(store && list.shows.some((one) => one.name === store.name) && show)) show_list();
}

let opening = null;
async function open(name) {
  if (opening === name) return;
  opening = name;
  try {
    const mission = await data.mission(name);
    if (!mission) return;
    store?.close();
    store = new Store(name, mission, draw);
    store.onstage = staged;
    store.onforget = (tick) => { timeline.forget(tick); log.forget(tick); };
    const { tick, robot, truth } = address_state();
    view.follow = tick === null;
    view.tick = tick ?? (store.live ? Math.max(store.last, 0) : store.first);
    view.wanted = truth;
    view.playing = false;
    view.focus = store.places.has(robot) ? robot : null;
    staged();
    listen();
  } finally {
    opening = null;
  }
}

function staged() {
  $("home").hidden = !listed || listed.shows.length < 2;
  for (const id of ["mission", "time", "view"]) $(id).hidden = false;
  for (const id of ["list", "sweep"]) $(id).hidden = true;
  $("title").textContent = store.stage.name;
  document.title = `${store.stage.name} · Tandem`;
  const all = make("option", { value: "", textContent: "all" });
  $("robot").replaceChildren(all, ...store.stage.robots.map((robot) => make("option", { value: robot.id, textContent: robot.id })));
  cards.stage(store);
  timeline.stage(store);
  log.stage(store);
  plane.fitted = true;
  draw();
}

function show_list() {
  store?.close();
  store = null;
  for (const id of ["mission", "time", "view"]) $(id).hidden = true;
  const root = $("list");
  root.hidden = false;
  $("home").hidden = true;
  $("title").textContent = "Missions";
  document.title = "Missions · Tandem";
  const where = listed.network.map(({ endpoint, reached }) => `${endpoint}${reached ? "" : " (no router yet)"}`);
  $("status").textContent = listed.shows.length ? plural(listed.shows.length, "mission") : listed.waiting ? "waiting for a mission" : "no missions";
  root.replaceChildren(
    ...(where.length ? [make("p", { className: "note", textContent: `Listening on ${where.join(", ")}.` })] : []),
    make("ul", {}, ...listed.shows.map((one) => {
      const link = make("a", { href: `#show=${encodeURIComponent(one.name)}` },
        make("b", { textContent: one.name }), " ",
        ...(one.title !== one.name ? [make("span", { textContent: one.title }), " "] : []),
        make("span", { textContent: plural(one.robots, "robot") }), " ",
        make("span", { className: "chip", textContent: state_of(one.live, one.last, one.end && { tick: one.end[1], outcome: one.end[2] }) }));
      return make("li", {}, link);
    })),
  );
}

function state_of(live, last, end) {
  if (end) return `${end.outcome} after ${end.tick} ticks`;
  if (live) return `● running, tick ${Math.max(last, 0)}`;
  return `incomplete, ends at tick ${last}`;
}

// --- navigation ---

function go(tick, { keep_playing = false } = {}) {
  if (!store) return;
  view.tick = Math.min(Math.max(tick, store.first), Math.max(store.last, 0));
  view.share = 0;
  if (!keep_playing) view.playing = false;
  view.follow = store.live && view.tick >= store.last;
  store.want(view.tick);
  draw();
}

function focus(robot) {
  view.focus = robot;
  if (store && plane.fitted) plane.fit(store, robot, view.truth);
  draw();
}

function play(on = !view.playing) {
  if (!store) return;
  if (on && view.tick >= store.last && !store.live) view.tick = store.first;
  view.playing = on;
  view.follow = false;
  view.share = 0;
  before = null;
  draw();
}

function advance(now) {
  if (!view.playing || !store) return;
  const s = before === null ? 0 : Math.min((now - before) / 1000, 0.25);
  before = now;
  const time = view.tick + view.share + s * view.speed;
  if (time >= store.last) {
    view.tick = store.last;
    view.share = 0;
    view.playing = false;
    view.follow = store.live;
    return;
  }
  const tick = Math.floor(time);
  if (!store.scene(tick)) {
    store.want(tick);
    return;
  }
  store.wanted = tick;
  view.tick = tick;
  view.share = time - tick;
}

// --- drawing ---

function draw() {
  if (due) return;
  due = true;
  requestAnimationFrame((now) => {
    due = false;
    if (!store) return;
    advance(now);
    store.want(view.tick);
    view.moving = view.playing && !still.matches && view.speed <= 60;
    document.body.dataset.tick = view.tick;
    document.body.dataset.shown = store.scene(view.tick) ? view.tick : "";
    plane.draw(store, view);
    cards.draw(view);
    log.draw(view);
    timeline.draw(view, activities());
    controls();
    announce(now);
    if (view.playing) draw();
    else update_address();
  });
}

function activities() {
  const players = store.scene(view.tick)?.players ?? [];
  const chosen = view.focus ? players.filter((player) => player.robot === view.focus) : players.slice(0, 4);
  return chosen.map((player) => player.activity).join(". ");
}

function controls() {
  const lost = document.body.classList.contains("lost");
  text($("status"), lost ? "connection to the server lost" : state_of(store.live, store.last, store.end));
  $("status").dataset.outcome = lost ? "lost" : store.end?.outcome ?? (store.live ? "live" : "torn");
  $("status").title = store.end?.reason ?? "";
  text($("tick"), `tick ${view.tick} of ${Math.max(store.last, 0)}`);
  $("play").classList.toggle("on", view.playing);
  $("play").setAttribute("aria-label", view.playing ? "Pause" : "Play");
  $("follow").hidden = !store.live;
  $("follow").setAttribute("aria-pressed", String(view.follow));
  $("truth").checked = view.truth;
  $("truth").disabled = !store.has_truth;
  if ($("robot").value !== (view.focus ?? "")) $("robot").value = view.focus ?? "";
  if ($("speed").value !== String(view.speed)) $("speed").value = String(view.speed);
  const notes = store.state.notes.join(" · ");
  text($("notes"), notes);
  $("notes").hidden = !notes;
  const subject = view.focus ?? "each robot";
  const bearing = knows_bearing() ? "" : "; the bearing from the anchor is arbitrary until the robot is placed in the world";
  const only = store.has_truth ? `only the belief of ${subject}` : `no ground truth: only the belief of ${subject}`;
  const unknown = store.scene(view.tick)?.players.every((player) => !player.pose) ? "the ground truth of this tick is unknown" : "";
  text($("seen"), !view.truth ? `${only}${bearing}` : unknown || (view.focus ? `ground truth and the belief of ${subject}` : ""));
  $("canvas").setAttribute("aria-label", described());
}

function knows_bearing() {
  const players = store.scene(view.tick)?.players ?? [];
  return players.filter((player) => !view.focus || player.robot === view.focus).every((player) => player.held?.world.length);
}

function described() {
  const scene = store.scene(view.tick);
  if (!scene) return `Tick ${view.tick}, not loaded yet`;
  const shown = scene.players.filter((player) => !view.focus || player.robot === view.focus).slice(0, 4);
  const at = shown.map((player) => {
    const { robot, held } = player, pose = view.truth ? player.pose : held && leads(held) ? held.world[0] : null;
    if (pose) return `${robot} at ${place(pose)}, heading ${rad(pose[2])}`;
    return held?.world.length > 1 ? `${robot} at one of ${held.world.length} poses` : `${robot} at an unknown pose`;
  });
  return `The plane at tick ${view.tick}: ${at.join("; ")}`;
}

function text(element, content) {
  if (element.textContent !== content) element.textContent = content;
}

/** Writes the tick's events for screen readers, at most once per ANNOUNCE_MS while playing. */
let announced = null;
let announced_at = 0;
function announce(now) {
  const scene = store.scene(view.tick);
  if (!scene || announced === view.tick || ((view.playing || view.follow) && now - announced_at < ANNOUNCE_MS)) return;
  announced = view.tick;
  announced_at = now;
  const events = scene.events.filter((event) => !view.focus || !event.robot || event.robot === view.focus).slice(0, 6);
  const texts = events.map((event) => (view.truth ? event.text : without_error(event.text)));
  if (texts.length || !(view.playing || view.follow)) text($("live"), `Tick ${view.tick}. ${texts.join(". ") || activities()}`);
}

// --- keys and buttons ---

function next_robot(direction) {
  const ids = [null, ...store.stage.robots.map((robot) => robot.id)];
  focus(ids[(ids.indexOf(view.focus) + direction + ids.length) % ids.length]);
}

function to_event(direction) {
  const tick = log.next(view.tick, direction, view.focus);
  if (tick !== undefined) go(tick);
}

function pace(direction) {
  const place = Math.min(Math.max(SPEEDS.indexOf(view.speed) + direction, 0), SPEEDS.length - 1);
  view.speed = SPEEDS[place];
  draw();
}

function show_truth(on) {
  if (store.has_truth) view.wanted = on;
  draw();
}

function fit() {
  plane.fit(store, view.focus, view.truth);
  draw();
}

/** True if the focused element handles that key itself. */
function needed({ target, key }) {
  const { tagName, type } = target;
  if (target.closest("dialog")) return false; // the dialog has just closed and still has the focus
  if (tagName === "SELECT") {
    return ["ArrowUp", "ArrowDown", "Enter"].includes(key) || (target === $("robot") ? /^[\w-]$/ : /^\d$/).test(key);
  }
  return [" ", "Enter"].includes(key) && (["BUTTON", "A"].includes(tagName) || (tagName === "INPUT" && type === "checkbox"));
}

/** Removes the focus from a control after a click, so that the space key starts playback. */
let pointing = false;
for (const [name, on] of [["pointerdown", true], ["keydown", false]]) document.addEventListener(name, () => { pointing = on; }, true);
for (const name of ["click", "change"]) {
  document.addEventListener(name, ({ target }) => {
    const control = target.closest("button, a, select, input[type=checkbox]");
    if (pointing && control && (name === "change" || control.tagName !== "SELECT")) control.blur();
  });
}

function pressed(event) {
  if (!store || event.ctrlKey || event.metaKey || event.altKey || $("keys").open) return;
  if (needed(event)) return;
  const far = event.shiftKey ? 10 : 1;
  const actions = {
    " ": () => play(), ArrowLeft: () => go(view.tick - far), ArrowRight: () => go(view.tick + far),
    PageDown: () => go(view.tick - 10), PageUp: () => go(view.tick + 10),
    Home: () => go(store.first), End: () => go(store.last), ",": () => to_event(-1), ".": () => to_event(1),
    "[": () => pace(-1), "]": () => pace(1), l: () => go(store.last), t: () => show_truth(!view.truth),
    r: () => next_robot(event.shiftKey ? -1 : 1), a: () => focus(null), f: fit, n: () => plane.near(store, view),
    "+": () => plane.zoom(1.25), "=": () => plane.zoom(1.25), "-": () => plane.zoom(0.8),
    w: () => plane.shift(event.shiftKey ? 60 : 0, event.shiftKey ? 0 : 60),
    s: () => plane.shift(event.shiftKey ? -60 : 0, event.shiftKey ? 0 : -60),
    "?": () => $("keys").showModal(),
  };
  const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!action) return;
  event.preventDefault();
  action();
}

document.addEventListener("keydown", pressed);
$("play").addEventListener("click", () => play());
$("back").addEventListener("click", () => go(view.tick - 1));
$("on").addEventListener("click", () => go(view.tick + 1));
$("first").addEventListener("click", () => go(store.first));
$("last").addEventListener("click", () => go(store.last));
$("follow").addEventListener("click", () => go(store.last));
$("truth").addEventListener("change", () => show_truth($("truth").checked));
$("robot").addEventListener("change", () => focus($("robot").value || null));
$("speed").addEventListener("change", () => { view.speed = Number($("speed").value); draw(); });
$("fit").addEventListener("click", fit);
$("near").addEventListener("click", () => plane.near(store, view));
$("help").addEventListener("click", () => $("keys").showModal());
$("view").addEventListener("submit", (event) => event.preventDefault());
$("speed").append(...SPEEDS.map((speed) => make("option", { value: speed, textContent: speed })));
$("key-list").append(...KEYS.flatMap(([key, action]) => [make("dt", {}, make("kbd", { textContent: key })), make("dd", { textContent: action })]));
$("signs").append(...MEANINGS.map(([sign, meaning]) => make("li", {}, make("b", { textContent: sign }), `: ${meaning}`)));
for (const role of ["a", "b"]) {
  const item = make("li", { textContent: `role ${role}` });
  item.dataset.role = role;
  $("legend").append(item);
}
for (const phase of [1, 2, 3]) {
  const item = make("li", { textContent: `phase ${phase}` });
  item.dataset.phase = phase;
  $("legend").append(item);
}

window.addEventListener("hashchange", () => {
  const { show, tick, robot, truth } = address_state();
  if (!store || (show || store.name) !== store.name || (!show && listed?.shows.length > 1)) return void (listed && on_list(listed));
  view.focus = store.places.has(robot) ? robot : null;
  view.wanted = truth;
  if (tick !== null) go(tick);
  else draw();
});
new ResizeObserver(() => draw()).observe($("plane"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => draw());

listen();

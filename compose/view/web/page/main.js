// The entry point of the page: view state, playback, keys, and the address (see address.js).

import { address_state } from "./address.js";
import { estimate } from "./estimate.js";
import { sweep } from "./sweep.js";
import { attribute, Cards, make } from "./cards.js";
import { Changes } from "./changes.js";
import { Charts } from "./charts.js";
import * as data from "./data.js";
import { embedded, on_clock, pass_on, tell, tell_state } from "./embedding.js";
import { needed, release_focus } from "./focus.js";
import { group_marks } from "./group.js";
import { Guide } from "./guide.js";
import { Legend } from "./legend.js";
import { Log } from "./log.js";
import { list_missions, state_of } from "./missions.js";
import { unit } from "./pen.js";
import { Plane } from "./plane.js";
import { same, Tip, written } from "./selection.js";
import { activities, Announcer, described } from "./spoken.js";
import { Predictions } from "./predictions.js";
import { Sequence } from "./sequence.js";
import { SPEEDS, USUAL } from "./speeds.js";
import { Store } from "./store.js";
import { Timeline } from "./timeline.js";
import { joined } from "./tints.js";
import { KEYS, plural, said, seconds } from "./words.js";

const RESULTS = "#results"; // the address of the table and the figures of an estimate
const SETTLED_MS = 200; // after the last movement of the camera

const $ = (id) => document.getElementById(id);
const still = matchMedia("(prefers-reduced-motion: reduce)");
let store = null;
const view = {
  tick: 0, share: 0, playing: false, follow: true, focus: null, selected: null, moving: false, speed: USUAL,
  wanted: true,
  /** True while the clock of compare.html runs. */
  driven: false,
  /** True for guided play; false for a plain speed. */
  guided: true,
  /** In guided play: the place of the current caption among those of the tick, and for how many seconds it is shown. */
  beat: null, held: 0,
  /** True if the ground truth is shown; always false if the run has none. */
  get truth() { return this.wanted && (store?.has_truth ?? true); },
};
let listed = null, source = null, due = false, before = null;

const guide = new Guide();
const announcer = new Announcer();
const plane = new Plane($("canvas"), () => draw(), select);
const tip = new Tip($("tip"));
const predictions = new Predictions($("predictions"), plane);
const legend = new Legend($("legend"), () => draw());
const timeline = new Timeline($("line"), $("bands"), $("scrub"), (tick) => go(tick));
const sequence = new Sequence($("exchange"), (tick) => go(tick), () => draw());
const charts = new Charts($("charts"), $("strips"), (tick) => go(tick), () => draw());
const cards = new Cards($("robots"), $("roster"), toggle);
const log = new Log($("log"), $("states"), $("radio"), (tick) => go(tick));
log.onchange = () => draw();
const changes = new Changes($("changes"), { redraw: () => draw(), shown: (name) => open(name) });
plane.handles = changes;

// --- the address ---

function update_address() {
  if (!store || embedded) return;
  const fields = new URLSearchParams();
  if (listed && (listed.sweep || listed.shows.length > 1 || listed.shows[0]?.name !== store.name)) fields.set("show", store.name);
  if (!(view.follow && store.live)) fields.set("tick", view.tick);
  if (view.focus) fields.set("robot", view.focus);
  if (view.selected) fields.set("select", written(view.selected));
  if (plane.chosen_view) fields.set("view", plane.chosen_view.map((one) => Number(one.toPrecision(6))).join("_"));
  if (!view.wanted) fields.set("truth", "0");
  const hash = `#${fields}`;
  if (location.hash !== hash && (location.hash || String(fields))) history.replaceState(null, "", hash);
}

let addressing = 0, looked = "";
/** Updates the address, but not with each movement of the camera: browsers refuse too many updates. */
function keep_address() {
  const look = String(plane.chosen_view), moved = look !== looked;
  looked = look;
  clearTimeout(addressing);
  if (moved) addressing = setTimeout(update_address, SETTLED_MS);
  else update_address();
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
      if (view.follow && store.last !== ahead) view.tick = Math.max(store.last, 0);
    }
    draw();
  }, () => {
    document.body.classList.add("lost");
    draw();
  });
}

async function on_list(list) {
  const alone = listed?.shows.length === 1;
  listed = list;
  if (alone && list.shows.length > 1) update_address(); // it has not named the only mission
  if (list.estimate && (location.hash === RESULTS || !list.shows.length)) {
    if (!$("sweep").hidden) return;
    text($("title"), await estimate($("sweep")));
    document.title = `${$("title").textContent} · Tandem`;
    if (list.shows.length) Object.assign($("home"), { hidden: false, textContent: "Play" });
    return void text($("status"), "estimate");
  }
  if (list.sweep && !address_state().show) {
    if (store) return void location.assign("/");
    if (!$("sweep").hidden) return;
    text($("title"), await sweep($("sweep")));
    document.title = `${$("title").textContent} · Tandem`;
    return void text($("status"), "sweep");
  }
  const { show, tick } = address_state(); // an address with a tick and no mission is that of the only one at that time
  const chosen = list.shows.find((one) => one.name === show) ?? (list.shows.length === 1 || (!show && tick !== null) ? list.shows[0] : null);
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
    store.onforget = (tick) => { timeline.forget(tick); log.forget(tick); guide.forget(tick); };
    const { tick, robot, selected, view: look, truth } = address_state();
    view.follow = tick === null;
    const start = store.live ? store.last : store.first;
    view.tick = Math.max(Math.min(tick ?? start, store.last), store.first, 0);
    view.wanted = truth;
    view.playing = false;
    view.beat = null;
    plane.freed = false;
    plane.following = !embedded; // two recordings side by side are compared at one scale
    view.focus = store.places.has(robot) ? robot : null;
    view.selected = selected;
    staged();
    if (look) plane.look_at(look);
    update_address(); // at once: a list of missions that arrives before the next frame opens that of the address
    listen();
    if (listed?.sweep) play(true);
  } finally {
    opening = null;
  }
}

function staged() {
  $("home").hidden = !listed || (listed.shows.length < 2 && !listed.sweep);
  if (listed?.sweep) $("home").textContent = "The sweep";
  if (listed?.estimate) Object.assign($("home"), { hidden: false, textContent: "Table and figures", href: RESULTS });
  document.body.classList.toggle("estimated", store.estimated);
  for (const id of ["mission", "time", "view"]) $(id).hidden = false;
  for (const id of ["list", "sweep"]) $(id).hidden = true;
  $("title").textContent = store.stage.name;
  document.title = `${store.stage.name} · Tandem`;
  const all = make("option", { value: "", textContent: "all" });
  $("robot").replaceChildren(all, ...store.stage.robots.map((robot) => make("option", { value: robot.id, textContent: robot.id })));
  cards.stage(store);
  timeline.stage(store);
  log.stage(store);
  guide.stage(store);
  charts.stage(store);
  plane.fitted = true;
  if (changes.open) change(true);
  draw();
}

function show_list() {
  store?.close();
  store = null;
  for (const id of ["mission", "time", "view"]) $(id).hidden = true;
  $("home").hidden = true;
  $("title").textContent = "Missions";
  document.title = "Missions · Tandem";
  $("status").textContent = listed.shows.length ? plural(listed.shows.length, "mission") : listed.waiting ? "waiting for a mission" : "no missions";
  list_missions($("list"), listed);
}

// --- navigation ---

function go(tick, { keep_playing = false } = {}) {
  if (!store) return;
  if (embedded) return void tell({ tick });
  view.tick = Math.min(Math.max(tick, store.first), Math.max(store.last, 0));
  plane.easing = false; // a jump in time is no motion
  view.share = 0;
  view.beat = null;
  if (!keep_playing) view.playing = false;
  view.follow = store.live && view.tick >= store.last;
  store.want(view.tick);
  draw();
}

/** Shows the tick of the clock of compare.html, or the last tick if that is earlier. */
function follow_clock({ tick, share, playing }) {
  if (!store) return;
  view.follow = false;
  view.tick = Math.max(Math.min(tick, store.last), store.first, 0);
  view.share = tick < store.last ? share : 0;
  view.driven = playing && tick < store.last;
  store.want(view.tick);
  draw();
}

function focus(robot) {
  view.focus = robot;
  if (store && plane.fitted) plane.fit(store, robot, view.truth);
  draw();
}

function toggle(robot) { focus(view.focus === robot ? null : robot); }

/** Selects what the user has clicked on the plane: a robot as its card does, or an anchor or a hypothesis. */
function select(target) {
  if (!store) return;
  if (target?.kind === "robot") return void toggle(target.robot);
  view.selected = target && !same(target, view.selected) ? { kind: target.kind, robot: target.robot, place: target.place } : null;
  draw();
}

function deselect() {
  view.selected = null;
  focus(null);
}

function play(on = !view.playing) {
  if (!store) return;
  if (on && view.tick >= store.last && !store.live) view.tick = store.first;
  if (on && view.guided && !plane.freed) plane.following = true;
  Object.assign(view, { playing: on, follow: false, share: 0, beat: null, held: 0 });
  before = null;
  draw();
}

function advance(now) {
  if (!view.playing || !store) return;
  const s = before === null ? 0 : Math.min((now - before) / 1000, 0.25);
  before = now;
  if (view.guided) {
    view.playing = guide.advance(view, s);
    if (!view.playing) view.follow = store.live;
    store.want(view.tick);
    return;
  }
  const time = view.tick + view.share + s * view.speed;
  if (time >= store.last) return void Object.assign(view, { tick: store.last, share: 0, playing: false, follow: store.live });
  const tick = Math.floor(time);
  if (!store.scene(tick)) return void store.want(tick);
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
    store.show(view.tick);
    view.moving = (view.playing || view.driven) && !still.matches && (view.guided || view.speed <= 60);
    view.eliminated = guide.eliminated(view);
    view.planned = guide.planned(view);
    view.told = guide.told(view);
    const turned = guide.turned(view);
    view.turned = turned !== null && still.matches ? 1 : turned;
    // First the texts: they decide the size of the plane, its camera and its labels keep clear of them, and there is one layout.
    controls();
    $("caption").classList.toggle("several", view.told.length > 1);
    text($("caption"), view.told.map((one) => said(one, view.truth, " ")).join(" "));
    predictions.draw(view, store, guide.pair(view.focus));
    cards.draw(view);
    log.draw(view);
    if (plane.following) plane.follow(view, store, guide.pair(view.focus), (view.playing || plane.easing) && !still.matches ? now : null);
    attribute(document.body, "data-tick", String(view.tick));
    attribute(document.body, "data-shown", store.scene(view.tick) ? String(view.tick) : "");
    tell_state({ shown: store.scene(view.tick) ? view.tick : null, first: store.first, last: store.last });
    plane.draw(store, view);
    const size = [$("canvas").clientWidth, $("canvas").clientHeight];
    tip.draw({ ...view, store }, plane.hovered ?? plane.targets.find((one) => same(one, view.selected)), size, unit());
    timeline.draw(view, activities(store, view));
    legend.draw(store.grouped ? group_marks(plane.marks, store.stage.team) : plane.marks, timeline.kinds, legend_names());
    sequence.draw(store, view);
    charts.draw(store, view, store.grouped ? [store.chosen(view.focus)] : guide.pair(view.focus));
    const news = view.playing && view.guided ? null : announcer.text(store, view, now);
    if (news !== null) text($("live"), news);
    if (view.playing || plane.easing) draw();
    if (!view.playing && !plane.easing) keep_address();
  });
}

/** Returns the words of the legend: several pairs share it, so it then names roles. */
function legend_names() {
  const story = guide.pair(view.focus), several = store.stage.robots.length > story.length;
  const of = (role) => (several ? null : story.find((robot) => robot.role === role)?.id) ?? `of role ${role}`;
  const at = view.eliminated < 1 ? view.tick - 1 : view.tick, manoeuvre = joined(store.scene(at), story[0].id)?.manoeuvre;
  const range = store.estimated ? "" : `${Number(store.stage.mission.sensing_range.toFixed(3))}\u00a0m`, own = store.stage.robots.some(({ own_planner }) => own_planner);
  return { a: of("a"), b: of("b"), mover: manoeuvre?.robot ?? "a robot", range, own, team: store.stage.team };
}

function controls() {
  const lost = document.body.classList.contains("lost");
  text($("status"), lost ? "connection to the server lost" : store.estimated && store.end ? `${store.end.outcome} at the end` : state_of(store.live, store.last, store.end));
  const outcome = lost ? "lost" : store.end?.outcome ?? (store.live ? "live" : "torn");
  attribute($("status"), "data-outcome", outcome);
  attribute($("status"), "title", store.end?.reason ?? "");
  text($("tick"), `tick ${view.tick} of ${Math.max(store.last, 0)}`);
  attribute($("tick"), "data-time", seconds(view.tick * store.stage.mission.period));
  $("play").classList.toggle("on", view.playing);
  attribute($("play"), "aria-label", view.playing ? "Pause" : "Play");
  $("play").classList.toggle("invite", view.guided && !view.playing && !store.live && view.tick === store.first);
  attribute($("guide"), "aria-pressed", String(view.guided));
  attribute($("caption"), "aria-live", view.guided && view.playing ? "polite" : "off");
  attribute($("camera"), "aria-pressed", String(plane.following));
  hide($("follow"), !store.live);
  hide($("change"), !changeable());
  attribute($("change"), "aria-expanded", String(changes.open));
  attribute($("follow"), "aria-pressed", String(view.follow));
  $("truth").checked = view.truth;
  $("truth").disabled = !store.has_truth;
  if ($("robot").value !== (view.focus ?? "")) $("robot").value = view.focus ?? "";
  if ($("speed").value !== String(view.speed)) $("speed").value = String(view.speed);
  const notes = store.state.notes.join(" · ");
  text($("notes"), notes);
  hide($("notes"), !notes);
  const subject = view.focus ?? "each robot";
  const bearing = store.stage.team || knows_bearing() ? "" : "; the bearing from the anchor is arbitrary until the robot is placed in the world";
  const only = `${store.has_truth ? "" : "no ground truth: "}only the posterior of ${subject}`;
  const unknown = store.scene(view.tick)?.players.every((player) => !player.pose) ? "the ground truth of this tick is unknown" : "";
  text($("seen"), !view.truth ? `${only}${bearing}` : unknown || (view.focus ? `ground truth and the posterior of ${subject}` : ""));
  attribute($("canvas"), "aria-label", described(store, view));
}

function knows_bearing() {
  const players = store.scene(view.tick)?.players ?? [];
  return players.filter((player) => !view.focus || player.robot === view.focus).every((player) => player.held?.world.length);
}

function hide(element, hidden) {
  if (element.hidden !== hidden) element.hidden = hidden;
}

function text(element, content) {
  if (element.textContent !== content) element.textContent = content;
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
  guided(false, SPEEDS[place]);
}

/** Switches between guided play and a plain speed in ticks per second. */
function guided(on, speed = view.speed) {
  Object.assign(view, { guided: on, speed, beat: null, held: 0 });
  if (on && view.playing && !plane.freed) plane.following = true;
  draw();
}

/** Lets the camera follow the story, or leaves it where it is. */
function follow_story(on = !plane.following) {
  plane.following = on;
  plane.freed = !on;
  draw();
}

function show_truth(on) {
  if (store.has_truth) view.wanted = on;
  draw();
}

/** Opens the form that changes the scenario, or closes it. */
function change(on = !changes.open) {
  if (!on || !changeable()) return void changes.close();
  view.playing = false;
  changes.stage(store);
}

/** True if the scenario can be changed and run again. */
const changeable = () => data.served && !embedded && !store.live && !listed?.estimate;

function fit() {
  plane.fit(store, view.focus, view.truth);
  plane.freed = true;
  draw();
}

function pressed(event) {
  if (!store || event.ctrlKey || event.metaKey || event.altKey || $("keys").open) return;
  if (needed(event) || pass_on(event)) return;
  const far = event.shiftKey ? 10 : 1;
  const actions = {
    " ": () => play(), ArrowLeft: () => go(view.tick - far), ArrowRight: () => go(view.tick + far),
    PageDown: () => go(view.tick - 10), PageUp: () => go(view.tick + 10),
    Home: () => go(store.first), End: () => go(store.last), ",": () => to_event(-1), ".": () => to_event(1),
    "[": () => pace(-1), "]": () => pace(1), l: () => go(store.last), t: () => show_truth(!view.truth),
    r: () => next_robot(event.shiftKey ? -1 : 1), a: () => focus(null), Escape: deselect, f: fit, n: () => plane.near(store, view),
    g: () => guided(!view.guided), c: () => follow_story(),
    "+": () => plane.zoom(1.25), "=": () => plane.zoom(1.25), "-": () => plane.zoom(0.8),
    w: () => plane.shift(event.shiftKey ? 60 : 0, event.shiftKey ? 0 : 60),
    s: () => plane.shift(event.shiftKey ? -60 : 0, event.shiftKey ? 0 : -60),
    d: () => { $("exchange").open = !$("exchange").open; },
    e: () => change(),
    k: () => { $("legend").open = !$("legend").open; },
    v: () => { $("charts").open = !$("charts").open; },
    "?": () => $("keys").showModal(),
  };
  const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!action) return;
  event.preventDefault();
  action();
}

release_focus();
document.addEventListener("keydown", pressed);
on_clock(follow_clock);
const CLICKS = {
  play: () => play(), back: () => go(view.tick - 1), on: () => go(view.tick + 1), first: () => go(store.first), last: () => go(store.last),
  follow: () => go(store.last), guide: () => guided(!view.guided), camera: () => follow_story(), fit, change: () => change(),
  near: () => plane.near(store, view), help: () => $("keys").showModal(),
};
for (const [id, action] of Object.entries(CLICKS)) $(id).addEventListener("click", action);
$("truth").addEventListener("change", () => show_truth($("truth").checked));
$("robot").addEventListener("change", () => focus($("robot").value || null));
$("speed").addEventListener("change", () => guided(false, Number($("speed").value)));
$("view").addEventListener("submit", (event) => event.preventDefault());
$("speed").append(...SPEEDS.map((speed) => make("option", { value: speed, textContent: speed })));
$("key-list").append(...KEYS.flatMap(([key, action]) => [make("dt", {}, make("kbd", { textContent: key })), make("dd", { textContent: action })]));

window.addEventListener("hashchange", () => {
  const { show, tick, robot, selected, view: look, truth } = address_state();
  if (listed?.estimate && (location.hash === RESULTS) === Boolean(store)) return void location.reload();
  if (!store || (show || store.name) !== store.name || (!show && (listed?.sweep || listed?.shows.length > 1))) return void (listed && on_list(listed));
  view.focus = store.places.has(robot) ? robot : null;
  view.selected = selected;
  if (look) plane.look_at(look);
  view.wanted = truth;
  if (tick !== null) go(tick);
  else draw();
});
new ResizeObserver(() => draw()).observe($("stage"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => draw());

listen();

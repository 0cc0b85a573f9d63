// Two recordings side by side with one clock. Each is a frame with the page in its embedded mode.

import { address_state } from "./address.js";
import { make } from "./cards.js";
import { needed, release_focus } from "./focus.js";
import { SPEEDS, USUAL } from "./speeds.js";

const $ = (id) => document.getElementById(id);
const SIDES = ["left", "right"];
const SMOOTH = 60;
const clock = { tick: address_state().tick ?? 0, share: 0, playing: false, speed: USUAL };
/** By side: the tick that the frame shows (null while it loads it), and its first and last tick. */
const states = {};
let before = null;

const last = () => Math.max(...Object.values(states).map((state) => state.last), 0);
const shown_by = ({ first, last }) => Math.max(Math.min(clock.tick, last), first, 0);
const ready = () => SIDES.every((side) => states[side] && states[side].shown === shown_by(states[side]));

function send(side) {
  const { tick, share, playing, speed } = clock;
  $(side).contentWindow.postMessage({ tick, share: speed <= SMOOTH ? share : 0, playing }, location.origin);
}

function show() {
  for (const side of SIDES) if (states[side]) send(side);
  $("tick").textContent = `tick ${clock.tick} of ${last()}`;
  $("clock").max = last();
  $("clock").value = clock.tick;
  $("play").classList.toggle("on", clock.playing);
  $("play").setAttribute("aria-label", clock.playing ? "Pause" : "Play");
  $("speed").value = String(clock.speed);
  document.body.dataset.shown = ready() ? clock.tick : "";
  const hash = `#tick=${clock.tick}`;
  if (!clock.playing && SIDES.every((side) => states[side]) && location.hash !== hash) history.replaceState(null, "", hash);
}

function go(tick) {
  clock.tick = Math.min(Math.max(tick, 0), last());
  clock.share = 0;
  clock.playing = false;
  show();
}

function play() {
  clock.playing = !clock.playing;
  if (clock.playing && clock.tick >= last()) clock.tick = 0;
  clock.share = 0;
  before = null;
  show();
  if (clock.playing) requestAnimationFrame(advance);
}

/** Moves the clock, but not past a tick that a frame has not loaded yet. */
function advance(now) {
  if (!clock.playing) return;
  const s = before === null ? 0 : Math.min((now - before) / 1000, 0.25);
  before = now;
  if (ready()) {
    const time = clock.tick + clock.share + s * clock.speed;
    clock.tick = Math.min(Math.floor(time), last());
    clock.share = time - clock.tick;
    if (clock.tick >= last()) Object.assign(clock, { share: 0, playing: false });
    show();
  }
  if (clock.playing) requestAnimationFrame(advance);
}

function pace(direction) {
  clock.speed = SPEEDS[Math.min(Math.max(SPEEDS.indexOf(clock.speed) + direction, 0), SPEEDS.length - 1)];
  show();
}

/** Does what the key stands for; returns false if it stands for nothing. */
function pressed(key, far) {
  const step = far ? 10 : 1;
  const action = {
    " ": play, ArrowLeft: () => go(clock.tick - step), ArrowRight: () => go(clock.tick + step),
    PageDown: () => go(clock.tick - 10), PageUp: () => go(clock.tick + 10),
    Home: () => go(0), End: () => go(last()), l: () => go(last()), "[": () => pace(-1), "]": () => pace(1),
  }[key];
  action?.();
  return Boolean(action);
}

window.addEventListener("message", ({ origin, source, data }) => {
  const side = SIDES.find((one) => $(one).contentWindow === source);
  if (origin !== location.origin || !side) return;
  if (data.key) return void pressed(data.key, data.shiftKey);
  if (data.tick !== undefined) return void go(data.tick);
  const known = states[side];
  states[side] = data;
  if (known?.last !== data.last || !clock.playing) show();
});
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || needed(event)) return;
  if (pressed(event.key, event.shiftKey)) event.preventDefault();
});
release_focus();
$("play").addEventListener("click", play);
$("back").addEventListener("click", () => go(clock.tick - 1));
$("on").addEventListener("click", () => go(clock.tick + 1));
$("clock").addEventListener("input", () => go(Number($("clock").value)));
$("speed").append(...SPEEDS.map((speed) => make("option", { value: speed, textContent: speed })));
$("speed").addEventListener("change", () => { clock.speed = Number($("speed").value); show(); });
window.addEventListener("hashchange", () => { const { tick } = address_state(); if (tick !== null) go(tick); });

const found = await (await fetch("/api/comparison")).json();
$("line-of-both").textContent = found.line ?? found.error;
document.body.dataset.identical = String(found.identical ?? "");
SIDES.forEach((side, i) => {
  $(`name-${side}`).textContent = found.names?.[i] ?? side;
  $(`outcome-${side}`).textContent = found.outcomes?.[i] ?? "";
  $(side).src = `/one#embed=1&show=${side}&tick=${clock.tick}`;
});

// The map of a sweep's cells: the first axis goes down, the second across; of more axes, one map for each combination.

import { make } from "./cards.js";

const STEP_MS = 60; // between two ticks while time passes
const OUTCOMES = ["wrong", "inconsistent", "failed", "undecided"];

/** Returns the maps of `rows`, whose cells are buttons that call `on_cell` with the row and the button. */
export function heat_map(axes, rows, on_cell) {
  const by_cell = new Map(rows.map((row) => [Number(row.cell), row]));
  const [down, across, ...rest] = axes;
  const maps = combinations(rest).map((chosen) => map(down, across, rest, chosen, axes, by_cell, on_cell));
  return make("section", { className: "heat" },
    make("h2", { textContent: "Share of trials that localised" }),
    make("p", { className: "note", textContent: "Select a cell to play its worst trial." }),
    ...maps);
}

/** Adds a slider of ticks to the maps: each cell then has the share of its trials that have localised by that tick. */
export function add_time(maps, { ticks, localised }) {
  const last = ticks.length - 1, slider = make("input", { type: "range", min: 0, max: last, value: last, ariaLabel: "Tick" });
  const play = make("button", { type: "button", textContent: "Play" }), at = make("output", {});
  let timer = null;
  const draw = () => {
    const step = Number(slider.value);
    at.textContent = `by tick ${ticks[step]}`;
    slider.setAttribute("aria-valuetext", at.textContent);
    for (const cell of maps.querySelectorAll(".cell")) {
      const share = (localised[cell.dataset.cell]?.[step] ?? 0) / cell.dataset.trials;
      cell.style.setProperty("--share", share);
      cell.firstChild.textContent = `${Math.round(100 * share)} %`;
      cell.lastChild.hidden = step < last; // the outcomes at the end
    }
  };
  const stop = () => { clearInterval(timer); timer = null; play.textContent = "Play"; };
  play.addEventListener("click", () => {
    if (timer !== null) return void stop();
    if (Number(slider.value) === last) slider.value = 0;
    play.textContent = "Pause";
    timer = setInterval(() => { slider.value = Number(slider.value) + 1; draw(); if (Number(slider.value) >= last) stop(); }, STEP_MS);
  });
  slider.addEventListener("input", () => { stop(); draw(); });
  maps.querySelector("h2").after(make("div", { className: "line" }, play, slider, at));
  draw();
}

function map(down, across, rest, chosen, axes, by_cell, on_cell) {
  const columns = across ? labels(across) : ["localised"], lines = down ? labels(down) : ["all"];
  const caption = rest.map((axis, i) => `${title(axis)} ${labels(axis)[chosen[i]]}`).join(", ");
  const head = make("tr", {}, make("th", { textContent: [down, across].filter(Boolean).map(title).join(" ↓ by ") + (across ? " →" : "") || "cells" }),
    ...columns.map((label) => make("th", { scope: "col", textContent: label })));
  const body = lines.map((label, i) => make("tr", {}, make("th", { scope: "row", textContent: label }),
    ...columns.map((column, j) => {
      const place = [...(down ? [i] : []), ...(across ? [j] : []), ...chosen];
      const row = by_cell.get(place.reduce((index, at, axis) => index * labels(axes[axis]).length + at, 0));
      return make("td", {}, row ? cell(row, [[down, label], [across, column]], caption, on_cell) : "–");
    })));
  return make("div", { className: "wide", tabIndex: 0, role: "group", ariaLabel: caption || "Cells" }, make("table", {},
    ...(caption ? [make("caption", { textContent: caption })] : []), make("thead", {}, head), make("tbody", {}, ...body)));
}

function cell(row, axes, caption, on_cell) {
  if (row.rate === "") return make("span", { textContent: row.refused ? "refused" : "–", title: row.refused || "" });
  const percent = `${Math.round(100 * Number(row.rate))} %`;
  const bad = OUTCOMES.filter((outcome) => Number(row[outcome]));
  const button = make("button", { type: "button", className: "cell" }, make("b", { textContent: percent }),
    make("span", { textContent: bad.map((outcome) => `${row[outcome]} ${outcome}`).join(", ") }));
  button.style.setProperty("--share", row.rate);
  Object.assign(button.dataset, { cell: row.cell, trials: row.trials });
  if (Number(row.wrong) || Number(row.violations)) button.classList.add("bad");
  const where = [caption, ...axes.filter(([axis]) => axis).map(([axis, label]) => `${title(axis)} ${label}`)].filter(Boolean).join(", ");
  const counts = bad.map((outcome) => `, ${row[outcome]} ${outcome}`).join("");
  button.ariaLabel = button.title = `Cell ${row.cell}${where && ` (${where})`}: ${percent} of ${row.trials} localised${counts}. Play its worst trial`;
  button.addEventListener("click", () => on_cell(row, button));
  return button;
}

const title = (axis) => axis.name.replace(/\.name$/, "").split(".").at(-1);
const labels = (axis) => axis.labels ?? axis.values.map((value) => [value].flat().map((one) => one ?? "–").join(", "));

/** Returns all combinations of places on `axes`; one without places if there are no axes. */
function combinations(axes) {
  return axes.reduce((found, axis) => found.flatMap((places) => labels(axis).map((_, i) => [...places, i])), [[]]);
}

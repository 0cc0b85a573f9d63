// The page of a sweep: its figures, a map of its cells, and a table. A cell plays its worst trial, which the server runs again.

import { make } from "./cards.js";
import { fact_list, figures_of } from "./estimate.js";
import { add_time, heat_map } from "./heat.js";

export async function sweep(root) {
  const answer = await fetch("/api/results/sweep"), result = await answer.json();
  root.hidden = false;
  if (!answer.ok) {
    root.replaceChildren(make("p", { textContent: result.error }));
    return "Sweep";
  }
  const { name, rows, axes, trials, seed, refused, under_way, timed, folder, figures } = result;
  const sum = (field) => rows.reduce((total, row) => total + Number(row[field] || 0), 0);
  const facts = [
    ["localised", share(sum("localised"), sum("trials"))], ["wrong", sum("wrong")], ["inconsistent", sum("inconsistent")],
    ["undecided", sum("undecided")], ["failed", sum("failed")], ["violations found", sum("violations")],
    ["cells", rows.length || "none finished yet"], ["trials per cell", trials], ["seed", seed],
  ];
  if (Object.keys(refused).length) facts.push(["cells refused", Object.keys(refused).length]);
  root.replaceChildren(fact_list(facts));
  if (under_way) root.append(make("p", { className: "note", textContent: "The sweep is running or was stopped. The table shows the cells finished so far." }));
  const said = make("p", { id: "trial", className: "note" });
  said.setAttribute("role", "status");
  if (rows.length) root.append(heat_map(axes, rows, (row, button) => play(row, button, said)), said);
  if (timed) fetch("/api/results/ticks").then(async (found) => { if (found.ok) add_time(root.querySelector(".heat"), await found.json()); });
  root.append(figures_of(figures));
  if (rows.length) root.append(table(rows, axes));
  const cell = String(rows[0]?.cell ?? 0).padStart(3, "0");
  root.append(make("p", { className: "note" }, "Trials are not recorded. To run one again, to the bit, with the seed of its row in trials.parquet: ",
    make("code", { textContent: `tandem run ${folder}/cells/${cell}.toml --seed SEED --watch` })));
  return name;
}

/** Has the server run the worst trial of a cell, and goes to its page, where it plays. */
async function play(row, button, said) {
  said.textContent = `Running the worst trial of cell ${row.cell} again …`;
  button.setAttribute("aria-busy", "true");
  const answer = await fetch(`/api/cells/${row.cell}/worst`, { method: "POST" }).catch(() => null);
  const result = await answer?.json().catch(() => null) ?? { error: "the server cannot run this trial" };
  button.removeAttribute("aria-busy");
  if (result.show) location.hash = `show=${encodeURIComponent(result.show)}`;
  else said.textContent = result.error;
}

const share = (part, whole) => (whole ? `${(100 * part / whole).toFixed(1)} % of ${whole}` : "–");

const FIGURES = [
  ["trials", "trials"], ["rate", "localised"], ["ticks_p50", "ticks, median"], ["ticks_p95", "ticks, 95 %"], ["ticks_max", "ticks, maximum"],
  ["undecided", "undecided"], ["inconsistent", "inconsistent"], ["wrong", "wrong"], ["failed", "failed"], ["error_max_m", "largest error, m"],
  ["nees_mean", "NEES"], ["violations", "violations"], ["reports_lost", "reports lost"], ["refused", "refused"],
];

function table(rows, axes) {
  const plain = axes.map((axis) => axis.name).filter((name) => name in rows[0]);
  const figures = FIGURES.filter(([field]) => rows.some((row) => row[field] !== "" && row[field] !== undefined && row[field] !== "0"));
  const head = make("tr", {}, ...["cell", ...plain, ...figures.map(([, title]) => title)].map((title) => make("th", { scope: "col", textContent: title })));
  const body = rows.map((row) => make("tr", {},
    make("th", { scope: "row", textContent: row.cell }),
    ...plain.map((name) => make("td", { textContent: row[name] })),
    ...figures.map(([field]) => field === "rate" ? rate(row) : make("td", { className: "figure", textContent: shortened(row[field]) })),
  ));
  return make("div", { className: "wide", tabIndex: 0 }, make("table", {}, make("thead", {}, head), make("tbody", {}, ...body)));
}

/** Returns the cell of the localised fraction, with its 95 % confidence interval as the tooltip. */
function rate(row) {
  const percent = (text) => `${(100 * Number(text)).toFixed(1)} %`;
  const bar = make("i", { className: "bar" });
  bar.style.setProperty("--share", row.rate || 0);
  const cell = make("td", { className: "figure rate" }, bar, make("span", { textContent: row.rate === "" ? "–" : percent(row.rate) }));
  if (row.rate !== "") cell.title = `95 %: ${percent(row.rate_low)} to ${percent(row.rate_high)}`;
  return cell;
}

const shortened = (text) => (text === "" || text === undefined ? "–" : Number.isFinite(Number(text)) ? String(Number(Number(text).toPrecision(3))).replace("-", "−") : text);

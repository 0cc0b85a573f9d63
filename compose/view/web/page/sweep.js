// A sweep: what was asked, a row a cell, the figures. Its trials are not on record, each can be played again.

import { make } from "./cards.js";

export async function sweep(root) {
  const answer = await fetch("/api/sweep"), told = await answer.json();
  root.hidden = false;
  if (!answer.ok) {
    root.replaceChildren(make("p", { textContent: told.error }));
    return "Sweep";
  }
  const { name, rows, axes, trials, seed, refused, under_way, folder, figures } = told;
  const played = rows.reduce((sum, row) => sum + Number(row.trials), 0);
  const localised = rows.reduce((sum, row) => sum + Number(row.localised), 0);
  const wrong = rows.reduce((sum, row) => sum + Number(row.wrong), 0);
  const broken = rows.reduce((sum, row) => sum + Number(row.violations || 0), 0);
  const facts = [
    ["cells", rows.length || "not gathered yet"], ["trials asked for, in each", trials], ["trials played", played],
    ["localised", localised], ["wrong", wrong], ["violations found", broken], ["seed", seed],
  ];
  if (Object.keys(refused).length) facts.push(["cells refused", Object.keys(refused).length]);
  root.replaceChildren(
    make("dl", { className: "facts" }, ...facts.map(([what, value]) => make("div", {}, make("dt", { textContent: what }), make("dd", { textContent: value })))),
  );
  if (under_way) root.append(make("p", { className: "note", textContent: "The sweep is under way, or was stopped: these are the rows that were gathered before." }));
  if (rows.length) root.append(table(rows, axes));
  const cell = String(rows[0]?.cell ?? 0).padStart(3, "0");
  root.append(
    make("p", { className: "note" }, "Trials are not recorded one by one. Each plays again, to the bit, with the seed of its row in trials.parquet: ",
      make("code", { textContent: `tandem run ${folder}/cells/${cell}.toml --seed SEED --watch` })),
    make("div", { className: "figures" }, ...figures.map((figure) => make("figure", {},
      make("img", { src: `/api/figures/${encodeURIComponent(figure)}`, alt: figure.replace(".svg", "").replaceAll("-", " "), loading: "lazy" })))),
  );
  return name;
}

const FIGURES = [
  ["trials", "trials"], ["rate", "localised"], ["ticks_p50", "ticks, median"], ["ticks_p95", "95 %"], ["ticks_max", "most"],
  ["undecided", "undecided"], ["inconsistent", "inconsistent"], ["wrong", "wrong"], ["failed", "failed"], ["error_max_m", "worst error, m"],
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

/** The share that localised, and its interval. */
function rate(row) {
  const percent = (text) => `${(100 * Number(text)).toFixed(1)} %`;
  const bar = make("i", { className: "bar" });
  bar.style.setProperty("--share", row.rate || 0);
  const cell = make("td", { className: "figure rate" }, bar, make("span", { textContent: row.rate === "" ? "–" : percent(row.rate) }));
  if (row.rate !== "") cell.title = `95 %: ${percent(row.rate_low)} to ${percent(row.rate_high)}`;
  return cell;
}

const shortened = (text) => (text === "" || text === undefined ? "–" : Number.isFinite(Number(text)) ? String(Number(Number(text).toPrecision(3))) : text);

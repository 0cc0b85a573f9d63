// The page of an estimate: a table of its robots, the numbers of ranges, and its figures.

import { make } from "./cards.js";
import { number } from "./words.js";

export async function estimate(root) {
  const answer = await fetch("/api/results/estimate"), result = await answer.json();
  root.hidden = false;
  root.setAttribute("aria-label", "Estimate");
  if (!answer.ok) {
    root.replaceChildren(make("p", { textContent: result.error }));
    return "Estimate";
  }
  const { source, noise, frame, begin_s, robots, ranges, blocking_reason, figures } = result;
  const facts = [["noise", noise], ...(frame ? [["frame", `of ${frame}, first pose`]] : []), ...Object.entries(ranges).map(([pair, count]) => [`ranges ${pair}`, count])];
  root.replaceChildren(
    fact_list(facts),
    table(robots, begin_s),
    make("p", { className: "note", textContent: blocking_reason ? `At the end no claim is possible: ${blocking_reason}.` : "Times are from the first odometry on, poses in metres and radians." }),
    figures_of(figures),
  );
  return source.split("/").at(-1);
}

const COLUMNS = ["robot", "anchors", "first claim, s", "x", "y", "heading", "sigma, m", "error, m", "NEES"];

function table(robots, begin_s) {
  const head = make("tr", {}, ...COLUMNS.map((title, i) => make("th", { scope: "col", className: i > 1 ? "figure" : "", textContent: title })));
  const body = Object.entries(robots).map(([name, robot]) => make("tr", {},
    make("th", { scope: "row", textContent: name }),
    make("td", { textContent: robot.anchors.join(", ") }),
    figure(robot.first_claim && robot.first_claim.t_s - begin_s, 1),
    ...(robot.final?.pose ?? [null, null, null]).map((value) => figure(value, 2)),
    figure(robot.final && Math.sqrt(robot.final.covariance[0][0] + robot.final.covariance[1][1]), 2),
    figure(robot.final?.position_error_m, 2),
    figure(robot.final?.nees, 1),
  ));
  return make("div", { className: "wide", tabIndex: 0 }, make("table", {}, make("thead", {}, head), make("tbody", {}, ...body)));
}

const figure = (value, digits) => make("td", { className: "figure", textContent: Number.isFinite(value) ? number(value, digits) : "–" });

/** Returns [name, value] of results as a list. */
export const fact_list = (facts) => make("dl", { className: "facts" }, ...facts.map(([what, value]) => make("div", {}, make("dt", { textContent: what }), make("dd", { textContent: value }))));

/** Returns the figures of results, by the names of their files. */
export const figures_of = (names) => make("div", { className: "figures" }, ...names.map((name) => make("figure", {},
  make("img", { src: `/api/figures/${encodeURIComponent(name)}`, alt: name.replace(".svg", "").replaceAll("-", " "), loading: "lazy" }))));

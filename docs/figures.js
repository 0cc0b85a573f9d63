// The figures with a slider of docs/method.md. A classic script, since the site also opens from files.
"use strict";
(() => {
  const NS = "http://www.w3.org/2000/svg", TAU = 2 * Math.PI;
  const D = 10, ORBIT = 6.5, SPEED = 1; // as in Section IV, in m and m/s; ticks of 1 s
  const FIRST = 2.5, SECOND = 3.1; // distances of a from b in m
  const add = ([x, y], [dx, dy]) => [x + dx, y + dy];
  const polar = (length, angle) => [length * Math.cos(angle), length * Math.sin(angle)];
  const turned = ([x, y], angle) => [x * Math.cos(angle) - y * Math.sin(angle), x * Math.sin(angle) + y * Math.cos(angle)];
  const apart = ([x, y], [u, v]) => Math.hypot(x - u, y - v);
  const metres = (length) => `${length.toFixed(2)} m`;

  /** Draws in metres, y up, into `svg`, with `centre` in the middle of `width` by `height` m. */
  class Pen {
    constructor(svg, [x, y], width, height) {
      svg.replaceChildren();
      svg.setAttribute("viewBox", `${x - width / 2} ${-y - height / 2} ${width} ${height}`);
      this.svg = svg, this.unit = width / 100;
    }
    #add(name, attributes, look) {
      const one = document.createElementNS(NS, name);
      for (const [key, value] of Object.entries(attributes)) one.setAttribute(key, value);
      one.setAttribute("class", look);
      return this.svg.appendChild(one);
    }
    circle([x, y], r, look) { this.#add("circle", { cx: x, cy: -y, r }, look); }
    dot(at, look) { this.circle(at, 1.2 * this.unit, `dot ${look}`); }
    line(points, look) { this.#add("polyline", { points: points.map(([x, y]) => `${x},${-y}`).join(" ") }, look); }
    text([x, y], words, look = "") {
      this.#add("text", { x: x + 1.8 * this.unit, y: -y - 1.8 * this.unit, "font-size": 3.6 * this.unit }, look).textContent = words;
    }
    anchor(at, name) { this.dot(at, "anchor"), this.text(at, name); }
  }

  // --- phase 1: one anchor -----------------------------------------------------------------------------------

  function mirror(svg, degrees) {
    const alpha = degrees * Math.PI / 180, start = [1.8, 0], pen = new Pen(svg, [1, 0], 9, 5.6);
    const [one, other] = [alpha, -alpha].map((angle) => add(start, polar(SPEED, angle)));
    pen.circle([0, 0], apart(start, [0, 0]), "range"), pen.circle([0, 0], apart(one, [0, 0]), "range");
    pen.anchor([0, 0], "M1");
    pen.line([start, one], "a"), pen.line([start, other], "a dashed");
    pen.dot(start, "a"), pen.dot(one, "a"), pen.dot(other, "a");
    pen.text(one, "+α"), pen.text(add(other, [0, -0.6]), "−α");
    return `Distances ${metres(apart(start, [0, 0]))} and ${metres(apart(one, [0, 0]))}: both paths have them.`;
  }

  function rotation(svg, degrees) {
    const path = [[1.8, 0], [2.2, 0.92], [1.6, 1.7], [0.7, 1.5]], pen = new Pen(svg, [0, 0], 9, 5.6);
    for (const place of path) pen.circle([0, 0], apart(place, [0, 0]), "range");
    pen.anchor([0, 0], "M1");
    pen.line(path, "a dashed");
    const shown = path.map((place) => turned(place, degrees * Math.PI / 180));
    pen.line(shown, "a");
    for (const place of shown) pen.dot(place, "a");
    return `Turned by ${degrees}°: all ${path.length} distances are the same. One anchor never tells this angle.`;
  }

  // --- phase 3: the frame of b and its anchor M2 --------------------------------------------------------------

  const B = [ORBIT, 0];
  const FROM_M1 = [[ORBIT, 0], [ORBIT, SPEED]]; // a at the two distances, in the frame of its own anchor

  /** Returns the positions of M1 and of a, as they solve eq. (7) for two distances of a from b. */
  function solutions(first, second) {
    const found = [], steps = 1440;
    for (const sign of [1, -1]) {
      let before = null;
      for (let i = 0; i <= steps; i += 1) {
        const anchor = polar(D, (i / steps) * TAU), away = apart(anchor, B);
        const cosine = (ORBIT ** 2 + away ** 2 - first ** 2) / (2 * ORBIT * away);
        if (Math.abs(cosine) > 1) { before = null; continue; }
        const angle = Math.atan2(B[1] - anchor[1], B[0] - anchor[0]) + sign * Math.acos(cosine);
        const path = FROM_M1.map((place) => add(anchor, turned(place, angle))), off = apart(path[1], B) - second;
        if (before && before.off * off < 0) found.push(Math.abs(off) < Math.abs(before.off) ? { anchor, path } : before);
        before = { anchor, path, off };
      }
    }
    return found;
  }

  function four(svg, second) {
    const pen = new Pen(svg, [4, 0], 29, 24), found = solutions(FIRST, second);
    pen.circle([0, 0], D, "range"), pen.circle(B, FIRST, "range"), pen.circle(B, second, "range");
    pen.anchor([0, 0], "M2"), pen.dot(B, "b"), pen.text(B, "b");
    found.forEach(({ anchor, path }, i) => {
      pen.line([anchor, path[0]], "faint"), pen.line(path, "a"), pen.anchor(anchor, `M1: ${i + 1}`), pen.dot(path[1], "a");
    });
    return `Distances ${metres(FIRST)}, then ${metres(second)}: ${found.length} placements of a's path fit.`;
  }

  const HYPOTHESES = solutions(FIRST, SECOND).map(({ path }) => path[1]);
  const HEADING = -Math.PI / 2;
  const driven = (omega) => add(B, polar(SPEED * (omega ? Math.sin(omega / 2) / (omega / 2) : 1), HEADING + omega / 2));
  const distances = (omega) => HYPOTHESES.map((place) => apart(place, driven(omega)));

  /** Returns J of eq. (8) in m^2: the smallest difference of two squared distances. */
  function separation(omega) {
    const squares = distances(omega).map((one) => one * one).sort((one, other) => one - other);
    return Math.min(...squares.slice(1).map((one, i) => one - squares[i]));
  }

  const RATES = Array.from({ length: 361 }, (_, i) => ((i - 180) / 180) * Math.PI);
  const BEST = RATES.reduce((best, one) => (separation(one) > separation(best) ? one : best));

  function turnRate(svg, omega) {
    const pen = new Pen(svg, [ORBIT + 4.4, -0.5], 19, 11.8), x = (rate) => ORBIT + 9.6 + rate * 1.2, most = separation(BEST);
    const y = (value) => -3 + 5 * (value / most);
    scene(pen, omega);
    pen.line(RATES.map((rate) => [x(rate), y(separation(rate))]), "faint"), pen.line([[x(-Math.PI), y(0)], [x(Math.PI), y(0)]], "range");
    pen.dot([x(BEST), y(most)], "b"), pen.dot([x(omega), y(separation(omega))], "a");
    pen.text([x(-Math.PI), y(0) - 1.15], "J over ω, −π to π rad/s");
    return `ω = ${omega.toFixed(2)} rad/s: J = ${separation(omega).toFixed(2)} m²; the best is ${most.toFixed(2)} m² at ${BEST.toFixed(2)} rad/s.`;
  }

  function scene(pen, omega, out = () => false) {
    const end = driven(omega);
    pen.line([B, ...[0.25, 0.5, 0.75, 1].map((part) => add(B, polar(SPEED * part * (omega ? Math.sin(omega * part / 2) / (omega * part / 2) : 1), HEADING + omega * part / 2)))], "b");
    pen.dot(B, "b faint"), pen.dot(end, "b"), pen.text(end, "b");
    HYPOTHESES.forEach((place, i) => {
      pen.dot(place, out(i) ? "a out" : "a"), pen.text(place, `${i + 1}`, out(i) ? "out" : "");
      if (!out(i)) pen.circle(end, apart(place, end), "range");
    });
  }

  function elimination(svg, measured) {
    const pen = new Pen(svg, [ORBIT, -0.5], 15, 11.8), predicted = distances(BEST), fits = (i) => Math.abs(predicted[i] - measured) < 0.1;
    scene(pen, BEST, (i) => !fits(i)), pen.circle(driven(BEST), measured, "measured");
    const left = HYPOTHESES.map((_, i) => i).filter(fits);
    return `Measured ${metres(measured)}, predicted ${predicted.map(metres).join(", ")}: ` + (left.length ? `${left.map((i) => i + 1).join(", ")} is left.` : "none fits.");
  }

  const FIGURES = {
    mirror: [mirror, 5, 175, 1, 60, "angle α in degrees"],
    rotation: [rotation, 0, 360, 1, 70, "rotation in degrees"],
    four: [four, 1.6, 3.4, 0.05, SECOND, "second distance in m"],
    "turn-rate": [turnRate, -3.14, 3.14, 0.02, 0.4, "turn rate of b in rad/s"],
    elimination: [elimination, 1.6, 4.2, 0.02, 2.82, "measured distance in m"],
  };

  /** Puts a drawing and a slider into a figure, above its caption. */
  function begin(figure) {
    const [draw, min, max, step, value, label] = FIGURES[figure.dataset.figure];
    const svg = document.createElementNS(NS, "svg"), slider = document.createElement("input"), said = document.createElement("output");
    svg.setAttribute("role", "img"), svg.setAttribute("aria-label", figure.querySelector("figcaption").textContent);
    Object.assign(slider, { type: "range", min, max, step, value }), slider.setAttribute("aria-label", label);
    slider.addEventListener("input", () => { said.textContent = draw(svg, Number(slider.value)); });
    figure.prepend(svg, slider, said);
    said.textContent = draw(svg, value);
  }

  document.querySelectorAll("figure[data-figure]").forEach(begin);
})();

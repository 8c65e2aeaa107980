// Success of each policy version with Wilson intervals, by suite and simulator; baselines as lines.

import { byId, make, percent, svg, ticks } from "./dom.js";

const READINGS = ["lenient", "strict", "precise"];
const MARGIN = { top: 10, right: 104, bottom: 24, left: 34 };
const LABEL_HEIGHT = 13;

export class Success {
  constructor() {
    this.reading = "strict";
    this.suites = [];
    this.baselines = [];
    this.reasons = {};
    this.chosen = null;
    byId("readings").append(...READINGS.map((reading) => make("button", {
      type: "button", "aria-pressed": String(reading === this.reading), "data-reading": reading,
      onclick: () => this.choose(reading),
    }, reading)));
    byId("success").addEventListener("pointermove", (event) => this.point(event));
    byId("success").addEventListener("pointerdown", (event) => this.point(event));
    byId("success").addEventListener("pointerleave", () => { this.chosen = null; this.tell(); });
  }

  setTask(task) {
    this.baselines = task.baselines;
    this.reasons = task.reasons;
    this.redraw();
  }

  choose(reading) {
    this.reading = reading;
    for (const button of byId("readings").children) {
      button.setAttribute("aria-pressed", String(button.dataset.reading === reading));
    }
    this.redraw();
  }

  show(suites) {
    this.suites = suites;
    this.redraw();
  }

  redraw() {
    const place = byId("success");
    const { width, height } = place.getBoundingClientRect();
    if (width < 50) return;
    const versions = this.suites.flatMap((suite) => suite.versions.map((each) => each.version));
    const [first, last] = versions.length ? [Math.min(...versions), Math.max(...versions)] : [0, 1];
    const [from, to] = first === last ? [first - 1, last + 1] : [first, last];
    const inner = { width: width - MARGIN.left - MARGIN.right, height: height - MARGIN.top - MARGIN.bottom };
    const across = (version) => MARGIN.left + 8 + (inner.width - 16) * (version - from) / (to - from);
    const up = (rate) => MARGIN.top + inner.height * (1 - rate);
    this.across = across;
    const parts = [...this.axes(across, up, from, to, inner, height), ...this.lines(up, width)];
    if (versions.length) this.suites.forEach((suite, index) => parts.push(...this.suite(suite, index, across, up)));
    else parts.push(svg("text", { x: MARGIN.left + 14, y: up(0.5) }, "No trial was counted yet."));
    place.replaceChildren(svg("svg", { role: "img", "aria-label": `${this.reading} success by policy version` }, ...parts));
    this.legend();
    this.tell();
  }

  axes(across, up, from, to, inner, height) {
    const parts = [0, 0.25, 0.5, 0.75, 1].flatMap((rate) => [
      svg("line", { class: "grid", x1: MARGIN.left, x2: MARGIN.left + inner.width, y1: up(rate), y2: up(rate) }),
      svg("text", { x: MARGIN.left - 6, y: up(rate) + 4, "text-anchor": "end" }, percent(rate)),
    ]);
    const whole = ticks(from, to, Math.min(inner.width / 45, 12)).filter((at) => Number.isInteger(at) && at > 0);
    return [...parts, ...whole.map((at) => svg("text", { x: across(at), y: height - 6, "text-anchor": "middle" }, at))];
  }

  // Baselines are of the plain suite in the simulator in which they were measured.
  lines(up, width) {
    const plain = this.suites.find((suite) => suite.name === "unlearned");
    const shown = this.baselines.filter((each) => plain && each.suite === plain.name && each.backend === plain.backend)
      .sort((one, other) => other[this.reading][0] - one[this.reading][0]);
    let free = -Infinity;
    const right = width - MARGIN.right;
    return shown.flatMap((each) => {
      const [rate, low, high] = each[this.reading];
      const y = Math.max(up(rate) + 4, free);
      free = y + LABEL_HEIGHT;
      return [
        svg("line", { x1: MARGIN.left, x2: right, y1: up(rate), y2: up(rate), stroke: "var(--muted)", "stroke-width": 1, "stroke-dasharray": "2 4", opacity: 0.8 }),
        svg("line", { x1: right + 3, x2: right + 3, y1: up(high), y2: up(low), stroke: "var(--muted)", "stroke-width": 2, opacity: 0.6 }),
        svg("text", { x: right + 9, y }, `${each.name} ${percent(rate)}`),
      ];
    });
  }

  suite(suite, index, across, up) {
    const tint = `var(--series-${index % 8})`;
    const points = suite.versions.map((each) => ({ each, x: across(each.version), ends: each[this.reading].map(up) }));
    if (!points.length) return [];
    const band = [...points.map(({ x, ends }) => `${x},${ends[2]}`), ...points.toReversed().map(({ x, ends }) => `${x},${ends[1]}`)];
    return [
      svg("polygon", { points: band.join(" "), fill: tint, opacity: 0.13 }),
      svg("polyline", { points: points.map(({ x, ends }) => `${x},${ends[0]}`).join(" "), fill: "none", stroke: tint, "stroke-width": 2 }),
      ...points.map(({ x, ends }) => svg("path", { d: `M${x} ${ends[1]}V${ends[2]}M${x - 3} ${ends[1]}h6M${x - 3} ${ends[2]}h6`, stroke: tint, "stroke-width": 1.2, opacity: 0.75 })),
      ...points.map(({ each, x, ends }) => svg("circle", { cx: x, cy: ends[0], r: 3.6, stroke: tint, "stroke-width": 1.6, fill: each.trials < suite.trials ? "var(--card)" : tint })),
    ];
  }

  legend() {
    byId("suites").replaceChildren(...this.suites.map((suite, index) => {
      const swatch = make("i");
      swatch.style.background = `var(--series-${index % 8})`;
      const words = suite.unplayable ? `${suite.name} is not played: ${suite.unplayable}` : `${suite.name} in ${suite.backend}`;
      return make("span", {}, swatch, words);
    }));
  }

  point(event) {
    const x = event.clientX - byId("success").getBoundingClientRect().left;
    const versions = [...new Set(this.suites.flatMap((suite) => suite.versions.map((each) => each.version)))];
    this.chosen = versions.length ? versions.reduce((best, at) => (Math.abs(this.across(at) - x) < Math.abs(this.across(best) - x) ? at : best)) : null;
    this.tell();
  }

  tell() {
    const told = this.suites.flatMap((suite) => {
      const score = this.chosen === null ? suite.versions.at(-1) : suite.versions.find((each) => each.version === this.chosen);
      if (!score) return [];
      const [rate, low, high] = score[this.reading];
      const reasons = Object.entries(score.reasons).sort((one, other) => other[1] - one[1]).slice(0, 3)
        .map(([reason, count]) => `${count} ${this.reasons[reason] ?? reason.replaceAll("_", " ")}`);
      const name = this.suites.length > 1 ? `${suite.name}, ` : "";
      return [`${name}policy ${score.version}: ${this.reading} ${percent(rate)} % (${percent(low)} to ${percent(high)}) of ${score.trials}`
        + (reasons.length ? `; ${reasons.join(", ")}` : "")];
    });
    byId("success-readout").textContent = told.join(". ");
  }
}

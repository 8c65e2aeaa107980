// The loss of the training, stage after stage, on a logarithmic axis.

import { byId, svg, ticks } from "./dom.js";

const MARGIN = { top: 10, right: 12, bottom: 24, left: 46 };
const TINTS = { pretraining: "--series-4", coupled: "--series-0" };

export class Loss {
  constructor() {
    this.losses = [];
    this.policies = [];
  }

  show({ losses, policies }) {
    this.losses = losses;
    this.policies = policies;
    this.redraw();
  }

  // Coupled training follows pre-training on the axis of epochs, though each counts its own.
  segments() {
    const found = [];
    let offset = 0;
    for (const [stage, epoch, loss] of this.losses) {
      let last = found.at(-1);
      if (!last || last.stage !== stage || epoch < last.epoch) {
        if (last && last.stage !== stage) offset = last.offset + last.epoch;
        last = { stage, points: [], epoch: 0, offset };
        found.push(last);
      }
      last.epoch = epoch;
      last.points.push([last.offset + epoch, Math.max(loss, 1e-9)]);
    }
    return found;
  }

  redraw() {
    const place = byId("loss");
    const { width, height } = place.getBoundingClientRect();
    if (width < 50) return;
    const segments = this.segments();
    const offset = segments.find((each) => each.stage === "coupled")?.offset ?? segments.at(-1)?.offset ?? 0;
    const dots = this.policies.map(([version, epoch, loss]) => ({ version, at: [offset + epoch, Math.max(loss, 1e-9)] }));
    const points = [...segments.flatMap((each) => each.points), ...dots.map((each) => each.at)];
    if (!points.length) {
      place.replaceChildren(svg("svg", {}, svg("text", { x: 4, y: 24 }, "The learner has told no loss yet.")));
      return;
    }
    const epochs = points.map(([epoch]) => epoch);
    const first = Math.min(...epochs);
    const last = Math.max(...epochs, first + 1);
    const logs = points.map(([, loss]) => Math.log10(loss));
    const [low, high] = [Math.min(...logs) - 0.05, Math.max(...logs, Math.min(...logs) + 0.3) + 0.05];
    const across = (epoch) => MARGIN.left + (width - MARGIN.left - MARGIN.right) * (epoch - first) / (last - first);
    const up = (loss) => MARGIN.top + (height - MARGIN.top - MARGIN.bottom) * (high - Math.log10(loss)) / (high - low);
    const marks = [1, 2, 5].flatMap((digit) => Array.from({ length: 12 }, (_, power) => digit * 10 ** (power - 8)))
      .filter((loss) => Math.log10(loss) >= low && Math.log10(loss) <= high);
    const parts = [
      ...marks.flatMap((loss) => [
        svg("line", { class: "grid", x1: MARGIN.left, x2: width - MARGIN.right, y1: up(loss), y2: up(loss) }),
        svg("text", { x: MARGIN.left - 6, y: up(loss) + 4, "text-anchor": "end" }, String(+loss.toPrecision(2))),
      ]),
      ...ticks(first, last, width / 80).map((epoch) => svg("text", { x: across(epoch), y: height - 6, "text-anchor": "middle" }, epoch)),
      ...segments.map((each) => svg("polyline", {
        points: each.points.map(([epoch, loss]) => `${across(epoch)},${up(loss)}`).join(" "),
        fill: "none", stroke: `var(${TINTS[each.stage] ?? "--muted"})`, "stroke-width": 1.8,
      })),
    ];
    const traced = segments.some((each) => each.stage === "coupled");
    if (!traced) {
      parts.push(svg("polyline", { points: dots.map(({ at }) => `${across(at[0])},${up(at[1])}`).join(" "), fill: "none", stroke: "var(--series-0)", "stroke-width": 1, "stroke-dasharray": "3 3" }));
    }
    parts.push(...dots.map(({ version, at }) => svg("circle", { cx: across(at[0]), cy: up(at[1]), r: 3.4, fill: "var(--card)", stroke: "var(--series-0)", "stroke-width": 1.6 }, svg("title", {}, `policy ${version}`))));
    place.replaceChildren(svg("svg", { role: "img", "aria-label": "loss by epoch" }, ...parts));
    const [stage, epoch, loss] = this.losses.at(-1) ?? ["", dots.at(-1).at[0], dots.at(-1).at[1]];
    byId("loss-readout").textContent = `${stage ? `${stage}, ` : ""}epoch ${epoch}: ${loss.toPrecision(4)}. Log scale; a circle is a policy version`
      + (segments.length > 1 ? "; coupled training follows pre-training" : "");
  }
}

// The PFC's path in the plane of its two main components while robots act, over those of tutored sequences.

import { byId, colour, make, percent, phaseColour, prepared } from "./dom.js";

const MARGIN = 14;

export class PlaneView {
  constructor() {
    this.plane = null;
    this.paths = new Map();
    this.due = false;
  }

  setFolder(folder) {
    this.folder = folder;
    if (!this.plane) this.redraw();
  }

  setPresent(processes) {
    const living = new Set(processes.filter((each) => each.role === "actor" && each.gone_s === null).map((each) => each.id));
    for (const id of this.paths.keys()) if (!living.has(id)) this.paths.delete(id);
  }

  setPlane(plane) {
    this.plane = plane;
    this.paths.clear();
    this.redraw();
  }

  forget() {
    this.paths.clear();
  }

  show(actors) {
    for (const [id, now] of Object.entries(actors)) {
      let path = this.paths.get(id);
      if (!path || path.episode !== now.episode) {
        path = { episode: now.episode, points: [] };
        this.paths.set(id, path);
      }
      if (now.path) now.path[0].forEach((x, index) => path.points.push([x, now.path[1][index], now.path[2][index]]));
    }
    if (!this.due) {
      this.due = true;
      requestAnimationFrame(() => { this.due = false; this.redraw(); });
    }
  }

  bounds() {
    const [xs, ys] = [0, 1].map((axis) => this.plane.paths.flatMap((path) => path[axis]));
    return [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  }

  redraw() {
    const [plot, width, height] = prepared(byId("plane"));
    if (width < 50) return;
    if (!this.plane) {
      plot.fillStyle = colour("--muted");
      plot.font = "12px system-ui, sans-serif";
      byId("plane-readout").textContent = this.folder === null
        ? "The folder of this run is not on this machine, so there is no plane of tutored states."
        : "The plane appears when there is a policy and a tutored sequence.";
      byId("plane-legend").replaceChildren();
      return;
    }
    const [left, right, low, high] = this.bounds();
    const x = (value) => MARGIN + (width - 2 * MARGIN) * (value - left) / (right - left || 1);
    const y = (value) => height - MARGIN - (height - 2 * MARGIN) * (value - low) / (high - low || 1);
    const count = this.plane.phases.length;
    plot.lineCap = "round";
    plot.globalAlpha = 0.3;
    for (const [xs, ys, phases] of this.plane.paths) {
      this.line(plot, xs.map((value, index) => [x(value), y(ys[index]), phases[index]]), 1, count);
    }
    plot.globalAlpha = 1;
    for (const { points } of this.paths.values()) {
      const placed = points.map(([px, py, phase]) => [x(px), y(py), phase]);
      this.line(plot, placed, 3, count);
      const head = placed.at(-1);
      if (!head) continue;
      plot.beginPath();
      plot.arc(head[0], head[1], 5.5, 0, 7);
      plot.fillStyle = phaseColour(head[2], count);
      plot.strokeStyle = colour("--ink");
      plot.lineWidth = 1.5;
      plot.fill();
      plot.stroke();
    }
    this.legend(count);
  }

  // A line whose pieces have the colours of their phases.
  line(plot, points, width, count) {
    plot.lineWidth = width;
    for (let index = 1; index < points.length; index++) {
      plot.strokeStyle = phaseColour(points[index][2], count);
      plot.beginPath();
      plot.moveTo(points[index - 1][0], points[index - 1][1]);
      plot.lineTo(points[index][0], points[index][1]);
      plot.stroke();
    }
  }

  legend(count) {
    byId("plane-legend").replaceChildren(...this.plane.phases.map((name, index) => {
      const swatch = make("i");
      swatch.style.background = phaseColour(index, count);
      return make("span", {}, swatch, name);
    }));
    const [one, two] = this.plane.explained;
    byId("plane-readout").textContent = `Thin: ${this.plane.sequences} tutored sequences as policy ${this.plane.version} sees them. `
      + `Thick: now. Across ${percent(one)} % of the variance, up ${percent(two)} %`;
  }
}

// The curriculum as a map by the task's own variables: what was shown, corrected, and where policies fail.

import { byId, colour, label, make, markIcon, markOf, MARKS, prepared, setOptions, situationText, ticks } from "./dom.js";

const MARGIN = { top: 8, right: 10, bottom: 34, left: 52 };
const ORDER = ["succeeded", "partly", "tutored", "corrected", "failed"];
const MOST = 20000;
const NEAR = 14;

export class SituationMap {
  constructor(open) {
    this.open = open;
    this.episodes = [];
    this.variables = [];
    this.shown = new Set(ORDER);
    this.due = false;
    for (const id of ["map-x", "map-y", "map-version"]) byId(id).addEventListener("change", () => this.redraw());
    byId("map").addEventListener("pointermove", (event) => this.tell(this.nearest(event)));
    byId("map").addEventListener("pointerleave", () => this.tell(null));
    byId("map").addEventListener("click", (event) => {
      const found = this.nearest(event);
      if (found) this.open(found);
    });
  }

  setTask(task) {
    this.variables = task.variables;
    this.reasons = task.reasons;
    const options = task.variables.map(({ name }) => [name, label(name)]);
    setOptions(byId("map-x"), options);
    setOptions(byId("map-y"), options);
    const continuous = task.variables.filter((each) => each.choices === undefined).map((each) => each.name);
    const [x, y] = [...continuous.slice(-2), ...task.variables.map((each) => each.name)];
    [byId("map-x").value, byId("map-y").value] = [x, y];
  }

  setFolder(folder) {
    this.folder = folder;
  }

  forget() {
    this.episodes = [];
  }

  add(episodes) {
    const names = this.variables.map((each) => each.name);
    this.episodes.push(...episodes.filter((each) => names.every((name) => name in each.situation)));
    if (this.episodes.length > MOST) this.episodes.splice(0, this.episodes.length - MOST);
    if (!this.due) {
      this.due = true;
      setTimeout(() => { this.due = false; this.redraw(); }, 250);
    }
  }

  scale(name, start, end) {
    const variable = this.variables.find((each) => each.name === name);
    if (variable.choices) {
      const gap = (end - start) / variable.choices.length;
      return {
        at: (value, id) => start + gap * (variable.choices.indexOf(value) + 0.5 + 0.6 * (jitter(id, name) - 0.5)),
        marks: variable.choices.map((choice, index) => [start + gap * (index + 0.5), choice]),
      };
    }
    // Suites may stretch the ranges.
    const values = this.episodes.map((each) => each.situation[name]);
    const [least, most] = values.reduce(([a, b], v) => [Math.min(a, v), Math.max(b, v)], [variable.minimum, variable.maximum]);
    const room = 0.04 * (most - least || 1);
    const at = (value) => start + (end - start) * (value - least + room) / (most - least + 2 * room);
    const scaled = ticks(least, most, Math.abs(end - start) / 60);
    return { at, marks: scaled.map((value) => [at(value), String(value)]) };
  }

  redraw() {
    const canvas = byId("map");
    const [plot, width, height] = prepared(canvas);
    if (width < 50 || !this.variables.length) return;
    const newest = Math.max(0, ...this.episodes.map((each) => each.version));
    setOptions(byId("map-version"), [["all", "all policies"], ["newest", newest ? `policy ${newest}` : "the newest policy"]]);
    const [nameX, nameY] = [byId("map-x").value, byId("map-y").value];
    const x = this.scale(nameX, MARGIN.left, width - MARGIN.right);
    const y = this.scale(nameY, height - MARGIN.bottom, MARGIN.top);
    this.frame(plot, width, height, x, y, nameX, nameY);
    const of = byId("map-version").value;
    const kept = this.episodes.filter((each) => of !== "newest" || each.version === newest || each.version === 0);
    const groups = Object.groupBy ? Object.groupBy(kept, markOf) : group(kept);
    this.points = [];
    for (const mark of ORDER) {
      if (!this.shown.has(mark)) continue;
      const many = (groups[mark] ?? []).length > 300;
      plot.globalAlpha = mark === "succeeded" || mark === "partly" ? (many ? 0.35 : 0.6) : 0.9;
      this.drawMarks(plot, mark, (groups[mark] ?? []).map((episode) => {
        const point = { x: x.at(episode.situation[nameX], episode.id), y: y.at(episode.situation[nameY], episode.id), episode };
        this.points.push(point);
        return point;
      }));
    }
    plot.globalAlpha = 1;
    this.legend(groups);
    this.tell(null);
  }

  frame(plot, width, height, x, y, nameX, nameY) {
    plot.font = "11px system-ui, sans-serif";
    plot.strokeStyle = colour("--line");
    plot.fillStyle = colour("--muted");
    plot.lineWidth = 1;
    plot.beginPath();
    for (const [at] of x.marks) { plot.moveTo(at, MARGIN.top); plot.lineTo(at, height - MARGIN.bottom); }
    for (const [at] of y.marks) { plot.moveTo(MARGIN.left, at); plot.lineTo(width - MARGIN.right, at); }
    plot.stroke();
    plot.textAlign = "center";
    for (const [at, text] of x.marks) plot.fillText(shortened(text, 12), at, height - MARGIN.bottom + 14);
    plot.fillText(label(nameX), (MARGIN.left + width - MARGIN.right) / 2, height - 4);
    plot.textAlign = "right";
    for (const [at, text] of y.marks) plot.fillText(shortened(text, 7), MARGIN.left - 6, at + 4);
    plot.save();
    plot.translate(11, (MARGIN.top + height - MARGIN.bottom) / 2);
    plot.rotate(-Math.PI / 2);
    plot.textAlign = "center";
    plot.fillText(label(nameY), 0, 0);
    plot.restore();
  }

  drawMarks(plot, mark, points) {
    const { colour: tint, draw, filled } = MARKS[mark];
    plot.strokeStyle = plot.fillStyle = colour(tint);
    plot.lineWidth = 1.6;
    for (const { x, y } of points) {
      plot.beginPath();
      draw(plot, x, y, mark === "tutored" ? 4.5 : 3.4);
      if (filled) plot.fill();
      else plot.stroke();
    }
  }

  legend(groups) {
    byId("map-legend").replaceChildren(...ORDER.toReversed().map((mark) => make("button", {
      type: "button", "aria-pressed": String(this.shown.has(mark)),
      onclick: () => {
        if (!this.shown.delete(mark)) this.shown.add(mark);
        this.redraw();
      },
    }, markIcon(mark), `${MARKS[mark].words} ${(groups[mark] ?? []).length}`)));
  }

  nearest(event) {
    const place = byId("map").getBoundingClientRect();
    const [x, y] = [event.clientX - place.left, event.clientY - place.top];
    let [best, distance] = [null, NEAR];
    for (const point of this.points ?? []) {
      const apart = Math.hypot(point.x - x, point.y - y);
      if (apart <= distance) [best, distance] = [point.episode, apart];
    }
    return best;
  }

  tell(episode) {
    byId("map").style.cursor = episode ? "pointer" : "";
    if (episode) {
      const how = episode.reason ? `: ${this.reasons[episode.reason] ?? episode.reason.replaceAll("_", " ")}` : "";
      byId("map-readout").textContent = `${MARKS[markOf(episode)].words}${how}. ${situationText(episode.situation)}`;
    } else {
      byId("map-readout").textContent = this.folder === null
        ? "The folder of this run is not on this machine, so its recordings cannot be shown." : "";
    }
  }
}

// Where a point of a discrete variable lies in its column: always the same, so that points do not dance.
function jitter(id, name) {
  let hash = 7;
  for (const letter of id + name) hash = (hash * 31 + letter.charCodeAt(0)) % 1000003;
  return (hash % 1000) / 1000;
}

function group(episodes) {
  const groups = {};
  for (const episode of episodes) (groups[markOf(episode)] ??= []).push(episode);
  return groups;
}

const shortened = (text, most) => (text.length > most ? `${text.slice(0, most - 1)}…` : text);


// Plays a recording: its video, what the network saw, joints and phases, all at the same step.

import { byId, bytesOf, drawGrey, isPale, make, phaseColour, situationText, svg, valueText, wordsAndUnit } from "./dom.js";

const ASK_AGAIN_MS = 700;
const ARM = [2, 3, 4, 5, 6, 7, 8];
const MARGIN = { top: 6, right: 6, bottom: 18, left: 34 };

export class Player {
  constructor() {
    this.episode = null;
    this.step = 0;
    this.playing = false;
    this.video = byId("video");
    byId("player-close").addEventListener("click", () => byId("player").close());
    byId("player").addEventListener("close", () => this.stop());
    byId("player").addEventListener("click", (event) => {
      if (event.target === byId("player") && !document.body.classList.contains("one")) byId("player").close();
    });
    byId("scrub").addEventListener("input", ({ target }) => { this.pause(); this.seek(Number(target.value)); });
    byId("play").addEventListener("click", () => (this.playing ? this.pause() : this.play()));
    byId("joints").addEventListener("click", (event) => this.seekAt(event));
    this.video.addEventListener("error", () => {
      if (this.video.hasAttribute("src")) this.say("This browser cannot play the video.");
    });
  }

  async show(listed, task) {
    this.stop();
    this.task = task;
    this.listed = listed;
    const how = listed.reason ? (task.reasons[listed.reason] ?? listed.reason.replaceAll("_", " ")) : "precise";
    const who = listed.version ? `policy ${listed.version}` : listed.policy;
    byId("player-title").textContent = `${listed.kind} of ${who}: ${how}`;
    this.say("Loading the recording…");
    if (document.body.classList.contains("one")) byId("player").show();
    else byId("player").showModal();
    const answer = await fetch(`/episodes/${encodeURIComponent(listed.id)}`);
    const told = await answer.json();
    if (this.listed !== listed) return;
    if (!answer.ok) { this.say(told.detail); return; }
    this.episode = told;
    this.images = bytesOf(told.images);
    byId("scrub").max = told.steps - 1;
    this.drawPhases();
    this.drawFacts();
    this.redraw();
    this.seek(0);
    this.play();
    this.askVideo(listed);
  }

  say(text) {
    this.video.hidden = true;
    byId("video-state").hidden = false;
    byId("video-state").textContent = text;
  }

  async askVideo(listed) {
    const path = `/episodes/${encodeURIComponent(listed.id)}/video`;
    let told;
    try {
      told = await (await fetch(path)).json();
    } catch {
      told = { state: "failed", problem: "the dashboard does not answer" };
    }
    if (this.listed !== listed) return;
    if (told.state === "ready") { this.startVideo(`${path}.mp4`); return; }
    if (told.state === "waiting") this.say(`The video is rendered after ${told.before} other${told.before > 1 ? "s" : ""}…`);
    else if (told.state === "rendering") this.say(`Rendering the video: ${Math.min(told.frames, this.episode.steps)} of ${this.episode.steps}`);
    else { this.say(`There is no video: ${told.problem ?? told.detail}`); return; }
    this.asking = setTimeout(() => this.askVideo(listed), ASK_AGAIN_MS);
  }

  startVideo(source) {
    this.video.src = source;
    this.video.addEventListener("loadeddata", () => {
      this.video.hidden = false;
      byId("video-state").hidden = true;
      this.seek(this.step);
      if (this.playing) this.play();
    }, { once: true });
  }

  get hasVideo() {
    return !this.video.hidden;
  }

  play() {
    if (!this.episode) return;
    if (this.step >= this.episode.steps - 1) this.seek(0);
    this.playing = true;
    byId("play").textContent = "pause";
    if (this.hasVideo) this.video.play().catch(() => this.pause());
    this.began = performance.now() - this.step * this.episode.period_s * 1000;
    cancelAnimationFrame(this.frame);
    const next = () => {
      if (!this.playing) return;
      const passed = this.hasVideo ? this.video.currentTime : (performance.now() - this.began) / 1000;
      const step = Math.floor(passed / this.episode.period_s + 1e-6);
      this.showStep(Math.min(step, this.episode.steps - 1));
      if (step >= this.episode.steps - 1 && (!this.hasVideo || this.video.ended)) this.pause();
      else this.frame = requestAnimationFrame(next);
    };
    this.frame = requestAnimationFrame(next);
  }

  pause() {
    this.playing = false;
    byId("play").textContent = "play";
    this.video.pause();
  }

  stop() {
    clearTimeout(this.asking);
    this.pause();
    this.listed = this.episode = null;
    this.video.removeAttribute("src");
    this.video.load();
    this.video.hidden = true;
    for (const id of ["phases", "joints", "joints-legend", "facts"]) byId(id).replaceChildren();
  }

  seek(step) {
    this.showStep(step);
    if (this.hasVideo) this.video.currentTime = (step + 0.5) * this.episode.period_s;
    this.began = performance.now() - step * this.episode.period_s * 1000;
  }

  seekAt(event) {
    if (!this.episode) return;
    const { left, width } = byId("joints").getBoundingClientRect();
    const share = (event.clientX - left - MARGIN.left) / (width - MARGIN.left - MARGIN.right);
    this.pause();
    this.seek(Math.round(Math.min(Math.max(share, 0), 1) * (this.episode.steps - 1)));
  }

  showStep(step) {
    this.step = step;
    byId("scrub").value = step;
    byId("step").textContent = `${step + 1}/${this.episode.steps}`;
    drawGrey(byId("seen"), this.images, step * 64 * 48);
    const cursor = byId("joints").querySelector(".cursor");
    if (cursor) {
      const { width } = byId("joints").getBoundingClientRect();
      const x = MARGIN.left + (width - MARGIN.left - MARGIN.right) * step / Math.max(this.episode.steps - 1, 1);
      cursor.setAttribute("x1", x);
      cursor.setAttribute("x2", x);
    }
  }

  drawPhases() {
    const { phases, phase_names: names } = this.episode;
    const parts = [];
    for (const phase of phases) {
      if (parts.at(-1)?.phase === phase) parts.at(-1).steps += 1;
      else parts.push({ phase, steps: 1 });
    }
    byId("phases").replaceChildren(...parts.map(({ phase, steps }) => {
      const tint = phaseColour(phase, names.length);
      const part = make("span", { title: names[phase], class: isPale(tint) ? "pale" : "" }, names[phase]);
      part.style.flex = `${steps} 1 0`;
      part.style.background = tint;
      return part;
    }));
  }

  redraw() {
    if (!this.episode) return;
    const place = byId("joints");
    const { width, height } = place.getBoundingClientRect();
    if (width < 50) return;
    const lines = ARM.map((joint) => this.episode.joints.map((row) => row[joint]));
    const all = lines.flat();
    const [low, high] = [Math.min(...all), Math.max(...all)];
    const x = (step) => MARGIN.left + (width - MARGIN.left - MARGIN.right) * step / Math.max(this.episode.steps - 1, 1);
    const y = (value) => MARGIN.top + (height - MARGIN.top - MARGIN.bottom) * (high - value) / (high - low || 1);
    const marks = [-90, -45, 0, 45, 90].filter((angle) => angle >= low && angle <= high);
    place.replaceChildren(svg("svg", { role: "img", "aria-label": "angles of the arm" },
      ...this.phaseBands(x, height),
      ...marks.flatMap((angle) => [
        svg("line", { class: "grid", x1: MARGIN.left, x2: width - MARGIN.right, y1: y(angle), y2: y(angle) }),
        svg("text", { x: MARGIN.left - 5, y: y(angle) + 4, "text-anchor": "end" }, `${angle}°`),
      ]),
      ...lines.map((line, index) => svg("polyline", {
        points: line.map((value, step) => `${x(step).toFixed(1)},${y(value).toFixed(1)}`).join(" "),
        fill: "none", stroke: `var(--series-${index % 8})`, "stroke-width": 1.5,
      })),
      svg("line", { class: "cursor", x1: x(this.step), x2: x(this.step), y1: MARGIN.top, y2: height - MARGIN.bottom, stroke: "var(--ink)", "stroke-width": 1.2 })));
    byId("joints-legend").replaceChildren(...ARM.map((joint, index) => {
      const swatch = make("i");
      swatch.style.background = `var(--series-${index % 8})`;
      return make("span", {}, swatch, this.task.joints[joint].replace(/^r_/, "").replaceAll("_", " "));
    }));
  }

  // Where phases begin, so that joints and phases can be read together.
  phaseBands(x, height) {
    const { phases, phase_names: names } = this.episode;
    return phases.flatMap((phase, step) => (step && phases[step - 1] === phase ? [] : [
      svg("line", { x1: x(step), x2: x(step), y1: height - MARGIN.bottom, y2: height - MARGIN.bottom + 6, stroke: phaseColour(phase, names.length), "stroke-width": 3 }),
    ]));
  }

  drawFacts() {
    const { outcome, situation } = this.episode;
    const rows = (pairs) => make("dl", {}, ...pairs.flatMap(([name, value]) => [make("dt", {}, name), make("dd", {}, value)]));
    const reading = ["precise", "strict", "lenient"].find((name) => outcome[name]) ?? "failed";
    const measures = Object.entries(outcome.measures).map(([name, [value, unit]]) => [wordsAndUnit(name)[0], measureText(value, unit)]);
    byId("facts").replaceChildren(
      make("h3", {}, `outcome: ${reading}`), rows(measures),
      make("h3", {}, "situation"), rows(Object.entries(situation).map(([name, value]) => [wordsAndUnit(name)[0], valueText(name, value)])));
    byId("facts").setAttribute("aria-label", situationText(situation));
  }
}

function measureText(value, unit) {
  if (unit === "step") return value < 0 ? "never" : `step ${value}`;
  return `${Math.abs(value) < 0.005 ? 0 : +value.toPrecision(3)} ${unit}`.trim();
}

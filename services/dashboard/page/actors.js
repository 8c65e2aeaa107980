// What each actor does: what its eye sees, its phase, its joints, and a picture from outside on demand.

import { byId, bytesOf, drawGrey, make, phaseColour, setOptions } from "./dom.js";

const SHOWN_AT_FIRST = 4;
const MOST_SHOWN = 12;
const GONE_MS = 8000;

export class Actors {
  constructor(send) {
    this.send = send;
    this.cards = new Map();
    this.present = [];
    this.leaving = new Map();
    this.added = new Set();
    this.filmed = new Set();
    this.watched = "";
    this.phases = [];
    this.actions = [];
    byId("actor-select").addEventListener("change", ({ target }) => {
      this.added.add(target.value);
      target.value = "";
      this.arrange();
    });
  }

  setTask(task) {
    this.phases = task.phases;
    this.actions = task.actions;
  }

  setPresent(actors) {
    const living = actors.filter((each) => each.gone_s === null);
    this.present = living.map((each) => each.id).sort();
    for (const [id, card] of this.cards) {
      const metrics = living.find((each) => each.id === id);
      if (!metrics) this.letGo(id, card);
      else this.stay(id, card, metrics);
    }
    this.arrange();
  }

  letGo(id, card) {
    if (this.leaving.has(id)) return;
    card.root.classList.add("gone");
    card.title.textContent = `${id} is gone`;
    this.leaving.set(id, setTimeout(() => {
      card.root.remove();
      this.cards.delete(id);
      this.leaving.delete(id);
      this.added.delete(id);
      this.arrange();
    }, GONE_MS));
  }

  stay(id, card, metrics) {
    clearTimeout(this.leaving.get(id));
    this.leaving.delete(id);
    card.root.classList.remove("gone");
    card.title.textContent = id;
    const speed = `${(metrics.steps_per_s ?? 0).toFixed(0)} steps/s`;
    const idle = metrics.waiting_for ? `waits for ${metrics.waiting_for}` : speed;
    card.speed.textContent = metrics.paused ? "paused" : [metrics.backend, idle].filter(Boolean).join(", ");
  }

  // Which actors are shown: the first ones, those that were chosen, and those that are leaving.
  arrange() {
    const wanted = new Set([...this.present.slice(0, SHOWN_AT_FIRST),
      ...this.present.filter((id) => this.added.has(id))].slice(0, MOST_SHOWN));
    for (const id of wanted) if (!this.cards.has(id)) this.cards.set(id, this.makeCard(id));
    const sorted = [...this.cards.keys()].sort();
    if (sorted.some((id, at) => byId("actors").children[at] !== this.cards.get(id).root)) {
      byId("actors").append(...sorted.map((id) => this.cards.get(id).root));
    }
    const hidden = this.present.filter((id) => !wanted.has(id));
    byId("actor-choice").hidden = hidden.length === 0;
    setOptions(byId("actor-select"), [["", `one of ${hidden.length} more`], ...hidden.map((id) => [id, id])]);
    byId("actors-empty").hidden = this.cards.size > 0;
    this.watch(wanted);
  }

  watch(wanted) {
    const request = JSON.stringify({ watch: [...wanted], film: [...this.filmed].filter((id) => wanted.has(id)) });
    if (request === this.watched) return;
    this.watched = request;
    this.send(JSON.parse(request));
  }

  watchAgain() {
    const before = this.watched;
    this.watched = "";
    if (before) this.send(JSON.parse(before));
    this.watched = before;
  }

  makeCard(id) {
    const seen = make("canvas", { class: "crisp", width: 64, height: 48, role: "img", "aria-label": `what the eye of ${id} sees` });
    const frame = make("i");
    const whole = make("div", { class: "whole", title: "the whole picture of the eye, and the part of it that the network sees" }, frame);
    const part = make("span");
    const title = make("h3", {}, id);
    const tag = make("span", { class: "tag" }, "…");
    const speed = make("span");
    const film = make("button", { type: "button", "aria-pressed": "false" }, "outside view");
    film.addEventListener("click", () => this.film(id));
    const phase = make("div", { class: "phase" }, "waiting");
    const ticks = make("div", { class: "ticks", "aria-hidden": "true" });
    const rows = make("div", { class: "rows" });
    const root = make("article", { class: "actor", "data-actor": id },
      make("div", { class: "head" }, title, tag, film),
      make("div", { class: "eye" }, seen, make("div", { class: "below" }, whole, make("div", {}, part, speed))),
      make("div", {}, phase, ticks, rows));
    return { root, seen, frame, whole, part, title, tag, speed, film, phase, ticks, rows, bars: null, outside: null };
  }

  film(id) {
    const card = this.cards.get(id);
    const on = !this.filmed.has(id);
    if (on) this.filmed.add(id);
    else this.filmed.delete(id);
    card.film.setAttribute("aria-pressed", String(on));
    if (on) {
      card.outside = make("img", { class: "outside", alt: `the scene of ${id} from outside` });
      card.root.append(card.outside);
    } else {
      card.outside?.remove();
      card.whole.querySelector("img")?.remove();
      card.outside = null;
    }
    this.arrange();
  }

  show(actors) {
    for (const [id, now] of Object.entries(actors)) {
      const card = this.cards.get(id);
      if (card && !this.leaving.has(id)) this.showStep(card, now);
    }
  }

  showStep(card, now) {
    drawGrey(card.seen, bytesOf(now.image));
    [card.frame.style.width, card.frame.style.height] = now.crop.map((share) => `${100 * share}%`);
    card.part.textContent = `${Math.round(100 * now.crop[0])} % of the eye's width`;
    const policy = now.version ? `policy ${now.version}` : now.policy;
    card.tag.textContent = `${now.kind}, ${policy}`;
    card.phase.textContent = `${now.step}: ${now.phase}`;
    this.showPhase(card, now.phase);
    this.showAction(card, now);
  }

  showPhase(card, phase) {
    const count = this.phases.length;
    if (card.ticks.childElementCount !== count) {
      card.ticks.replaceChildren(...this.phases.map((name) => make("i", { title: name })));
    }
    const at = this.phases.indexOf(phase);
    [...card.ticks.children].forEach((tick, index) => {
      tick.style.background = index <= at ? phaseColour(index, count) : "";
    });
  }

  // Neck and arm as measured; grasp and focus as commanded.
  showAction(card, now) {
    if (!card.bars) {
      card.bars = this.actions.map(({ name }) => {
        const mark = make("i");
        const value = make("b");
        card.rows.append(make("span", {}, name.replace(/^r_/, "").replaceAll("_", " ")), make("u", {}, mark), value);
        return { mark, value };
      });
    }
    this.actions.forEach(({ minimum, maximum }, index) => {
      const at = index < 9 ? now.joints[index] : now.action[index];
      const share = Math.min(Math.max((at - minimum) / (maximum - minimum), 0), 1);
      card.bars[index].mark.style.left = `${100 * share}%`;
      card.bars[index].value.textContent = index < 9 ? `${at.toFixed(0)}°` : at.toFixed(1);
    });
  }

  showPictures({ actor, outside, eye }) {
    const card = this.cards.get(actor);
    if (!card?.outside) return;
    card.outside.src = `data:image/jpeg;base64,${outside}`;
    let picture = card.whole.querySelector("img");
    if (!picture) {
      picture = make("img", { alt: "" });
      card.whole.prepend(picture);
    }
    picture.src = `data:image/jpeg;base64,${eye}`;
  }
}

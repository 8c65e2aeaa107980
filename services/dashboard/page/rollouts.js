// The list of recorded episodes, the newest first, with filters.

import { byId, make, markIcon, markOf, setOptions, situationText } from "./dom.js";

const ROWS = 60;
const MOST = 20000;

export class Rollouts {
  constructor(open) {
    this.open = open;
    this.episodes = [];
    this.reasons = {};
    this.rows = ROWS;
    this.due = false;
    this.folder = undefined;
    for (const id of ["filter-outcome", "filter-kind", "filter-version", "filter-suite"]) {
      byId(id).addEventListener("change", () => { this.rows = ROWS; this.redraw(); });
    }
  }

  setTask(task) {
    this.reasons = task.reasons;
  }

  setFolder(folder) {
    this.folder = folder;
    if (!this.episodes.length) this.redraw();
  }

  forget() {
    this.episodes = [];
  }

  add(episodes) {
    this.episodes.push(...episodes);
    if (this.episodes.length > MOST) this.episodes.splice(0, this.episodes.length - MOST);
    if (!this.due) {
      this.due = true;
      setTimeout(() => { this.due = false; this.redraw(); }, 250);
    }
  }

  words(reason) {
    return this.reasons[reason] ?? reason.replaceAll("_", " ");
  }

  fillFilters() {
    const counts = (value) => {
      const found = new Map();
      for (const episode of this.episodes) found.set(value(episode), (found.get(value(episode)) ?? 0) + 1);
      return found;
    };
    const reasons = [...counts((each) => (isRollout(each) ? each.reason : ""))].filter(([reason]) => reason);
    setOptions(byId("filter-outcome"), [["all", "every outcome"], ["failed", "not precise"],
      ...reasons.sort((one, other) => other[1] - one[1]).map(([reason, count]) => [`=${reason}`, `${this.words(reason)} (${count})`]),
      ["precise", "precise"]]);
    const kinds = [...counts((each) => each.kind)].sort();
    setOptions(byId("filter-kind"), [["rollouts", "trials and practice"], ...kinds.map(([kind, count]) => [kind, `${kind} (${count})`])]);
    const versions = [...counts((each) => each.version)].filter(([version]) => version).sort((one, other) => other[0] - one[0]);
    setOptions(byId("filter-version"), [["all", "every policy"], ...versions.map(([version]) => [version, `policy ${version}`])]);
    const suites = [...counts((each) => each.suite)].sort();
    setOptions(byId("filter-suite"), [["all", "every suite"], ...suites.map(([suite]) => [suite, suite])]);
    byId("filter-suite").hidden = suites.length < 2;
  }

  chosen() {
    const [outcome, kind, version, suite] = ["outcome", "kind", "version", "suite"].map((id) => byId(`filter-${id}`).value);
    return this.episodes.filter((each) => (kind === "rollouts" ? isRollout(each) : each.kind === kind)
      && (version === "all" || String(each.version) === version)
      && (suite === "all" || each.suite === suite)
      && (outcome === "all" || (outcome === "failed" ? each.reason : outcome === "precise" ? !each.reason : outcome === `=${each.reason}`)));
  }

  redraw() {
    this.fillFilters();
    const chosen = this.chosen();
    const shown = chosen.slice(-this.rows).reverse();
    byId("rollouts").tBodies[0].replaceChildren(...shown.map((episode) => this.row(episode)));
    byId("rollouts-count").textContent = chosen.length > shown.length ? `the newest ${shown.length} of ${chosen.length}` : `${chosen.length}`;
    const empty = this.folder === null ? "The folder of this run is not on this machine, so its recordings cannot be shown."
      : this.episodes.length ? "None is like this." : "Nothing is recorded yet.";
    byId("rollouts-empty").textContent = chosen.length ? "" : empty;
    byId("rollouts-empty").hidden = chosen.length > 0;
    if (chosen.length > shown.length) {
      byId("rollouts").tBodies[0].append(make("tr", { tabindex: 0, onclick: () => { this.rows *= 4; this.redraw(); } },
        make("td", { colspan: 5, class: "muted" }, "show more")));
    }
  }

  row(episode) {
    const open = () => this.open(episode);
    const policy = episode.version ? String(episode.version) : episode.policy;
    const suite = episode.suite === "unlearned" ? "" : `, ${episode.suite}`;
    const when = episode.started_s ? new Date(1000 * episode.started_s).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" }) : "";
    return make("tr", { tabindex: 0, "data-episode": episode.id, onclick: open, onkeydown: ({ key }) => { if (key === "Enter") open(); } },
      make("td", {}, make("span", { class: "outcome" }, markIcon(markOf(episode)), this.outcome(episode))),
      make("td", { class: "kind" }, episode.kind + suite),
      make("td", {}, policy),
      make("td", { class: "situation" }, situationText(episode.situation)),
      make("td", { class: "when" }, when));
  }

  outcome(episode) {
    return episode.reason ? this.words(episode.reason) : "precise";
  }
}

const isRollout = (episode) => episode.kind === "trial" || episode.kind === "practice";

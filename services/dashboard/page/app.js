// Connects to the dashboard and hands each topic to the part of the page that shows it.

import { byId, make, percent } from "./dom.js";
import { Actors } from "./actors.js";
import { Success } from "./success.js";
import { Loss } from "./loss.js";
import { SituationMap } from "./map.js";
import { PlaneView } from "./plane.js";
import { Rollouts } from "./rollouts.js";
import { Player } from "./player.js";
import { Processes } from "./processes.js";

const RETRY_MS = 1500;
const run = { task: null, control: false };
let socket = null;

const send = (request) => {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(request));
};

const player = new Player();
const actors = new Actors(send);
const success = new Success();
const loss = new Loss();
const plane = new PlaneView();
const rollouts = new Rollouts((episode) => player.show(episode, run.task));
const map = new SituationMap((episode) => player.show(episode, run.task));
const processes = new Processes(send);

const topics = {
  mode({ live }) {
    document.body.classList.toggle("one", !live);
    run.live = live;
  },
  task(task) {
    run.task = task;
    for (const part of [actors, success, map, rollouts]) part.setTask(task);
  },
  viewer({ control }) {
    processes.setControl(control);
  },
  run(told) {
    run.told = told;
    byId("run-name").textContent = told.name;
    document.title = `${told.name} · vmdnn`;
    rollouts.setFolder(told.folder);
    map.setFolder(told.folder);
    plane.setFolder(told.folder);
    showBanner();
  },
  processes(told) {
    processes.show(told);
    actors.setPresent(told.processes.filter((each) => each.role === "actor"));
    showFigures(told.processes);
    plane.setPresent(told.processes);
  },
  suites({ suites }) {
    success.show(suites);
    run.suites = suites;
  },
  losses: (told) => loss.show(told),
  logs: (told) => processes.showLogs(told),
  plane: (told) => plane.setPlane(told),
  episodes({ episodes }) {
    rollouts.add(episodes);
    map.add(episodes);
    if (run.live === false) player.show(episodes[0], run.task);
  },
  actors(told) {
    actors.show(told.actors);
    plane.show(told.actors);
  },
  pictures: (told) => actors.showPictures(told),
  told: (told) => processes.tell(told),
};

function showFigures(all) {
  const learner = all.find((each) => each.role === "learner" && each.gone_s === null);
  const living = all.filter((each) => each.role === "actor" && each.gone_s === null);
  const speed = living.reduce((sum, each) => sum + (each.steps_per_s ?? 0), 0);
  const figures = [["actors", `${living.length}`], ["steps/s", speed.toFixed(0)]];
  if (learner?.stage) {
    figures.unshift(["learner", learner.stage], ["epoch", `${learner.epoch} of ${learner.epochs_total}`]);
    if (learner.loss !== null) figures.push(["loss", learner.loss.toPrecision(3)]);
    figures.push(["policy", learner.version ? `${learner.version}` : "none yet"]);
  }
  const newest = run.suites?.[0]?.versions.at(-1);
  if (newest) figures.push(["strict", `${percent(newest.strict[0])} % of ${newest.trials}`]);
  byId("figures").replaceChildren(
    ...figures.map(([name, value]) => make("div", {}, make("dt", {}, name), make("dd", {}, value))),
  );
  const share = learner?.epochs_total ? learner.epoch / learner.epochs_total : 0;
  byId("progress").style.width = `${100 * Math.min(share, 1)}%`;
}

function showBanner(problem = "") {
  const told = run.told;
  const hubAway = told && !told.connected
    ? `No hub answers at ${told.hub}: nothing is live. The page goes on by itself when there is one.` : "";
  const text = problem || hubAway;
  byId("banner").textContent = text;
  byId("banner").hidden = !text;
}

function connect() {
  const protocol = location.protocol === "https:" ? "wss:" : "ws:";
  socket = new WebSocket(`${protocol}//${location.host}/live`);
  socket.onopen = () => {
    for (const part of [rollouts, map, plane]) part.forget(); // all of it is told again
    showBanner();
    actors.watchAgain();
  };
  socket.onmessage = ({ data }) => {
    const told = JSON.parse(data);
    topics[told.topic]?.(told);
  };
  socket.onclose = ({ code, reason }) => {
    const why = reason ? `: ${reason}` : "";
    showBanner(code === 1008 ? `Not connected${why}.`
      : `The connection to the dashboard is lost${why}. Trying again; what is shown may be old.`);
    if (code !== 1008) setTimeout(connect, RETRY_MS);
  };
}

function redrawAll() {
  for (const part of [success, loss, map, plane, player]) part.redraw();
}

if ("WebSocket" in window) connect();
else showBanner("This browser has no WebSocket, so nothing can be shown live. Any browser since 2012 has it; "
  + "in a terminal, vmdnn watch shows the run.");

const drawn = { success, loss, map, plane, joints: player };
const sizes = new ResizeObserver((changes) => {
  for (const { target } of changes) requestAnimationFrame(() => drawn[target.id].redraw());
});
for (const id of Object.keys(drawn)) sizes.observe(byId(id));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redrawAll);

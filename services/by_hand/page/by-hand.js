// The page on which a person tutors the robot. The robot moves only while a request is obeyed; while a
// key is held, the next request is sent when the one before is done.

import { byId, bytesOf, drawGrey, make, situationText } from "/page/dom.js";

const RETRY_MS = 1500;
const STEP_M = 0.02;
const FINE_M = 0.004;
const TURN_DEG = 10;
const FINE_DEG = 2;
const HEAD_DEG = 4;

let socket = null;
let robot = null;
let sent = 0;
let held = null;
let goesOn = false; // a policy was interrupted, and acts again when the person lets go

const fine = (event) => byId("fine").checked || event?.shiftKey === true;

const move = (x, y, z) => (event) => {
  const step = fine(event) ? FINE_M : STEP_M;
  return { do: "move", x: x * step, y: y * step, z: z * step, own: byId("own").checked };
};
const turn = (way) => (event) => ({ do: "move", turn: way * (fine(event) ? FINE_DEG : TURN_DEG) });
const head = (pitch, yaw) => (event) => {
  const step = fine(event) ? FINE_DEG : HEAD_DEG;
  return { do: "head", pitch: pitch * step, yaw: yaw * step };
};
const level = (what, way) => () => ({ do: what, by: way });

// Name, key as `KeyboardEvent.key` in lower case, how the key is shown, and the request.
const CONTROLS = [
  ["hand", [
    ["right", "d", "D", move(1, 0, 0)], ["left", "a", "A", move(-1, 0, 0)],
    ["forward", "w", "W", move(0, 1, 0)], ["back", "s", "S", move(0, -1, 0)],
    ["up", "r", "R", move(0, 0, 1)], ["down", "f", "F", move(0, 0, -1)],
    ["turn left", "q", "Q", turn(1)], ["turn right", "e", "E", turn(-1)],
  ]],
  ["grasp", [["close", "g", "G", level("grasp", 1)], ["open", "b", "B", level("grasp", -1)]]],
  ["gaze", [
    ["up", "arrowup", "↑", head(1, 0)], ["down", "arrowdown", "↓", head(-1, 0)],
    ["left", "arrowleft", "←", head(0, 1)], ["right", "arrowright", "→", head(0, -1)],
  ]],
  ["focus", [["narrower", "+", "+", level("focus", 1)], ["wider", "-", "−", level("focus", -1)]]],
];

const once = (what) => () => ({ do: what });
const ACTIONS = { act: once("act"), next: once("next"), undo: once("undo"), restart: once("restart"), finish: once("finish"),
  keep: once("keep"), discard: once("discard") };
const keys = new Map();

const busy = () => robot === null || robot.busy || robot.done !== sent;

function tell(request) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(request));
}

function ask(request) {
  if ((busy() && !robot?.acting) || socket?.readyState !== WebSocket.OPEN) return;
  sent += 1;
  tell({ id: sent, ...request });
  show();
}

function stop() {
  held = null;
  goesOn = false;
  tell({ id: 0, do: "stop" });
}

// Asks for what corrects a policy that may be acting; it goes on afterwards.
function correct(request) {
  goesOn ||= robot?.acting === true;
  ask(request);
}

// Asks for what a key or button stands for, again and again until `release`.
function hold(name, request, event) {
  held = { name, request, event: { shiftKey: event.shiftKey } };
  correct(request(event));
}

function release(name) {
  if (held?.name !== name) return;
  held = null;
  askNext();
}

// What is asked for when the last request is done: what is held again, or that the policy goes on.
function askNext() {
  if (busy()) return;
  if (robot.problem) held = null;
  if (held) ask(held.request(held.event));
  else if (goesOn) {
    goesOn = false;
    if (robot.can_act) ask({ do: "act" });
  }
}

function buildControls() {
  for (const [group, controls] of CONTROLS) {
    const field = make("fieldset", {}, make("legend", {}, group));
    for (const [words, key, shown, request] of controls) {
      keys.set(key, request);
      const button = make("button", { type: "button", "aria-label": `${group} ${words}` }, words, make("kbd", {}, shown));
      button.addEventListener("pointerdown", (event) => hold(button, request, event));
      for (const end of ["pointerup", "pointerleave", "pointercancel"]) button.addEventListener(end, () => release(button));
      button.addEventListener("click", (event) => { if (event.detail === 0) correct(request(event)); }); // from the keyboard
      field.append(button);
    }
    byId("controls").append(field);
  }
  for (const [id, request] of Object.entries(ACTIONS)) byId(id).addEventListener("click", () => { goesOn = false; ask(request()); });
  byId("stop").addEventListener("click", stop);
  byId("pace").addEventListener("change", ({ target }) => { tellPace(); target.blur(); });
  byId("case").addEventListener("change", ({ target }) => { ask({ do: "case", case: Number(target.value) }); target.blur(); });
  for (const camera of ["eye", "outside"]) {
    byId(camera).addEventListener("click", (event) => {
      const { left, top, width, height } = event.target.getBoundingClientRect();
      correct({
        do: document.querySelector("input[name=click]:checked").value, camera,
        across: Math.min(Math.max((event.clientX - left) / width, 0), 1),
        down: Math.min(Math.max((event.clientY - top) / height, 0), 1),
      });
    });
  }
  document.addEventListener("keydown", onKey);
  document.addEventListener("keyup", (event) => release(event.key.toLowerCase()));
  window.addEventListener("blur", () => { if (held) stop(); });
}

const tellPace = () => tell({ id: 0, do: "pace", factor: Number(byId("pace").value) });

function onKey(event) {
  const key = event.key.toLowerCase();
  if (event.ctrlKey || event.altKey || event.metaKey || event.target.matches("select")) return;
  if (key === "escape") { stop(); return; }
  const request = keys.get(key);
  if (request) {
    event.preventDefault();
    if (!event.repeat) hold(key, request, event);
    return;
  }
  const action = document.querySelector(`button[data-key="${CSS.escape(key)}"]`);
  if (!action || event.repeat || (key === "enter" && event.target.matches("button"))) return;
  event.preventDefault();
  if (!action.disabled) action.click();
}

const centimetres = (mm) => `${(mm / 10).toFixed(1)} cm`;

function show() {
  if (!robot) return;
  const moving = busy();
  document.body.dataset.busy = String(moving);
  document.body.dataset.done = String(robot.done);
  document.body.dataset.acting = String(robot.acting);
  byId("task").textContent = robot.policy ? `${robot.task}: correct a policy by hand` : `${robot.task}, tutored by hand`;
  byId("kind").textContent = robot.policy ? `${robot.kind} of ${robot.policy}` : `${robot.kind} sequence`;
  byId("situation").textContent = situationText(robot.situation);
  byId("kept").textContent = `${robot.kept} kept`;
  showCases();
  byId("phases").replaceChildren(...robot.phases.map((name, index) => make("span", {
    class: index < robot.phase ? "past" : index === robot.phase ? "now" : "", title: name,
  }, name)));
  const touched = robot.touched.length ? ` The robot has touched: ${robot.touched.join(", ")}.` : "";
  byId("state").textContent = (robot.outcome ? outcomeText(robot.outcome)
    : robot.playing ? `Playing it at the task's pace: step ${robot.steps + 1}`
      : robot.acting ? "The policy acts. Hold a key to take over; let go, and it goes on from there."
        : `${robot.steps} control steps so far.${correctionText()}${touched}`);
  byId("problem").textContent = robot.problem;
  const [right, forward, up] = robot.hand_mm;
  const rows = [["hand right", centimetres(right)], ["hand forward", centimetres(forward)], ["hand up", centimetres(up)],
    ["hand turned", `${robot.yaw_deg.toFixed(1)}°`], ["grasp", robot.grasp.toFixed(1)], ["focus", robot.focus.toFixed(1)]];
  byId("hand-state").replaceChildren(...rows.flatMap(([name, value]) => [make("dt", {}, name), make("dd", { id: name.replace(" ", "-") }, value)]));
  const things = robot.things.map(([name, x, y, z, turned]) => [name, ...[x, y, z].map(centimetres), `${turned.toFixed(1)}°`]);
  byId("things").replaceChildren(...things.map((row) => make("tr", { "data-name": row[0] }, ...row.map((text) => make("td", {}, text)))));
  byId("act").hidden = !robot.policy;
  byId("act").disabled = moving || !robot.can_act;
  byId("undo").disabled = moving || !robot.undo;
  byId("restart").disabled = moving || !robot.undo;
  byId("next").disabled = moving || robot.last || robot.outcome !== null;
  byId("finish").disabled = moving || !robot.last || robot.outcome !== null;
  byId("keep").disabled = moving || robot.outcome === null;
  byId("discard").disabled = moving;
}

function correctionText() {
  if (!robot.policy) return "";
  if (robot.corrected) return robot.can_act ? " Corrected; the policy can go on." : " Corrected.";
  return robot.can_act ? "" : " The policy did all of it: correct it, or go to the next case.";
}

function outcomeText(outcome) {
  const reached = outcome.precise ? "precise" : outcome.strict ? "strict success, not precise"
    : outcome.lenient ? "lenient success only" : "no success";
  const why = outcome.precise ? "" : ` (${outcome.reason.replaceAll("_", " ")})`;
  return `Played at the task's pace: ${reached}${why}. Keep it, undo to go on, or restart.`;
}

function showCases() {
  const text = JSON.stringify(robot.cases);
  const select = byId("case");
  if (select.dataset.cases !== text) {
    select.dataset.cases = text;
    select.replaceChildren(...robot.cases.map(([name, kept], value) => make("option", { value }, kept ? `${name} (${kept} kept)` : name)));
  }
  select.value = robot.case;
}

function showPictures({ of, seen, eye, outside, crop }) {
  drawGrey(byId("seen"), bytesOf(seen));
  byId("eye").src = `data:image/jpeg;base64,${eye}`;
  byId("outside").src = `data:image/jpeg;base64,${outside}`;
  byId("crop").style.width = byId("crop").style.height = `${100 * crop}%`;
  document.body.dataset.pictured = String(of);
}

function showBanner(text = "") {
  byId("banner").textContent = text;
  byId("banner").hidden = !text;
  document.body.classList.toggle("away", Boolean(text));
}

function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss:" : "ws:"}//${location.host}/robot`);
  socket.onopen = tellPace;
  socket.onmessage = ({ data }) => {
    const told = JSON.parse(data);
    if (told.topic === "pictures") showPictures(told);
    else if (told.topic === "refused") {
      byId("problem").textContent = told.problem;
      sent = robot?.done ?? 0;
    } else {
      sent = robot === null || told.waiting ? told.done : Math.max(sent, told.done);
      robot = told.waiting ? null : told;
      showBanner(told.waiting && `There is nothing to show yet. The robot waits for ${told.waiting}.`);
      show();
      if (robot) askNext();
    }
  };
  socket.onclose = ({ code, reason }) => {
    robot = held = null;
    goesOn = false;
    if (code === 1008) { showBanner(`Not connected: ${reason}.`); return; }
    showBanner(code === 1013 ? `Not connected: ${reason}. One robot has one tutor; this page goes on when the other leaves.`
      : "The connection to the robot is lost. It stands still, and what was shown so far is kept. Trying again…");
    setTimeout(connect, RETRY_MS);
  };
}

buildControls();
if ("WebSocket" in window) connect();
else showBanner("This browser has no WebSocket, so it cannot move the robot. Any browser since 2012 has it.");

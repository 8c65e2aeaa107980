// The processes of the run: whether they are well, why one is not, what they printed last; and orders.

import { byId, make } from "./dom.js";

const STALE_S = 5;
const SURE_MS = 4000;
const COMMANDS = ["pause", "resume", "checkpoint", "stop"];

export class Processes {
  constructor(send) {
    this.send = send;
    this.control = false;
    this.logs = {};
    this.endings = {};
    this.opened = new Set();
    this.told = { processes: [], more: 0 };
    this.root = byId("processes");
    this.list = make("div");
    this.orders = make("div");
    this.logsRoot = make("div");
    this.root.append(this.list, this.orders, this.logsRoot);
  }

  setControl(control) {
    this.control = control;
    this.orders.replaceChildren(...(control ? ["actor", "learner", "evaluator", "recorder"].map((role) => this.orderRow(role)) : []));
  }

  orderRow(role) {
    return make("div", { class: "orders" }, make("span", {}, `every ${role}`),
      ...COMMANDS.map((command) => this.orderButton(role, command)));
  }

  orderButton(role, command) {
    const button = make("button", { type: "button", "data-order": `${role} ${command}` }, command);
    button.addEventListener("click", () => {
      if (command === "stop" && !button.classList.contains("sure")) { // asked a second time
        button.classList.add("sure");
        button.textContent = "really stop?";
        setTimeout(() => { button.classList.remove("sure"); button.textContent = command; }, SURE_MS);
        return;
      }
      this.send({ command, role });
      byId("told").textContent = `asked every ${role} to ${command}…`;
    });
    return button;
  }

  tell({ replies, problem }) {
    byId("told").textContent = problem ?? replies.join("; ");
  }

  show(told) {
    this.told = told;
    this.list.replaceChildren(...told.processes.map((process) => this.row(process)),
      ...(told.more ? [make("p", { class: "muted" }, `and ${told.more} more that are well`)] : []),
      ...(told.processes.length ? [] : [make("p", { class: "empty" }, "No process of this run is present.")]));
  }

  row(process) {
    const down = process.gone_s !== null;
    const stale = !down && (process.age_s === null || process.age_s > STALE_S);
    const waits = !down && (stale || process.paused);
    const state = down ? "down" : waits ? "waits" : process.waiting_for ? "idle" : "";
    const age = down ? `gone for ${duration(process.gone_s)}` : process.age_s === null ? "no metrics yet" : `${process.age_s.toFixed(1)} s ago`;
    const doing = process.paused ? "paused" : stale && process.age_s !== null ? `silent for ${duration(process.age_s)}`
      : process.waiting_for ? `waits for ${process.waiting_for}` : process.words ?? "";
    return make("div", { class: `process ${state}`, "data-process": `${process.role}/${process.id}` },
      make("span", { class: "dot", title: { down: "gone", waits: "waits", idle: "has nothing to do" }[state] ?? "well" }),
      make("strong", {}, process.role === process.id ? process.role : `${process.role} ${process.id}`),
      make("span", { class: "age", title: "age of its metrics" }, age),
      make("p", {}, [doing, process.refused ? `${process.refused} messages refused` : ""].filter(Boolean).join("; ")),
      down ? this.why(process) : null);
  }

  // Why a process is down: how it ended, and the last trouble that logs of its role tell of.
  why(process) {
    const logs = Object.entries(this.logs).filter(([name]) => name === process.role || name.startsWith(`${process.role}-`));
    const ended = Object.entries(this.endings).filter(([name]) => logs.some(([log]) => log === name)).map(([name, how]) => `${name} ${how}`);
    const troubles = logs.flatMap(([, lines]) => lines.filter((line) => /\b(WARNING|ERROR|CRITICAL)\b|Error\b/.test(line)).slice(-1));
    const text = [...ended, ...troubles].join(". ");
    return make("p", { class: "why" }, text || "Nothing here says why; it may run on another machine, or be gone for good.");
  }

  showLogs({ logs, endings }) {
    this.logs = logs;
    this.endings = endings;
    this.show(this.told);
    this.logsRoot.replaceChildren(...Object.entries(logs).filter(([, lines]) => lines.length).map(([name, lines]) => {
      const details = make("details", { open: this.opened.has(name) }, make("summary", {}, `log of ${name}`), make("pre", {}, lines.join("\n")));
      details.addEventListener("toggle", () => (details.open ? this.opened.add(name) : this.opened.delete(name)));
      return details;
    }));
  }
}

const duration = (seconds) => (seconds < 90 ? `${Math.round(seconds)} s` : seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`);

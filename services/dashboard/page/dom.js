// Elements and small pictures. Texts from a run are set as text, never as markup.

export const byId = (id) => document.getElementById(id);

export function make(tag, attributes = {}, ...children) {
  return fill(document.createElement(tag), attributes, children);
}

export function svg(tag, attributes = {}, ...children) {
  return fill(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, String(value));
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

// The value of a colour of style.css, such as `--good`, for canvases.
export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

export const isDark = () => matchMedia("(prefers-color-scheme: dark)").matches;

// Replaces the options of a <select> and keeps what was chosen, if it is still there.
export function setOptions(select, options) {
  const text = JSON.stringify(options);
  if (select.dataset.options === text) return;
  const chosen = select.value;
  select.dataset.options = text;
  select.replaceChildren(...options.map(([value, words]) => make("option", { value }, words)));
  if (options.some(([value]) => String(value) === chosen)) select.value = chosen;
}

const VIRIDIS = ["#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30", "#fde725"];

function channels(hex) {
  return [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
}

// Colours of phases in their order: from dark to light, so that also their brightness tells them apart.
export function phaseColour(index, count) {
  if (index < 0) return colour("--muted");
  const [first, last] = isDark() ? [2, 8] : [0, 6.6];
  const at = first + (last - first) * (count > 1 ? index / (count - 1) : 0);
  const low = Math.min(Math.floor(at), VIRIDIS.length - 2);
  const [one, other] = [channels(VIRIDIS[low]), channels(VIRIDIS[low + 1])];
  return `rgb(${one.map((value, c) => Math.round(value + (other[c] - value) * (at - low))).join(" ")})`;
}

export const isPale = (rgb) => {
  const [r, g, b] = rgb.match(/\d+/g).map(Number);
  return 0.3 * r + 0.6 * g + 0.1 * b > 140;
};

const UNITS = { m: "m", deg: "°", mm: "mm" };

// `object_y_m` gives ["object Y", "m"].
export function wordsAndUnit(name) {
  const words = name.split("_");
  const unit = words.length > 1 ? UNITS[words[words.length - 1]] : undefined;
  if (unit) words.pop();
  return [words.map((word) => (word.length === 1 ? word.toUpperCase() : word)).join(" "), unit ?? ""];
}

export function label(name) {
  const [words, unit] = wordsAndUnit(name);
  return unit ? `${words} (${unit})` : words;
}

export function valueText(name, value) {
  if (typeof value !== "number") return String(value);
  const unit = wordsAndUnit(name)[1];
  const shown = unit === "m" ? value.toFixed(3) : Math.abs(value) >= 100 ? value.toFixed(0) : String(+value.toFixed(1));
  return unit === "°" ? `${shown}°` : `${shown} ${unit}`.trim();
}

export function situationText(situation) {
  return Object.entries(situation).map(([name, value]) => `${wordsAndUnit(name)[0]} ${valueText(name, value)}`).join(", ");
}

export const percent = (rate, digits = 0) => (100 * rate).toFixed(digits);

// Marks of how an episode ended or why it was played: shapes as well as colours.
export const MARKS = {
  tutored: { colour: "--muted", draw: (p, x, y, r) => p.rect(x - r, y - r, 2 * r, 2 * r), words: "tutored" },
  corrected: { colour: "--warm", draw: (p, x, y, r) => diamond(p, x, y, r * 1.35), words: "corrected", filled: true },
  failed: { colour: "--bad", draw: (p, x, y, r) => cross(p, x, y, r), words: "failed" },
  succeeded: { colour: "--good", draw: (p, x, y, r) => p.arc(x, y, r * 0.8, 0, 7), words: "precise", filled: true },
  partly: { colour: "--accent", draw: (p, x, y, r) => p.arc(x, y, r * 0.9, 0, 7), words: "lifted, not precise" },
};

function diamond(path, x, y, r) {
  path.moveTo(x, y - r); path.lineTo(x + r, y); path.lineTo(x, y + r); path.lineTo(x - r, y); path.closePath();
}

function cross(path, x, y, r) {
  path.moveTo(x - r, y - r); path.lineTo(x + r, y + r); path.moveTo(x + r, y - r); path.lineTo(x - r, y + r);
}

export function markOf(episode) {
  if (episode.kind === "tutoring") return "tutored";
  if (episode.kind === "correction") return "corrected";
  return episode.reason === "" ? "succeeded" : episode.reached > 0 ? "partly" : "failed";
}

// A mark as a small picture.
export function markIcon(name) {
  const { colour: tint, filled } = MARKS[name];
  const shapes = {
    tutored: () => svg("rect", { x: 2.5, y: 2.5, width: 7, height: 7 }),
    corrected: () => svg("path", { d: "M6 1 11 6 6 11 1 6Z" }),
    failed: () => svg("path", { d: "M2 2 10 10M10 2 2 10" }),
    succeeded: () => svg("circle", { cx: 6, cy: 6, r: 4 }),
    partly: () => svg("circle", { cx: 6, cy: 6, r: 4 }),
  };
  const shape = shapes[name]();
  shape.setAttribute("fill", filled ? `var(${tint})` : "none");
  shape.setAttribute("stroke", `var(${tint})`);
  shape.setAttribute("stroke-width", filled ? "0" : "2");
  return svg("svg", { viewBox: "0 0 12 12", "aria-hidden": "true" }, shape);
}

// A canvas that has the pixels of the screen; gives its context, width and height in CSS pixels.
export function prepared(canvas) {
  const ratio = devicePixelRatio || 1;
  const { width, height } = canvas.getBoundingClientRect();
  const [wide, high] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== wide || canvas.height !== high) { canvas.width = wide; canvas.height = high; }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return [context, width, height];
}

// Grey levels (base64 of 64 x 48 bytes, from an offset) into a canvas.
export function drawGrey(canvas, bytes, offset = 0) {
  const context = canvas.getContext("2d");
  const picture = context.createImageData(64, 48);
  for (let i = 0; i < 64 * 48; i++) {
    const grey = bytes[offset + i];
    picture.data[4 * i] = picture.data[4 * i + 1] = picture.data[4 * i + 2] = grey;
    picture.data[4 * i + 3] = 255;
  }
  context.putImageData(picture, 0, 0);
}

export const bytesOf = (base64) => Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));

// Nice numbers between two ends, about `count` of them.
export function ticks(low, high, count) {
  const rough = (high - low) / Math.max(count, 1) || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 2.5, 5, 10].find((factor) => factor * power >= rough * 0.999);
  const found = [];
  for (let at = Math.ceil(low / step - 1e-9) * step; at <= high + step * 1e-9; at += step) found.push(+at.toPrecision(10));
  return found;
}

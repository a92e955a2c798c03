// Small helpers for elements, icons, files and text.

/** An element with properties, attributes, listeners (onclick: …) and children; null and false children are left out. */
export function h(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (value === true) element.setAttribute(key, "");
    else if (value !== false && value != null) element.setAttribute(key, value);
  }
  element.append(...children.flat(2).filter((child) => child != null && child !== false));
  return element;
}

export const $ = (id) => document.getElementById(id);

export function svg(name, attributes = {}) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  return element;
}

// 20 × 20, drawn as lines
const ICONS = {
  orbit: "M10 4.5a5.5 5.5 0 1 0 0 11a5.5 5.5 0 0 0 0-11M2 13c-1.5-2.5 2-5.5 7-7.5s9-2 9.5.5-3 5.5-7.5 7.3-8 1.8-9-.3",
  fly: "M17.5 2.5l-15 6 6 2.7 2.8 6.3zM8.5 11.2l4-4",
  frame: "M3 7V3h4M13 3h4v4M17 13v4h-4M7 17H3v-4M7.5 7.5h5v5h-5z",
  pick: "M10 2v4M10 14v4M2 10h4M14 10h4M10 5.5a4.5 4.5 0 1 0 0 9a4.5 4.5 0 0 0 0-9M10 9.9v.2",
  measure: "M2.5 13.5l11-11 4 4-11 11zM6 10l1.5 1.5M8.5 7.5l2 2M11 5l1.5 1.5",
  path: "M4.5 17a1.8 1.8 0 1 0 0-3.6a1.8 1.8 0 0 0 0 3.6M15.5 6.6a1.8 1.8 0 1 0 0-3.6a1.8 1.8 0 0 0 0 3.6M6.3 15.2h6.2a2.6 2.6 0 0 0 0-5.2h-5a2.6 2.6 0 0 1 0-5.2h6.2",
  camera: "M2.5 6.5h3.3l1.5-2.2h5.4l1.5 2.2h3.3v9.5h-15zM10 8.3a2.7 2.7 0 1 0 0 5.4a2.7 2.7 0 0 0 0-5.4",
  monitor: "M3 17V10M7.7 17V4M12.3 17V8M17 17v-4.5",
  settings: "M3 5.5h8M15 5.5h2M3 10h2M9 10h8M3 14.5h6M13 14.5h4M13 3.7v3.6M7 8.2v3.6M11 12.7v3.6",
  help: "M7.3 7.3a2.7 2.7 0 1 1 4 2.4c-.9.5-1.3 1-1.3 2M10 14.6v.2M10 2.5a7.5 7.5 0 1 0 0 15a7.5 7.5 0 0 0 0-15",
  theme: "M10 3a7 7 0 1 0 0 14zM10 3a7 7 0 0 1 0 14",
  views: "M10 2.5l6.5 3.7v7.6L10 17.5l-6.5-3.7V6.2zM3.5 6.2L10 10l6.5-3.8M10 10v7.5",
  close: "M5 5l10 10M15 5L5 15",
  play: "M6 4l10 6-10 6z",
  stop: "M5 5h10v10H5z",
  record: "M10 5a5 5 0 1 0 0 10a5 5 0 0 0 0-10",
  add: "M10 4v12M4 10h12",
  copy: "M7 7h9v9H7zM4 13V4h9",
  reset: "M4 4v4h4M4.6 8a6 6 0 1 1-.5 3.5",
  eye: "M2 10c2-3.5 4.8-5 8-5s6 1.5 8 5c-2 3.5-4.8 5-8 5s-6-1.5-8-5M10 7.7a2.3 2.3 0 1 0 0 4.6a2.3 2.3 0 0 0 0-4.6",
};

export function icon(name) {
  const picture = svg("svg", { class: "icon", viewBox: "0 0 20 20", "aria-hidden": "true" });
  picture.append(svg("path", { d: ICONS[name] }));
  return picture;
}

/** A button with an icon; its label is read aloud and shown as a tooltip, with the key that does the same. */
export function iconButton(name, label, onclick, key = "") {
  const title = key ? `${label} (${key})` : label;
  return h("button", { type: "button", class: "icon-button", "aria-label": label, title, onclick }, icon(name));
}

export function download(name, blob) {
  const url = URL.createObjectURL(blob);
  const link = h("a", { href: url, download: name });
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

/** A name for a file: what of the text any system takes, and the time. */
export function fileName(text, ending) {
  const now = new Date();
  const two = (n) => String(n).padStart(2, "0");
  const day = `${now.getFullYear()}${two(now.getMonth() + 1)}${two(now.getDate())}`;
  const time = `${two(now.getHours())}${two(now.getMinutes())}${two(now.getSeconds())}`;
  const stem = String(text || "scene").replace(/[^\p{L}\p{N}._-]+/gu, "-").replace(/^[-.]+/, "").slice(0, 80) || "scene";
  return `${stem}-${day}-${time}.${ending}`;
}

export async function copyText(text) {
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    const area = h("textarea", { class: "off-screen", "aria-hidden": "true" }); // no clipboard outside secure contexts
    area.value = text;
    document.body.append(area);
    area.select();
    const done = document.execCommand("copy");
    area.remove();
    if (!done) return toast("The browser does not allow copying here", "error");
  }
  toast("Copied");
}

/** A line that goes away by itself. kind : "info" | "error". */
export function toast(text, kind = "info") {
  const box = $("toasts");
  for (const old of [...box.children].filter((e) => e.textContent === text)) old.remove();
  while (box.children.length >= 4) box.firstChild.remove();
  const line = h("div", { class: `toast ${kind}` }, text);
  box.append(line);
  setTimeout(() => line.remove(), kind === "error" ? 7000 : 2500);
}

// --- numbers as text ----------------------------------------------------------------------------------------------

const PREFIXES = [[1e12, "T"], [1e9, "G"], [1e6, "M"], [1e3, "k"]];

/** 12 345 678 → "12.3 M"; small numbers with three digits. */
export function short(value) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  for (const [step, prefix] of PREFIXES) if (size >= step) return `${digits(value / step)} ${prefix}`;
  return digits(value);
}

/** Three significant digits, all of those before the point. */
export function digits(value) {
  const size = Math.abs(value);
  if (size === 0) return "0";
  if (size < 1e-4) return value.toExponential(1);
  const places = size >= 100 ? 0 : size >= 10 ? 1 : size >= 0.1 ? 2 : Math.min(6, 2 - Math.floor(Math.log10(size)));
  return Number.isInteger(value) ? String(value) : value.toFixed(places);
}

/** A length or coordinate with the digits that mean something in a scene of this size. */
export function coordinate(value, size) {
  const places = Math.max(0, Math.min(12, Math.ceil(5 - Math.log10(size > 0 ? size : 1))));
  return Math.abs(value) >= 1e15 ? value.toExponential(6) : value.toFixed(places);
}

/** Milliseconds, so that they stay below each other while they change. */
export const ms = (value) => `${value.toFixed(value < 10 ? 2 : value < 100 ? 1 : 0)} ms`;

/** The value of a metric in the unit that the end of its name says. */
export function metric(name, value) {
  if (!Number.isFinite(value)) return "–";
  if (name.endsWith("_ms")) return ms(value);
  if (name === "cpu") return value.toFixed(2);
  if (name.endsWith("bytes_per_s")) return `${short(value)}B/s`.replace(/(\d)B/, "$1 B");
  if (name.endsWith("bytes")) return `${short(value)}B`.replace(/(\d)B/, "$1 B");
  if (name.endsWith("per_s")) return `${digits(value)} /s`;
  if (name === "missing" || name.endsWith("cache_hits") || name.endsWith(".missing")) return `${digits(100 * value)} %`;
  return short(value);
}

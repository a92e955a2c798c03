// The page of a live run: what arrives goes to the picture and the panels, what people do goes to the hub.

import * as cameras from "./camera.js";
import { Connection, takeToken } from "./connection.js";
import { Controls } from "./controls.js";
import { $, h, iconButton, short, toast } from "./dom.js";
import { Monitor } from "./monitor.js";
import { boxLines, Overlay } from "./overlay.js";
import { Panel } from "./panel.js";
import { PathTool } from "./path.js";
import { Picture } from "./picture.js";
import { MeasureTool, PickTool, ScreenshotTool } from "./tools.js";

const RESIZE_MS = 200;
const CAMERA_MS = 12; // between two cameras, however fast the screen is: the hub takes 200 messages a second
const KEPT_TIMES = 512; // of cameras sent
const FOLLOW_MS = 400; // after the last own camera, others may steer
const PICK_S = 10;
const LONGEST = [960, 1280, 1920, 2560];

const connection = new Connection(takeToken());
const picture = new Picture($("scene"), acknowledge, pictureShown);
const overlay = new Overlay($("overlay"), picture);
const monitor = new Monitor(connection);
const panel = new Panel($("settings"), {
  send: (set, onrefused) => connection.open && (connection.say({ kind: "settings", set }, onrefused), true),
  refused: (why) => toast(why, "error"),
  changed: settingsShown,
});
const controls = new Controls(picture, {
  get: () => camera,
  set: steer,
  pick: pickAnchor,
  click: (x, y) => tool?.click?.(x, y),
  double: (x, y) => (tool?.click ? tool.click(x, y) : centreAt(x, y)),
  changed: modeShown,
});

const root = document.documentElement;
let run = null;
let settings = {};
let camera = cameras.cameraOf({ eye: [0, -1, 0], target: [0, 0, 0], up: [0, 0, 1], fov_deg: 45 }, cameras.basisOf("z"), 1);
let home = camera; // the view that the run had when this page came
let homeOf = null;
let size = 1;
let viewer = 0; // the number that the hub gave this page
let tool = null;

// --- the camera -------------------------------------------------------------------------------------------------------

const sent = new Set(); // t of cameras of which no picture has been shown
let unsent = null; // moving, of a camera that waits for the next animation frame
let lastSteer = -Infinity;
let lastSent = -Infinity;

function steer(next, moving) {
  if (!run) return;
  camera = next;
  if (unsent === null && lastSteer < performance.now() - FOLLOW_MS) claimSize();
  lastSteer = performance.now();
  unsent = moving;
  tools.path.moved(camera);
}

function sendCamera() {
  const t = performance.now();
  if (unsent === null || (unsent && t - lastSent < CAMERA_MS)) return;
  lastSent = t;
  if (connection.send({ kind: "camera", view: cameras.viewOf(camera), moving: unsent, t })) {
    sent.add(t);
    if (sent.size > KEPT_TIMES) sent.delete(sent.values().next().value);
  }
  unsent = null;
}

/** The share of a window's place in the picture, or null beside it. */
function placeOf(x, y) {
  const place = picture.share(x, y);
  return place.every((s) => s >= 0 && s <= 1) ? place : null;
}

async function pick(x, y) {
  const place = placeOf(x, y);
  if (!place || !picture.shown) return null;
  try {
    const { header } = await connection.request({ kind: "pick", frame: picture.shown.frame, x: place[0], y: place[1] }, PICK_S);
    return header;
  } catch (error) {
    toast(error.message, "error");
    return null;
  }
}

async function pickAnchor(x, y) {
  if (!picture.shown || !(x >= 0 && x <= 1 && y >= 0 && y <= 1)) return null;
  const { header } = await connection.request({ kind: "pick", frame: picture.shown.frame, x, y }, PICK_S);
  return header.found ? header.position : null;
}

async function centreAt(x, y) {
  const answer = await pick(x, y);
  if (answer?.found) centre(answer.position);
  else if (answer) toast("No point there");
}

function centre(point) {
  controls.goTo(cameras.centreOn(camera, point));
}

function fitted(from = camera) {
  return run ? cameras.fit(from, run.lower, run.upper, picture.aspect) : from;
}

function axisView(name) {
  const [azimuth, elevation] = cameras.AXIS_VIEWS[name];
  controls.goTo(fitted({ ...camera, azimuth, elevation }));
}

// --- pictures ---------------------------------------------------------------------------------------------------------

const shownTimes = [];
const latencies = []; // the last ones, ms

function acknowledge(frame) {
  connection.send({ kind: "ack", frame });
}

function pictureShown(header) {
  const now = performance.now();
  shownTimes.push(now);
  if (shownTimes.length > 240) shownTimes.shift();
  if (header.viewer === viewer) {
    if (sent.delete(header.t)) {
      latencies.push(now - header.t);
      monitor.answered(header.parts_ms, now - header.t);
    }
    if (latencies.length > 2000) latencies.shift();
  } else if (header.view && !controls.busy && unsent === null && now - lastSteer > FOLLOW_MS) {
    camera = cameras.cameraOf(header.view, cameras.basisOf(run?.up), size); // somebody else steers
  }
  overlay.draw();
  notice();
}

function statusShown() {
  const now = performance.now();
  while (shownTimes.length && now - shownTimes[0] > 1000) shownTimes.shift();
  const rate = shownTimes.length;
  $("rate").textContent = rate > 1 ? rate : "–";
  const last = latencies.slice(-15).sort((p, q) => p - q);
  $("latency").textContent = last.length ? Math.round(last[last.length >> 1]) : "–";
  const { shown } = picture;
  if (shown) {
    const scale = shown.scale < 0.995 ? ` (${Math.round(shown.scale * 100)} %)` : "";
    $("resolution").textContent = `${shown.width} × ${shown.height}${scale}`;
    $("motion").textContent = shown.still ? "still" : "moving";
  }
  stateShown();
}

// --- size -------------------------------------------------------------------------------------------------------------

let longest = LONGEST.includes(Number(localStorage.getItem("longest"))) ? Number(localStorage.getItem("longest")) : 1920;
let resizeTimer = 0;

function claimSize() {
  const [width, height] = picture.wanted(longest);
  const asked = { "camera.width": width, "camera.height": height };
  if (!connection.open || Object.entries(asked).every(([key, value]) => settings[key] === value)) return;
  if (run.choices["camera.width"]) connection.say({ kind: "settings", set: asked }, (why) => toast(why, "error"));
}

addEventListener("resize", () => {
  picture.place();
  overlay.draw();
  clearTimeout(resizeTimer);
  resizeTimer = setTimeout(claimSize, RESIZE_MS);
});

document.addEventListener("visibilitychange", () => connection.subscribe({ pictures: !document.hidden }));

// --- what the hub says ------------------------------------------------------------------------------------------------

connection.addEventListener("message", ({ detail: { header, payload } }) => {
  if (header.kind === "picture") picture.accept(header, payload);
  else if (header.kind === "welcome") welcomed(header);
  else if (header.kind === "settings") settingsReceived(header.settings);
  else if (header.kind === "metrics") monitor.received(header);
  else if (header.kind === "prediction") monitor.predicted(header);
});
connection.addEventListener("state", () => {
  stateShown();
  notice();
});

function welcomed(header) {
  run = { ...header.run, choices: header.choices ?? {} };
  viewer = header.viewer;
  const extents = run.lower.map((x, i) => run.upper[i] - x);
  size = Math.hypot(...extents) || 1;
  app.size = size;
  app.run = run;
  app.unit = run.units === undefined ? "m" : run.units || "units";
  settings = header.settings ?? {};
  if (homeOf !== run.scene) { // after a loss the camera stays, or follows the picture
    camera = home = cameras.cameraOf(header.view, cameras.basisOf(run.up), size);
    homeOf = run.scene;
  }
  picture.restart();
  monitor.restart();
  sent.clear();
  const name = run.scene.replace(/\.scene$/, "");
  $("scene-name").textContent = name;
  $("scene-name").title = name;
  $("scene-points").textContent = `${short(run.points)} points`;
  document.title = `${name} – splatpipe`;
  document.body.classList.remove("empty");
  panel.build(run, run.choices, settings, { Picture: [sizeChoice()] });
  for (const each of Object.values(tools)) each.show?.({});
  claimSize();
  notice();
}

function settingsReceived(next) {
  const fov = next["camera.fov_deg"];
  if (fov && fov !== settings["camera.fov_deg"]) {
    camera = { ...camera, fov_deg: fov };
    home = { ...home, fov_deg: fov };
  }
  settings = { ...next };
  panel.confirmed(settings);
}

function settingsShown(shown) {
  const background = shown["render.background"]; // also beside a picture of another shape
  if (CSS.supports("color", background)) root.style.setProperty("--backdrop", background);
  const [box] = shown["filter.boxes"] ?? [];
  overlay.set("box", box && tool === null && !$("panel").hidden ? { lines: boxLines(box.lower, box.upper), kind: "box" } : null);
}

function sizeChoice() {
  const select = h("select", { id: "longest" }, LONGEST.map((n) => h("option", { value: n, selected: n === longest }, `≤ ${n} × ${(n * 5) / 8}`)));
  select.addEventListener("change", () => {
    longest = Number(select.value);
    localStorage.setItem("longest", longest);
    claimSize();
  });
  return h("div", { class: "row" }, h("label", { for: "longest" }, "Size"), select);
}

function stateShown() {
  const { name, until } = connection.state;
  const wait = Math.max(0, Math.ceil((until - Date.now()) / 1000));
  const words = { connecting: "connecting", open: "connected", waiting: `reconnecting in ${wait} s`, ended: "ended" };
  $("state").dataset.state = name;
  if ($("state-text").textContent !== words[name]) $("state-text").textContent = words[name];
}

/** What stands in the middle where there is no picture to look at, or no run. */
function notice() {
  const { name, why } = connection.state;
  const texts = {
    connecting: ["Connecting…", ""],
    waiting: connection.everOpen ? ["Connection lost", `${why ? `The hub said: “${why}”. ` : ""}It comes back by itself.`]
      : ["No connection", "The run does not answer, or the token in the address is not its own."],
    ended: ["The run has ended", [why === "the run is over" ? "" : `${why}.`, picture.shown ? "This is its last picture." : ""].join(" ")],
    open: ["Waiting for the first picture…", ""],
  };
  const settled = name === "open" ? picture.shown !== null : name === "connecting" && connection.everOpen;
  const [title, text] = texts[name];
  $("notice").hidden = settled;
  $("notice-title").textContent = title;
  $("notice-text").textContent = text;
  $("notice-retry").hidden = name !== "waiting" && name !== "ended";
}
$("notice-retry").addEventListener("click", () => connection.retry());

// --- tools and panels -------------------------------------------------------------------------------------------------

const app = { connection, picture, overlay, controls, pick, centre, run: {}, size: 1, unit: "m" };
const tools = {
  pick: new PickTool(app),
  measure: new MeasureTool(app),
  path: new PathTool(app),
  screenshot: new ScreenshotTool(app),
};
const narrow = matchMedia("(max-width: 640px)");

function setTool(name) {
  if (tool !== (tools[name] ?? null)) tool?.closed?.();
  tool = tools[name] ?? null;
  tool?.opened?.();
  for (const [key, button] of Object.entries(toolButtons)) button.setAttribute("aria-pressed", key === name);
  $("card").hidden = !tool;
  $("card-title").textContent = tool?.title ?? "";
  $("card-body").replaceChildren(...(tool ? [tool.element] : []));
  $("scene").classList.toggle("aims", Boolean(tool?.click));
  if (tool && narrow.matches) open({ panel: false, monitor: false });
  settingsShown(settings);
}

/** Panels opened or closed: { panel, monitor }. */
function open(what) {
  if (narrow.matches && Object.values(what).some(Boolean)) {
    if (tool) setTool(null);
    what = { panel: false, monitor: false, ...what };
  }
  for (const [name, on] of Object.entries(what)) {
    $(name).hidden = !on;
    panelButtons[name].setAttribute("aria-expanded", on);
    localStorage.setItem(`open-${name}`, on ? "1" : "");
  }
  if (connection.streams.metrics === $("monitor").hidden) connection.subscribe({ metrics: !$("monitor").hidden });
  monitor.draw();
  settingsShown(settings);
}
const toggle = (name) => open({ [name]: $(name).hidden });
const toggleTool = (name) => setTool(tool === tools[name] ? null : name);

function modeShown() {
  for (const [name, button] of Object.entries(modeButtons)) button.setAttribute("aria-pressed", controls.mode === name);
  $("mode").hidden = controls.mode !== "fly";
  $("mode").textContent = `fly ${short(controls.speed * size)} ${app.unit}/s`;
}

const THEMES = ["light", "dark"];
function setTheme(theme) {
  root.dataset.theme = theme;
  localStorage.setItem("theme", theme);
}
function toggleTheme() {
  const dark = root.dataset.theme
    ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  setTheme(dark ? "light" : "dark");
}

const modeButtons = {
  orbit: iconButton("orbit", "Orbit", () => controls.setMode("orbit"), "O"),
  fly: iconButton("fly", "Fly", () => controls.setMode("fly"), "G"),
};
const toolButtons = {
  pick: iconButton("pick", "Pick a point", () => toggleTool("pick"), "P"),
  measure: iconButton("measure", "Measure", () => toggleTool("measure"), "L"),
  path: iconButton("path", "Camera path", () => toggleTool("path"), "C"),
  screenshot: iconButton("camera", "Screenshot", () => toggleTool("screenshot"), "X"),
};
const panelButtons = {
  monitor: iconButton("monitor", "Monitor", () => toggle("monitor"), "M"),
  panel: iconButton("settings", "Settings", () => toggle("panel"), "N"),
};
const views = iconButton("views", "Views from the axes", () => {}, "1–6");
views.setAttribute("popovertarget", "views-menu");
const AXES = ["top", "front", "right", "bottom", "back", "left"];
$("views-menu").append(...AXES.map((name, i) => h("button", { type: "button", onclick: () => {
  $("views-menu").hidePopover();
  axisView(name);
} }, h("span", {}, name[0].toUpperCase() + name.slice(1)), h("kbd", {}, i + 1))));
$("views-menu").addEventListener("toggle", ({ newState }) => {
  if (newState !== "open") return;
  const { left, bottom, top } = views.getBoundingClientRect();
  const menu = $("views-menu");
  menu.style.left = `${Math.min(left, innerWidth - menu.offsetWidth - 8)}px`;
  menu.style.top = `${bottom + 8 + menu.offsetHeight > innerHeight ? top - 8 - menu.offsetHeight : bottom + 8}px`;
});

$("tools").append(...Object.values(modeButtons), h("hr"), iconButton("frame", "Frame the scene", () => controls.goTo(fitted()), "F"),
  views, h("hr"), ...Object.values(toolButtons));
$("toggles").append(panelButtons.monitor, panelButtons.panel, iconButton("theme", "Light or dark", toggleTheme, "T"),
  iconButton("help", "Help", () => $("help").showModal(), "?"));
for (const [id, close] of [["card", () => setTool(null)], ["panel", () => toggle("panel")], ["monitor", () => toggle("monitor")]]) {
  $(id).querySelector(".card-head").append(iconButton("close", "Close", close));
}
for (const dialog of document.querySelectorAll("dialog")) {
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close()); // beside it
}
$("help-close").addEventListener("click", () => $("help").close());

const KEYS = {
  o: () => controls.setMode("orbit"), g: () => controls.setMode("fly"),
  r: () => controls.goTo({ ...home, fov_deg: camera.fov_deg }), f: () => controls.goTo(fitted()),
  p: () => toggleTool("pick"), l: () => toggleTool("measure"), c: () => toggleTool("path"), x: () => toggleTool("screenshot"),
  k: () => (setTool("path"), tools.path.addKey()),
  m: () => toggle("monitor"), n: () => toggle("panel"), t: toggleTheme,
  h: () => document.body.classList.toggle("bare"), "?": () => $("help").showModal(),
  escape: () => tool?.escape?.() || setTool(null),
};
AXES.forEach((name, i) => (KEYS[i + 1] = () => axisView(name)));

addEventListener("pointerdown", () => delete root.dataset.tabbed, true);
addEventListener("keydown", (event) => {
  if (event.key === "Tab") root.dataset.tabbed = "";
  if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
  const { target, key } = event;
  if (target.matches?.("input:not([type=checkbox], [type=range]), select")) {
    if (key === "Escape") $("scene").focus();
    return;
  }
  if (target.matches?.("[type=range]") && key.startsWith("Arrow")) return;
  const does = KEYS[key.toLowerCase()];
  if (controls.key(event)) event.preventDefault();
  else if (does && !event.repeat) {
    event.preventDefault();
    does();
  }
});

// --- start ------------------------------------------------------------------------------------------------------------

if (THEMES.includes(localStorage.getItem("theme"))) setTheme(localStorage.getItem("theme"));
modeShown();
open({ panel: !narrow.matches && localStorage.getItem("open-panel") !== "", monitor: !narrow.matches && localStorage.getItem("open-monitor") === "1" });
setInterval(statusShown, 250);
requestAnimationFrame(function frame(now) {
  controls.step(now);
  sendCamera();
  requestAnimationFrame(frame);
});
notice();
connection.connect();

/** For scripts and tests: what the page knows, and steering as a hand would. */
window.splatpipe = {
  connection, picture, controls, panel, cameras, latencies,
  get camera() { return camera; },
  set camera(next) { steer(next, true); },
  get unsent() { return unsent !== null; },
  get run() { return run; },
  get settings() { return settings; },
};

// The tools whose cards lie beside the picture: pick a point, measure, take a screenshot.

import { length, subtract } from "./camera.js";
import { coordinate, copyText, digits, download, fileName, h, icon, toast } from "./dom.js";
import { classOf } from "./panel.js";

const MAX_POINTS = 64; // of a measurement

/**
 * What tools are given (`app`): connection, picture, overlay, run (of welcome), size of the scene, unit, and
 * pick(x, y): a promise of { found, position, attributes } for a place in the window.
 */

export class PickTool {
  title = "Pick a point";

  constructor(app) {
    this.app = app;
    this.element = h("div", { class: "card-body" });
    this.clear();
  }

  clear() {
    this.app.overlay.set("pick", null);
    this.element.replaceChildren(h("p", { class: "hint" }, "Click a point to read its position and attributes."));
  }

  closed() {
    this.clear();
  }

  async click(x, y) {
    const answer = await this.app.pick(x, y);
    if (answer) this.show(answer);
  }

  show({ found, position, attributes }) {
    if (!found) {
      this.clear();
      this.element.prepend(h("p", {}, "No point there."));
      return;
    }
    const { size, unit } = this.app;
    this.app.overlay.set("pick", { dots: [position], kind: "pick" });
    const rows = position.map((value, i) => ["xyz"[i], `${coordinate(value, size)} ${unit}`]);
    for (const [name, value] of Object.entries(attributes ?? {})) rows.push([name, this.#text(name, value)]);
    const swatch = attributes?.rgb && h("span", { class: "swatch", "aria-hidden": "true" });
    const lines = rows.map(([name, value]) =>
      h("tr", {}, h("th", { scope: "row" }, name), h("td", {}, name === "rgb" && swatch, value)));
    swatch?.style.setProperty("--dot", rgbOf(attributes.rgb));
    const copied = rows.map(([name, value]) => `${name}\t${value}`).join("\n");
    this.element.replaceChildren(
      h("table", { class: "values" }, h("tbody", {}, lines)),
      h("div", { class: "actions" },
        h("button", { type: "button", onclick: () => copyText(copied) }, icon("copy"), "Copy"),
        h("button", { type: "button", onclick: () => this.app.centre(position) }, icon("orbit"), "Turn around it")),
    );
  }

  #text(name, value) {
    if (name === "classification") return `${value} ${classOf(value)[0]}`;
    if (Array.isArray(value)) return value.map((x) => (Number.isInteger(x) ? x : digits(x))).join(", ");
    return typeof value === "number" && !Number.isInteger(value) ? String(Number(value.toPrecision(9))) : String(value);
  }

}

/** CSS of a colour in 0…255 or 0…65535 a channel. */
const rgbOf = (rgb) => `rgb(${rgb.map((x) => (Math.max(...rgb) > 255 ? Math.round(x / 257) : x)).join(" ")})`;

export class MeasureTool {
  title = "Measure a distance";
  points = [];

  constructor(app) {
    this.app = app;
    this.element = h("div", { class: "card-body" });
    this.show();
  }

  async click(x, y) {
    if (this.points.length >= MAX_POINTS) return toast(`A measurement has at most ${MAX_POINTS} points`, "error");
    const answer = await this.app.pick(x, y);
    if (!answer) return;
    if (!answer.found) return toast("No point there");
    if (String(answer.position) !== String(this.points.at(-1))) this.points.push(answer.position); // a double click is one
    this.show();
  }

  /** A measurement stays to be seen beside other tools; a single point is none. */
  closed() {
    if (this.points.length < 2) this.clear();
  }

  /** { legs: [{ length, delta }], sum } in world units. */
  get result() {
    const legs = this.points.slice(1).map((point, i) => {
      const delta = subtract(point, this.points[i]);
      return { delta, length: length(delta) };
    });
    return { legs, sum: legs.reduce((sum, leg) => sum + leg.length, 0) };
  }

  show() {
    const { points } = this;
    const { size, unit, overlay } = this.app;
    const { legs, sum } = this.result;
    const text = (value) => `${coordinate(value, size)} ${unit}`;
    overlay.set("measure", points.length ? {
      kind: "measure",
      dots: points,
      lines: legs.map((_, i) => [points[i], points[i + 1]]),
      labels: legs.map((leg, i) => [points[i].map((x, k) => x + leg.delta[k] / 2), text(leg.length)]),
    } : null);
    const hint = ["Click two points or more.", "Click the next point."][Math.min(points.length, 1)];
    const head = h("tr", {}, ["", "length", "dx", "dy", "dz"].map((name) => h("th", { scope: "col" }, name)));
    const rows = legs.map((leg, i) =>
      h("tr", {}, h("th", { scope: "row" }, i + 1), [leg.length, ...leg.delta].map((x) => h("td", {}, coordinate(x, size)))));
    const copied = ["leg\tlength\tdx\tdy\tdz", ...legs.map((leg, i) => [i + 1, leg.length, ...leg.delta].join("\t"))].join("\n");
    this.element.replaceChildren(
      ...(legs.length ? [
        h("p", { class: "figure" }, h("output", { id: "measured" }, text(sum)), h("span", { class: "unit" }, legs.length > 1 ? ` in ${legs.length} legs` : "")),
        h("div", { class: "scroll" }, h("table", { class: "legs" }, h("thead", {}, head), h("tbody", {}, rows))),
      ] : []),
      h("p", { class: "hint" }, hint),
      h("div", { class: "actions" },
        h("button", { type: "button", disabled: !points.length, onclick: () => this.undo() }, "Undo"),
        h("button", { type: "button", disabled: !points.length, onclick: () => this.clear() }, "Clear"),
        h("button", { type: "button", disabled: !legs.length, onclick: () => copyText(copied) }, icon("copy"), "Copy")),
    );
  }

  undo() {
    this.points.pop();
    this.show();
  }

  clear() {
    this.points = [];
    this.show();
  }

  /** True: there was something to leave before the tool itself. */
  escape() {
    if (!this.points.length) return false;
    this.clear();
    return true;
  }
}

const SIZES = [["Window", null], ["1080p", [1920, 1080]], ["4K", [3840, 2160]], ["8K", [7680, 4320]]];

export class ScreenshotTool {
  title = "Screenshot";

  constructor(app) {
    this.app = app;
    const field = (id, label) => h("input", { type: "number", id, min: 1, max: 16384, step: 1, "aria-label": label, required: true });
    this.width = field("shot-width", "Width in pixels");
    this.height = field("shot-height", "Height in pixels");
    const presets = SIZES.map(([name, size]) =>
      h("button", { type: "button", class: "chip", onclick: () => this.#size(size ?? this.#window()) }, name));
    this.button = h("button", { type: "submit", class: "primary" }, icon("camera"), "Save picture");
    this.element = h("form", { class: "card-body" },
      h("div", { class: "chips" }, presets),
      h("div", { class: "size" }, this.width, h("span", { "aria-hidden": "true" }, "×"), this.height, h("span", { class: "unit" }, "px")),
      h("p", { class: "hint" }, "Drawn anew at full quality, as a PNG."),
      h("div", { class: "actions" }, this.button));
    this.element.addEventListener("submit", (event) => {
      event.preventDefault();
      this.take();
    });
    this.#size([1920, 1080]);
  }

  #window() {
    const density = devicePixelRatio || 1;
    return [innerWidth, innerHeight].map((side) => Math.round(side * density));
  }

  #size([width, height]) {
    this.width.value = width;
    this.height.value = height;
  }

  async take() {
    const [width, height] = [this.width.valueAsNumber, this.height.valueAsNumber];
    this.button.disabled = true;
    this.element.setAttribute("aria-busy", "true");
    try {
      const { payload } = await this.app.connection.request({ kind: "screenshot", width, height }, 300);
      const name = fileName(this.app.run.scene.replace(/\.scene$/, ""), "png");
      download(name, new Blob([payload], { type: "image/png" }));
      toast(`Saved ${name}`);
    } catch (error) {
      toast(`Screenshot: ${error.message}`, "error");
    }
    this.button.disabled = false;
    this.element.removeAttribute("aria-busy");
  }
}

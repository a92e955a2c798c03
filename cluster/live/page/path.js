// Recording a camera path: keys by hand or sampled from the motion, playing them, and saving them as TOML.

import { pathThrough, viewOf } from "./camera.js";
import { download, h, icon, iconButton, toast } from "./dom.js";

const MAX_KEYS = 240; // a message with all of them stays below the protocol's 64 KiB
const MAX_BYTES = 60_000;
const LONGEST_S = 86_400;
const HAND_S = 2; // between keys added by hand

export class PathTool {
  title = "Camera path";
  /** [{ time (s), camera }], times rising. */
  keys = [];
  #recording = null; // { start, every_s }

  constructor(app) {
    this.app = app;
    this.record = h("button", { type: "button", class: "record", "aria-pressed": "false", onclick: () => this.toggle() });
    this.play = h("button", { type: "button", onclick: () => this.preview() });
    this.save = h("button", { type: "button", class: "primary", onclick: () => this.store() }, "Save TOML");
    this.fps = h("input", { type: "number", id: "path-fps", min: 1, max: 240, value: 30, "aria-label": "Frames a second of the film" });
    this.list = h("ol", { class: "keys" });
    this.hint = h("p", { class: "hint" });
    this.clearButton = h("button", { type: "button", onclick: () => this.clear() }, "Clear");
    this.element = h("div", { class: "card-body" },
      h("div", { class: "actions" }, this.record,
        h("button", { type: "button", onclick: () => this.addKey() }, icon("add"), "Add key")),
      this.hint, this.list,
      h("div", { class: "actions" }, this.play, this.clearButton),
      h("div", { class: "actions" }, this.save, h("label", { for: "path-fps" }, "at"), this.fps, h("span", { class: "unit" }, "frames/s")));
    this.show();
  }

  opened() {
    this.open = true;
    this.show();
  }

  closed() {
    this.open = false;
    this.show();
  }

  toggle() {
    this.#recording = this.#recording ? null : { start: performance.now(), every_s: 0.1 };
    if (this.#recording) this.keys = [];
    this.show();
    if (this.#recording) this.moved(this.app.controls.get());
  }

  /** The camera has moved: a key of a recording, no more than ten a second, and fewer the longer it takes. */
  moved(camera) {
    const recording = this.#recording;
    if (!recording) return;
    const time = (performance.now() - recording.start) / 1000;
    const last = this.keys.at(-1);
    if (last && time - last.time < recording.every_s) return;
    // a pause: the key before stays until the motion goes on
    if (last && time - last.time > 2.5 * recording.every_s) this.keys.push({ time: time - recording.every_s, camera: last.camera });
    this.keys.push({ time: Math.min(time, LONGEST_S), camera });
    if (this.keys.length > MAX_KEYS) {
      this.keys = this.keys.filter((_, i) => i % 2 === 0);
      recording.every_s *= 2;
    }
    this.show();
  }

  addKey() {
    if (this.keys.length >= MAX_KEYS) return toast(`A path has at most ${MAX_KEYS} keys`, "error");
    const last = this.keys.at(-1);
    this.keys.push({ time: last ? last.time + HAND_S : 0, camera: this.app.controls.get() });
    this.show();
  }

  preview() {
    const { controls } = this.app;
    if (this.playing) return controls.halt();
    const keys = this.keys.filter((key, i) => key.time !== this.keys[i + 1]?.time);
    const path = pathThrough(keys);
    this.playing = true;
    this.show();
    controls.play((passed_ms) => {
      const time = keys[0].time + passed_ms / 1000;
      return time < keys.at(-1).time ? path(time) : null;
    }, () => this.stopped());
  }

  stopped() {
    this.playing = false;
    this.show();
  }

  clear() {
    this.keys = [];
    this.#recording = null;
    this.show();
  }

  async store() {
    this.#recording = null;
    const start = this.keys[0].time;
    const keys = this.keys.map(({ time, camera }) => ({ time: Number((time - start).toFixed(3)), view: rounded(camera) }));
    const message = { kind: "path", keys, fps: this.fps.valueAsNumber || 30 };
    while (JSON.stringify(message).length > MAX_BYTES) message.keys = message.keys.filter((_, i) => i % 2 === 0);
    try {
      const { header } = await this.app.connection.request(message);
      download("path.toml", new Blob([header.toml], { type: "application/toml" }));
      toast("Saved path.toml");
    } catch (error) {
      toast(`Path: ${error.message}`, "error");
    }
    this.show();
  }

  show() {
    const recording = this.#recording !== null;
    const { keys } = this;
    const span = keys.length ? keys.at(-1).time - keys[0].time : 0;
    this.record.replaceChildren(icon(recording ? "stop" : "record"), recording ? "Stop" : "Record");
    this.record.setAttribute("aria-pressed", recording);
    this.play.replaceChildren(icon(this.playing ? "stop" : "play"), this.playing ? "Stop" : "Play");
    this.play.disabled = keys.length < 2 || recording;
    this.save.disabled = !keys.length;
    this.clearButton.disabled = !keys.length;
    this.hint.textContent = recording ? `Recording: ${keys.length} keys, ${span.toFixed(1)} s. Move the camera.`
      : keys.length ? `${keys.length} ${keys.length === 1 ? "key" : "keys"}, ${span.toFixed(1)} s`
      : "Record while you move, or add keys one by one.";
    this.app.overlay.set("path", this.open && keys.length > 1 && !this.playing ? {
      kind: "path",
      lines: keys.slice(1).map((key, i) => [viewOf(keys[i].camera).eye, viewOf(key.camera).eye]),
    } : null);
    if (recording) return this.list.replaceChildren();
    const focused = [...this.list.querySelectorAll("button, input")].indexOf(document.activeElement);
    this.list.replaceChildren(...keys.map((key, i) => this.#row(key, i)));
    if (focused >= 0) this.list.querySelectorAll("button, input")[focused]?.focus();
  }

  #row(key, i) {
    const time = h("input", { type: "number", min: 0, max: LONGEST_S, step: 0.1, value: Number(key.time.toFixed(2)), "aria-label": `Time of key ${i + 1}, seconds` });
    time.addEventListener("change", () => {
      if (Number.isFinite(time.valueAsNumber)) key.time = Math.max(0, Math.min(LONGEST_S, time.valueAsNumber));
      this.keys.sort((p, q) => p.time - q.time);
      this.show();
    });
    return h("li", {}, h("span", { class: "number" }, i + 1), time, h("span", { class: "unit" }, "s"),
      iconButton("eye", `Show key ${i + 1}`, () => this.app.controls.goTo(key.camera)),
      iconButton("close", `Delete key ${i + 1}`, () => {
        this.keys.splice(i, 1);
        this.show();
      }));
  }
}

/** A view with the digits that its distance can show, so that many fit into a message. */
function rounded(camera) {
  const view = viewOf(camera);
  const places = Math.max(0, Math.min(15, Math.ceil(6 - Math.log10(camera.distance))));
  const place = (x) => Number(x.toFixed(places));
  return {
    eye: view.eye.map(place),
    target: view.target.map(place),
    up: view.up.map((x) => Number(x.toFixed(6))),
    fov_deg: Number(view.fov_deg.toFixed(4)),
  };
}

// The settings: controls made from what the hub offers (`welcome.choices`), in groups that people know.

import { h, iconButton } from "./dom.js";

const DELAY_MS = 60;
const FORGET_MS = 2000;

/** Settings by group; whatever else the hub offers comes last. */
const GROUPS = [
  ["Points", ["sampling.pixel_threshold", "sampling.points_per_pixel", "sampling.point_budget", "render.point_size_px",
    "render.point_size_world", "render.point_size_max_px"]],
  ["Colour", ["render.colour", "render.colormap", "render.colour_range", "render.background"]],
  ["Filter", ["filter.classes", "filter.boxes"]],
  ["Lighting", ["render.edl_strength", "render.edl_radius_px"]],
  ["Picture", ["live.fps", "render.supersampling", "camera.fov_deg"]],
];
const HIDDEN = new Set(["camera.width", "camera.height"]); // follow the window

/** ASPRS classes (LAS 1.4 R15, table 17), with the colours that the renderer gives them. */
const CLASSES = {
  0: ["never classified", "#9e9e9e"], 1: ["unclassified", "#bdbdbd"], 2: ["ground", "#a67c52"],
  3: ["low vegetation", "#c5e1a5"], 4: ["medium vegetation", "#7cb342"], 5: ["high vegetation", "#33691e"],
  6: ["building", "#d84f3f"], 7: ["low point (noise)", "#ff00ff"], 8: ["model key point", "#8d99ae"],
  9: ["water", "#3f8fd2"], 10: ["rail", "#6d4c41"], 11: ["road surface", "#616161"], 12: ["overlap", "#8e9aaf"],
  13: ["wire, guard", "#fdd835"], 14: ["wire, conductor", "#ffb300"], 15: ["transmission tower", "#5e35b1"],
  16: ["wire connector", "#fb8c00"], 17: ["bridge deck", "#90a4ae"], 18: ["high noise", "#ff4dff"],
};
const OTHER_CLASS = "#00bcd4";

/** Name and colour of a classification code. */
export const classOf = (code) => CLASSES[code] ?? [code < 64 ? `reserved ${code}` : `class ${code}`, OTHER_CLASS];

export class Panel {
  #controls = new Map(); // key → { show(value) }
  #wanted = {}; // said within the last moments, not yet answered: the control is the user's
  #unsent = {};
  #timer = 0;
  settings = {};

  /** send(set, onrefused) : to the hub. refused(why). changed(settings) : what holds has been shown. */
  constructor(element, { send, refused, changed }) {
    Object.assign(this, { element, send, refused, changed });
  }

  /** Built anew for a run. extra : elements put into a group, { group: [element] }. */
  build(run, choices, settings, extra = {}) {
    const open = new Map([...this.element.querySelectorAll("details")].map((d) => [d.dataset.group, d.open]));
    this.#controls.clear();
    this.#wanted = {};
    this.#unsent = {};
    this.run = run;
    this.choices = choices;
    this.settings = { ...settings };
    const known = new Set(GROUPS.flatMap(([, keys]) => keys));
    const others = Object.keys(choices).filter((key) => !known.has(key) && !HIDDEN.has(key));
    const groups = [...GROUPS, ["More", others]];
    this.element.replaceChildren(
      ...groups.map(([name, keys], i) => {
        const offered = keys.filter((key) => choices[key]);
        const more = extra[name] ?? [];
        if (!offered.length && !more.length) return "";
        const reset = iconButton("reset", `Reset ${name.toLowerCase()}`, (event) => {
          event.preventDefault();
          this.want(Object.fromEntries(offered.map((key) => [key, null])), true);
        });
        const summary = h("summary", {}, h("span", {}, name), reset);
        const rows = offered.map((key) => this.#row(key));
        const group = h("details", { class: "group", "data-group": name }, summary, h("div", { class: "rows" }, rows, more));
        group.open = open.get(name) ?? i < 2;
        return group;
      }),
    );
    this.#showAll();
  }

  #showAll() {
    for (const key of this.#controls.keys()) this.#show(key);
    this.changed(this.settings);
  }

  /** What holds now, said by the hub. */
  confirmed(settings) {
    this.settings = { ...settings };
    for (const [key, wanted] of Object.entries(this.#wanted)) {
      if (JSON.stringify(settings[key]) === JSON.stringify(wanted.value)) delete this.#wanted[key];
    }
    this.#showAll();
  }

  /** Change settings: together with what else comes within a moment, or at once. */
  want(set, now = false) {
    for (const [key, value] of Object.entries(set)) {
      this.#unsent[key] = value;
      if (value !== null) this.#wanted[key] = { value, time: performance.now() };
      else delete this.#wanted[key];
    }
    if (now) clearTimeout(this.#timer);
    if (now || !this.#timer) this.#timer = setTimeout(() => this.#flush(), now ? 0 : DELAY_MS);
  }

  #flush() {
    const set = this.#unsent;
    this.#unsent = {};
    this.#timer = 0;
    const back = () => {
      for (const key of Object.keys(set)) {
        delete this.#wanted[key];
        this.#show(key);
      }
    };
    const sent = this.send(set, (why) => {
      back();
      this.refused(why);
    });
    if (!sent) back();
    // an answer may be rounded, or not come at all: then what holds is shown
    setTimeout(() => this.confirmed(this.settings), FORGET_MS);
  }

  #show(key) {
    const wanted = this.#wanted[key];
    if (wanted && performance.now() - wanted.time < FORGET_MS - 100) return;
    delete this.#wanted[key];
    const value = this.settings[key];
    this.#controls.get(key)?.show(value === undefined ? this.choices[key]?.default : value);
  }

  #row(key) {
    const about = this.choices[key];
    const make = { number, integer: number, boolean, choice, colour, range, classes, boxes }[about.type] ?? text;
    const control = make({
      id: `set-${key.replace(".", "-")}`,
      key,
      about,
      label: about.label ?? key,
      unit: about.unit ?? "",
      run: this.run,
      want: (value) => this.want({ [key]: value }),
      complain: this.refused,
    });
    this.#controls.set(key, control);
    return control.element;
  }
}

const row = ({ id, label }, ...controls) => h("div", { class: "row" }, h("label", { for: id }, label), ...controls);

// --- one control a type; each returns { element, show(value) } ------------------------------------------------------

/** A slider and a field. Wide ranges get a slider that is finer at its lower end. */
function number(of) {
  const { id, about, label, want } = of;
  const whole = about.type === "integer";
  const least = about.least ?? 0;
  const most = about.most ?? Math.max(10, 10 * (about.default || 1));
  const power = most - least > 100 * Math.max(1, Math.abs(about.default || 1)) ? 6 : most - least > 50 ? 2 : 1;
  const round = (x) => Math.max(least, Math.min(most, whole ? Math.round(x) : Number(x.toPrecision(3))));
  const slider = h("input", { type: "range", min: 0, max: 1000, step: 1, "aria-label": label, tabindex: 0 });
  const field = h("input", { type: "number", id, min: least, max: most, step: whole ? 1 : "any", inputmode: "decimal" });
  const place = (x) => Math.round(1000 * Math.max(0, (x - least) / (most - least)) ** (1 / power));
  slider.addEventListener("input", () => {
    const value = round(least + (most - least) * (slider.value / 1000) ** power);
    field.value = value;
    want(value);
  });
  field.addEventListener("change", () => {
    if (field.value === "" || !Number.isFinite(field.valueAsNumber)) return want(null);
    const value = whole ? Math.round(field.valueAsNumber) : field.valueAsNumber;
    slider.value = place(value);
    want(value);
  });
  return {
    element: row(of, slider, h("span", { class: "field" }, field, of.unit && h("span", { class: `unit ${of.unit.length > 2 ? "long" : ""}` }, of.unit))),
    show(value) {
      slider.value = place(value ?? least);
      slider.setAttribute("aria-valuetext", `${value} ${of.unit}`);
      if (document.activeElement !== field || Number(field.value) !== value) field.value = value ?? "";
    },
  };
}

function boolean(of) {
  const box = h("input", { type: "checkbox", id: of.id, class: "switch", role: "switch" });
  box.addEventListener("change", () => of.want(box.checked));
  return { element: row(of, box), show: (value) => (box.checked = Boolean(value)) };
}

function choice(of) {
  const select = h("select", { id: of.id });
  const offer = (options) => select.replaceChildren(...options.map((o) => h("option", { value: o }, String(o))));
  offer(of.about.options ?? []);
  select.addEventListener("change", () => of.want(select.value));
  return {
    element: row(of, select),
    show(value) {
      const options = of.about.options ?? [];
      if (value != null && !options.includes(value)) offer([...options, value]);
      select.value = value;
    },
  };
}

function text(of) {
  const field = h("input", { type: "text", id: of.id, maxlength: 64 });
  field.addEventListener("change", () => of.want(field.value));
  return { element: row(of, field), show: (value) => (field.value = value ?? "") };
}

/** A colour as the browser writes it, or null for what is none. */
function hexOf(value) {
  const context = document.createElement("canvas").getContext("2d");
  context.fillStyle = "#010203";
  context.fillStyle = value;
  return context.fillStyle.startsWith("#") && (context.fillStyle !== "#010203" || value === "#010203") ? context.fillStyle : null;
}

function colour(of) {
  const well = h("input", { type: "color", "aria-label": `${of.label}, chosen` });
  const field = h("input", { type: "text", id: of.id, maxlength: 32, spellcheck: "false", autocomplete: "off" });
  well.addEventListener("input", () => {
    field.value = well.value;
    of.want(well.value);
  });
  field.addEventListener("change", () => of.want(field.value.trim() || null));
  return {
    element: row(of, well, field),
    show(value) {
      field.value = value ?? "";
      well.value = hexOf(value) ?? "#000000";
    },
  };
}

/** Two fields; empty: found by the run. */
function range(of) {
  const fields = ["lower", "upper"].map((end, i) =>
    h("input", { type: "number", step: "any", placeholder: "auto", id: i ? null : of.id, "aria-label": `${of.label}, ${end} end` }),
  );
  const changed = () => {
    const values = fields.map((field) => field.valueAsNumber);
    if (values.every(Number.isNaN)) of.want(null);
    else if (values.every(Number.isFinite)) {
      if (values[0] < values[1]) of.want(values);
      else of.complain(`${of.label}: the lower end has to be below the upper one`);
    }
  };
  for (const field of fields) field.addEventListener("change", changed);
  return {
    element: row(of, h("span", { class: "pair" }, fields[0], h("span", { "aria-hidden": "true" }, "–"), fields[1])),
    show(value) {
      fields.forEach((field, i) => (field.value = value?.[i] ?? ""));
    },
  };
}

/** Codes of a run's classes: a list of codes, of objects with `code` or `name`, or an object by code. */
function codesOf(classes) {
  const list = Array.isArray(classes) ? classes : Object.keys(classes ?? {});
  const codes = list.map((item) => Number(typeof item === "object" ? item.code : item)).filter(Number.isInteger);
  return codes.length ? [...new Set(codes)].sort((p, q) => p - q) : Object.keys(CLASSES).map(Number);
}

function classes(of) {
  const codes = codesOf(of.about.options?.length ? of.about.options : of.run.classes);
  const boxes = new Map();
  const changed = (source) => {
    const on = codes.filter((code) => boxes.get(code).checked);
    if (on.length) return of.want(on.length === codes.length ? [] : on);
    source.checked = true;
    of.complain("At least one class has to stay");
  };
  const lines = codes.map((code) => {
    const [name, colour] = classOf(code);
    const box = h("input", { type: "checkbox", id: `${of.id}-${code}` });
    box.addEventListener("change", () => changed(box));
    boxes.set(code, box);
    const dot = h("span", { class: "dot", "aria-hidden": "true" });
    dot.style.setProperty("--dot", colour);
    const only = h("button", { type: "button", class: "quiet only", "aria-label": `Only ${name}`, onclick: () => set([code]) }, "only");
    return h("div", { class: "class" }, box, h("label", { for: box.id }, dot, name, h("span", { class: "unit" }, ` ${code}`)), only);
  });
  const show = (value) => {
    for (const [code, box] of boxes) box.checked = !value?.length || value.includes(code);
  };
  const set = (value) => {
    show(value);
    of.want(value);
  };
  const all = h("button", { type: "button", class: "quiet", onclick: () => set([]) }, "all");
  return {
    element: h("fieldset", { class: "classes" }, h("legend", {}, h("span", {}, of.label), all), h("div", { class: "class-list" }, lines)),
    show,
  };
}

/** One clip box inside the scene's bounds: a switch, what is kept, six sliders. More boxes of a configuration stay. */
function boxes(of) {
  const { lower, upper } = of.run;
  const flat = lower.map((x, i) => !(upper[i] > x));
  let others = [];
  const on = h("input", { type: "checkbox", id: of.id, class: "switch", role: "switch" });
  const keep = h("select", { id: `${of.id}-keep`, "aria-label": "What the box keeps" },
    h("option", { value: "inside" }, "keep inside"), h("option", { value: "outside" }, "keep outside"));
  const sliders = ["x", "y", "z"].map((axis) =>
    ["least", "most"].map((end, i) =>
      h("input", { type: "range", min: 0, max: 1000, step: 1, value: i * 1000, "aria-label": `Clip box, ${end} ${axis}` }),
    ),
  );
  const outputs = sliders.map(() => h("output", {}));
  const at = (axis, share) => lower[axis] + (upper[axis] - lower[axis]) * share;
  const box = () => ({
    lower: sliders.map(([s], k) => (s.value <= 0 ? at(k, 0) - 1e-3 * (upper[k] - lower[k]) : at(k, s.value / 1000))),
    upper: sliders.map(([, s], k) => (s.value >= 1000 ? at(k, 1) + 1e-3 * (upper[k] - lower[k]) : at(k, s.value / 1000))),
    keep: keep.value,
  });
  const label = () => sliders.forEach(([p, q], k) => {
    const places = Math.max(0, Math.min(12, 4 - Math.ceil(Math.log10(upper[k] - lower[k] || 1))));
    outputs[k].textContent = [p, q].map((s) => at(k, s.value / 1000).toFixed(places)).join(" – ");
  });
  const changed = () => {
    details.hidden = !on.checked;
    label();
    of.want(on.checked ? [box(), ...others] : others);
  };
  on.addEventListener("change", changed);
  keep.addEventListener("change", changed);
  sliders.forEach((pair, k) => pair.forEach((slider, i) => {
    slider.disabled = flat[k];
    slider.addEventListener("input", () => {
      const [p, q] = pair.map((s) => Number(s.value));
      if (p >= q) slider.value = i ? Math.min(1000, p + 1) : Math.max(0, q - 1);
      changed();
    });
  }));
  const details = h("div", { class: "clip" }, keep, sliders.map((pair, k) =>
    h("div", { class: "axis" }, h("span", {}, "xyz"[k]), outputs[k], h("span", { class: "sliders" }, ...pair))));
  details.hidden = true;
  return {
    element: h("div", { class: "stack" }, row({ ...of, label: "Clip box" }, on), details),
    show(value) {
      const [first, ...rest] = value ?? [];
      others = rest;
      on.checked = Boolean(first);
      details.hidden = !first;
      if (first) {
        keep.value = first.keep ?? "inside";
        const share = (x, k) => Math.round(1000 * Math.max(0, Math.min(1, (x - lower[k]) / (upper[k] - lower[k] || 1))));
        sliders.forEach(([p, q], k) => {
          p.value = share(first.lower[k], k);
          q.value = share(first.upper[k], k);
        });
      }
      label();
    },
  };
}

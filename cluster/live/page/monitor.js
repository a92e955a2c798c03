// The monitor over the picture: where each rank's time goes, against the model, and any metric over the last minutes.

import { $, h, iconButton, metric, ms, svg } from "./dom.js";

const HISTORY_S = 120;
const MAX_SERIES = 1024;
const MAX_SAMPLES = 600;
const MAX_CHARTS = 8;
const FIGURES = ["frames_per_s", "queue", "points", "cells", "sent_bytes_per_s", "received_bytes_per_s", "memory_bytes", "cpu",
  "cache_hits", "missing", "viewers", "pictures_per_s", "latency_ms"];
const WORDS = {
  frames_per_s: "frames", sent_bytes_per_s: "sent", received_bytes_per_s: "received", memory_bytes: "memory",
  cache_hits: "cache hits", pictures_per_s: "pictures", latency_ms: "latency", cpu: "cores",
};

export class Monitor {
  #series = new Map(); // "rank name" → [[t, value]]
  #latest = new Map(); // rank → { rank, role, host, values }
  #expected = new Map(); // rank → values
  #parts = []; // of the last pictures that answered a motion: { part: ms }
  #drawn = new Map(); // key → { element, draw(series) }
  #chosen = null; // keys of series; null: nobody has chosen yet

  constructor(connection) {
    this.connection = connection;
    try {
      this.#chosen = JSON.parse(localStorage.getItem("charts"));
    } catch {
      // of another version: as if there were none
    }
    this.ranks = $("ranks");
    this.charts = $("charts");
    this.choice = $("chart-choice");
    this.choice.addEventListener("change", () => {
      this.#choose([...this.#charted, this.choice.value]);
      this.choice.value = "";
    });
    $("left-out").addEventListener("click", () => this.#leftOut());
    $("left-out-close").addEventListener("click", () => $("left-out-list").close());
  }

  /** A new connection: its times start anew. */
  restart() {
    this.#series.clear();
    this.#latest.clear();
    this.#expected.clear();
    this.#parts = [];
    this.draw();
  }

  predicted({ ranks }) {
    for (const { rank, values } of ranks ?? []) if (this.#expected.size < 4096) this.#expected.set(rank, values ?? {});
    this.draw();
  }

  received({ t, ranks }) {
    for (const rank of ranks ?? []) {
      const known = this.#latest.get(rank.rank);
      if (known || this.#latest.size < 4096) this.#latest.set(rank.rank, { ...rank, stages: stagesOf(rank.values) ?? known?.stages });
      for (const [name, value] of Object.entries(rank.values ?? {})) {
        const key = `${rank.rank} ${name}`;
        let series = this.#series.get(key);
        if (!series) {
          if (this.#series.size >= MAX_SERIES) continue;
          this.#series.set(key, (series = []));
        }
        if (Number.isFinite(value)) series.push([t, value]);
        while (series.length > MAX_SAMPLES || series[0]?.[0] < t - HISTORY_S) series.shift();
      }
    }
    this.draw();
  }

  /** A picture that answered a motion: where its time went, ms; all of it took `whole`. */
  answered(parts, whole) {
    const told = Object.values(parts ?? {}).reduce((sum, x) => sum + x, 0);
    if (!told) return;
    this.#parts.push({ ...parts, page: Math.max(0, whole - told) });
    if (this.#parts.length > 20) this.#parts.shift();
  }

  #pictureParts() {
    const box = $("parts");
    box.hidden = !this.#parts.length;
    if (box.hidden) return;
    const mean = (name) => this.#parts.reduce((sum, parts) => sum + (parts[name] ?? 0), 0) / this.#parts.length;
    const parts = Object.keys(this.#parts.at(-1)).map((name) => [name, mean(name)]);
    const sum = parts.reduce((total, [, x]) => total + x, 0);
    const words = parts.map(([name, x]) => `${name.replaceAll("_", " ")} ${ms(x)}`);
    const bar = h("span", { class: "bar parts", role: "img", "aria-label": words.join(", ") });
    for (const [name, x] of parts) {
      const part = h("span", { title: `${name.replaceAll("_", " ")} ${ms(x)}` });
      part.style.setProperty("width", `${(100 * x) / sum}%`);
      bar.append(part);
    }
    box.replaceChildren(h("span", {}, "latency"), bar, h("span", { class: "ms" }, ms(sum)),
      h("span", { class: "words unit" }, words.join(" · ")));
  }

  draw() {
    if (this.ranks.closest("[hidden]")) return;
    this.#pictureParts();
    const ranks = [...this.#latest.values()].sort((p, q) => (p.rank < 0) - (q.rank < 0) || p.rank - q.rank);
    const times = ranks.map(({ rank, stages }) => joined(stages, this.#expected.get(rank)));
    const most = Math.max(1, ...times.flat().map((s) => Math.max((s.work ?? 0) + s.wait, s.expected ?? 0)));
    $("monitor-empty").hidden = ranks.length > 0;
    this.ranks.replaceChildren(...ranks.map((rank, i) => this.#rank(rank, times[i], most)));
    this.#offer();
    this.#charts();
  }

  #rank({ rank, role, host, values }, times, most) {
    const name = rank < 0 ? "hub" : `rank ${rank}`;
    const bars = times.map(({ stage, work, wait, expected }) => {
      const bar = h("span", { class: "bar", role: "img", "aria-label":
        `${stage}: work ${ms(work ?? 0)}, wait ${ms(wait)}${expected === undefined ? "" : `, expected ${ms(expected)}`}` },
      h("span", { class: "work" }), h("span", { class: "wait" }), expected !== undefined && h("span", { class: "expected" }));
      bar.style.setProperty("--work", `${(100 * (work ?? 0)) / most}%`);
      bar.style.setProperty("--wait", `${(100 * wait) / most}%`);
      bar.style.setProperty("--expected", `${(100 * (expected ?? 0)) / most}%`);
      return h("div", { class: "stage" }, h("span", {}, stage), bar, h("span", { class: "ms" }, work === undefined ? "–" : ms(work)));
    });
    const shown = FIGURES.filter((key) => Number.isFinite(values?.[key]));
    const figures = shown.map((key) => h("span", { class: "stat" }, h("span", { class: "unit" }, WORDS[key] ?? key.replaceAll("_", " ")), metric(key, values[key])));
    const rests = rank >= 0 && !stagesOf(values); // no frames of late: the bars show the last ones
    return h("section", { class: `rank ${rests ? "rests" : ""}`, "aria-label": name },
      h("h3", {}, name, h("span", { class: "unit" }, ` ${[rank < 0 ? "" : role, host].filter(Boolean).join(" · ")}`)),
      bars, h("div", { class: "stats" }, figures));
  }

  #offer() {
    const keys = [...this.#series.keys()].sort((p, q) => parseInt(p, 10) - parseInt(q, 10) || p.localeCompare(q));
    const text = keys.join("\n");
    if (text === this.offered || document.activeElement === this.choice) return;
    this.offered = text;
    const groups = Map.groupBy ? Map.groupBy(keys, (key) => key.split(" ")[0]) : new Map([["", keys]]);
    this.choice.replaceChildren(h("option", { value: "" }, "Add a chart…"), ...[...groups].map(([rank, names]) =>
      h("optgroup", { label: rank === "-1" ? "hub" : `rank ${rank}` }, names.map((key) => h("option", { value: key }, key.slice(rank.length + 1))))));
  }

  /** Keys of the series that have charts. */
  get #charted() {
    if (Array.isArray(this.#chosen)) return this.#chosen;
    const keys = [...this.#series.keys()];
    return ["frames_per_s", "render.work_ms"].map((name) => keys.find((key) => key.endsWith(` ${name}`))).filter(Boolean);
  }

  #choose(keys) {
    this.#chosen = [...new Set(keys.filter(Boolean))].slice(-MAX_CHARTS);
    localStorage.setItem("charts", JSON.stringify(this.#chosen));
    this.draw();
  }

  /** Charts stay in the page while their series grow, so that who is at a button of theirs is not thrown off it. */
  #charts() {
    const wanted = this.#charted;
    for (const [key, chart] of this.#drawn) {
      if (wanted.includes(key)) continue;
      chart.element.remove();
      this.#drawn.delete(key);
    }
    for (const key of wanted) {
      if (!this.#drawn.has(key)) this.#drawn.set(key, this.#chart(key));
      const chart = this.#drawn.get(key);
      if (!chart.element.isConnected) this.charts.append(chart.element);
      chart.draw(this.#series.get(key) ?? []);
    }
  }

  #chart(key) {
    const [rank, name] = key.split(" ");
    const line = svg("polyline");
    const picture = svg("svg", { viewBox: "0 0 240 40", preserveAspectRatio: "none", role: "img" });
    picture.append(line);
    const now = h("span", { class: "now" });
    const element = h("div", { class: "chart" },
      h("div", { class: "chart-head" }, h("span", {}, name, h("span", { class: "unit" }, rank === "-1" ? " hub" : ` rank ${rank}`)), now,
        iconButton("close", `Remove the chart of ${name}`, () => this.#choose(this.#charted.filter((k) => k !== key)))),
      picture);
    const draw = (series) => {
      const values = series.map(([, value]) => value);
      const [least, most] = [Math.min(...values), Math.max(...values)];
      const end = series.at(-1)?.[0];
      const place = ([t, value]) => `${(240 - ((end - t) / HISTORY_S) * 240).toFixed(1)} ${(37 - (34 * (value - least)) / (most - least || 1)).toFixed(1)}`;
      line.setAttribute("points", series.map(place).join(" "));
      now.textContent = metric(name, values.at(-1));
      picture.setAttribute("aria-label", values.length ? `${name}, from ${metric(name, least)} to ${metric(name, most)}` : `${name}, nothing yet`);
    };
    return { element, draw };
  }

  async #leftOut() {
    const body = $("left-out-body");
    body.replaceChildren(h("p", { class: "hint" }, "Asking the run…"));
    $("left-out-list").showModal();
    try {
      const { header } = await this.connection.request({ kind: "plan" });
      const list = header.left_out ?? [];
      body.replaceChildren(list.length
        ? h("dl", { class: "left-out" }, list.map(({ what, why, saves }) => [
          h("dt", {}, what, saves && h("span", { class: "unit" }, ` ${saves}`)), h("dd", {}, why)]))
        : h("p", {}, "The run leaves nothing out."));
    } catch (error) {
      body.replaceChildren(h("p", {}, error.message));
    }
  }
}

/** stage → { work, wait }, ms, of a rank's values; null where it has done no frame. */
function stagesOf(values = {}) {
  const names = Object.keys(values).filter((name) => name.endsWith(".work_ms")).map((name) => name.slice(0, -8));
  if (!names.length) return null;
  return Object.fromEntries(names.map((stage) => [stage, { work: values[`${stage}.work_ms`], wait: values[`${stage}.wait_ms`] ?? 0 }]));
}

/** [{ stage, work, wait, expected }], ms: what is measured beside what the model expects. */
function joined(stages, expected = {}) {
  const modelled = stagesOf(expected) ?? {};
  return Object.keys({ ...stages, ...modelled }).map((stage) => ({
    stage,
    work: stages?.[stage]?.work,
    wait: stages?.[stage]?.wait ?? 0,
    expected: modelled[stage]?.work,
  }));
}

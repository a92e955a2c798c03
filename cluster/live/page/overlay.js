// Lines, points and labels over the picture, projected with the picture's own view so that they stay where they belong.

import { project } from "./camera.js";
import { svg } from "./dom.js";

/** Share of a view's distance in front of the eye at which lines are cut. */
const NEAR = 1e-4;

export class Overlay {
  #items = new Map();

  constructor(element, picture) {
    this.element = element;
    this.picture = picture;
  }

  /** Under a name: { lines: [[p, q]], dots: [p], labels: [[p, text]], kind } in world coordinates; null: nothing. */
  set(name, item) {
    if (item) this.#items.set(name, item);
    else this.#items.delete(name);
    this.draw();
  }

  draw() {
    const { shown } = this.picture;
    this.element.replaceChildren();
    if (!shown?.view || !this.#items.size) return;
    const aspect = this.picture.aspect;
    const place = (point) => {
      const [x, y, depth] = project(shown.view, aspect, point);
      return depth > 0 ? this.picture.pixel([x, y]) : null;
    };
    const reach = Math.hypot(...shown.view.eye.map((x, i) => x - shown.view.target[i]));
    for (const { lines = [], dots = [], labels = [], kind = "" } of this.#items.values()) {
      const group = svg("g", { class: `item ${kind}` });
      const path = lines.map((line) => this.#path(line, shown.view, aspect, reach * NEAR)).join("");
      if (path) group.append(svg("path", { class: "casing", d: path }), svg("path", { class: "line", d: path }));
      for (const at of dots.map(place)) {
        if (at && inWindow(at)) group.append(svg("circle", { class: "spot", cx: at[0].toFixed(1), cy: at[1].toFixed(1), r: 5 }));
      }
      for (const [point, words] of labels) {
        const at = place(point);
        if (!at || !inWindow(at)) continue;
        const text = svg("text", { x: at[0].toFixed(1), y: (at[1] - 10).toFixed(1) });
        text.textContent = words;
        group.append(text);
      }
      this.element.append(group);
    }
  }

  #path([p, q], view, aspect, near) {
    let [from, to] = [p, q];
    const [a, b] = [project(view, aspect, p)[2], project(view, aspect, q)[2]];
    if (a < near && b < near) return "";
    const cut = (share) => p.map((x, i) => x + (q[i] - x) * share);
    if (a < near) from = cut((near - a) / (b - a));
    if (b < near) to = cut((near - a) / (b - a));
    const ends = [from, to].map((point) => this.picture.pixel(project(view, aspect, point)));
    if (!ends.flat().every((x) => Math.abs(x) < 1e6)) return ""; // beyond what is drawn exactly
    const [[x0, y0], [x1, y1]] = ends.map((end) => end.map((x) => x.toFixed(1)));
    return `M${x0} ${y0}L${x1} ${y1}`;
  }
}

const inWindow = ([x, y]) => x > -100 && y > -100 && x < innerWidth + 100 && y < innerHeight + 100;

/** The twelve edges of a box. */
export function boxLines(lower, upper) {
  const corner = (i) => [0, 1, 2].map((k) => (i & (1 << k) ? upper[k] : lower[k]));
  const edges = [];
  for (let i = 0; i < 8; i++) for (let k = 0; k < 3; k++) if (!(i & (1 << k))) edges.push([corner(i), corner(i | (1 << k))]);
  return edges;
}

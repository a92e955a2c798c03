// Mouse, touch and keys on the canvas: they make cameras. What a click means is for the tools.

import * as cameras from "./camera.js";

const CLICK_PX = 5;
const CLICK_MS = 500;
const DOUBLE_MS = 350;
const WHEEL_REST_MS = 200;
const PER_PX = 0.006; // radians, orbit
const KEY_RATE = 1.2; // radians a second

export class Controls {
  #pointers = new Map();
  #press = null; // the first pointer since none was down
  #lastClick = null;
  #keys = new Set();
  #wheelTimer = 0;
  #anchor = null; // what the wheel zooms to
  #last = 0;
  #animation = null;
  mode = "orbit";
  /** Of the flight, in sizes of the scene a second. */
  speed = 0.1;

  /**
   * picture : Picture. get(), set(camera, moving) : the camera. pick(x, y) : promise of the point shown at shares of
   * the picture, or null. click(x, y), double(x, y) : places in the window. changed() : mode or speed.
   */
  constructor(picture, { get, set, pick, click, double, changed }) {
    Object.assign(this, { picture, get, set, pick, click, double, changed });
    const canvas = picture.canvas;
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#moved(event));
    canvas.addEventListener("pointerup", (event) => this.#up(event));
    canvas.addEventListener("pointercancel", (event) => this.#up(event, true));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    addEventListener("blur", () => this.#keys.clear());
    addEventListener("keyup", (event) => this.#keys.delete(event.code));
  }

  /** Somebody is at it: what others do is not taken over meanwhile. */
  get busy() {
    return this.#pointers.size > 0 || this.#keys.size > 0 || this.#animation !== null || this.#wheelTimer !== 0;
  }

  setMode(mode) {
    this.mode = mode;
    this.changed();
  }

  /** Goes to a camera in a quarter of a second, or at once for those who want no motion. */
  goTo(camera) {
    this.#drop();
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) return this.set(camera, false);
    this.#animation = { from: this.get(), to: camera, start: performance.now() };
  }

  /** Cameras over time: step(ms since start) gives one, or null at the end. ended() : at the end, or when halted. */
  play(step, ended) {
    this.#drop();
    this.#animation = { step, ended, start: performance.now() };
  }

  halt() {
    if (this.#animation) this.set(this.get(), false);
    this.#drop();
  }

  #drop() {
    const animation = this.#animation;
    this.#animation = null;
    animation?.ended?.();
  }

  // --- pointers ---------------------------------------------------------------------------------------------------

  #down(event) {
    this.picture.canvas.focus({ preventScroll: true });
    this.picture.canvas.setPointerCapture(event.pointerId);
    this.halt();
    if (!this.#pointers.size) this.#press = { x: event.clientX, y: event.clientY, time: event.timeStamp, far: false };
    else this.#press.far = true; // a second finger: no click
    const pans = event.button === 1 || event.button === 2 || event.shiftKey || event.ctrlKey;
    this.#pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, pans });
    if (event.button === 1) event.preventDefault();
  }

  #moved(event) {
    const pointer = this.#pointers.get(event.pointerId);
    if (!pointer) return;
    const { clientX: x, clientY: y } = event;
    if (!this.#press.far) {
      if (Math.hypot(x - this.#press.x, y - this.#press.y) < CLICK_PX) return;
      this.#press.far = true;
      this.picture.canvas.classList.add("held");
    }
    const before = { ...pointer };
    Object.assign(pointer, { x, y });
    const camera = this.get();
    if (this.#pointers.size >= 2) return this.#pinch(event.pointerId, before);
    if (pointer.pans) {
      const share = (p) => this.picture.share(p.x, p.y);
      return this.set(cameras.pan(camera, this.picture.aspect, share(before), share(pointer)), true);
    }
    const turn = this.mode === "fly" ? cameras.look : cameras.orbit;
    const rate = this.mode === "fly" ? this.#anglePerPixel(camera) : PER_PX;
    this.set(turn(camera, (x - before.x) * rate, (y - before.y) * rate), true);
  }

  #anglePerPixel(camera) {
    return (camera.fov_deg * Math.PI) / 180 / this.picture.place_px.height;
  }

  #pinch(id, before) {
    const [first, second] = [...this.#pointers.keys()].slice(0, 2);
    if (id !== first && id !== second) return;
    const now = [this.#pointers.get(first), this.#pointers.get(second)];
    const then = id === first ? [before, now[1]] : [now[0], before];
    const middle = ([p, q]) => this.picture.share((p.x + q.x) / 2, (p.y + q.y) / 2);
    const apart = ([p, q]) => Math.max(8, Math.hypot(p.x - q.x, p.y - q.y));
    const aspect = this.picture.aspect;
    let camera = cameras.pan(this.get(), aspect, middle(then), middle(now));
    const anchor = cameras.pointAt(cameras.viewOf(camera), aspect, middle(now), camera.distance);
    camera = cameras.zoom(camera, apart(then) / apart(now), anchor);
    this.set(camera, true);
  }

  #up(event, cancelled = false) {
    if (!this.#pointers.delete(event.pointerId) || this.#pointers.size) return;
    this.picture.canvas.classList.remove("held");
    const { x, y, time, far } = this.#press;
    if (far) return this.set(this.get(), false);
    if (cancelled || event.button > 0 || event.timeStamp - time > CLICK_MS) return;
    const near = event.pointerType === "touch" ? 24 : 8;
    const last = this.#lastClick;
    this.#lastClick = { x, y, time };
    if (last && time - last.time < DOUBLE_MS && Math.hypot(x - last.x, y - last.y) < near) {
      this.#lastClick = null;
      this.double(x, y);
    } else {
      this.click(x, y);
    }
  }

  // --- wheel ------------------------------------------------------------------------------------------------------

  #wheel(event) {
    event.preventDefault();
    this.#drop();
    const lines = event.deltaMode === 1 ? 16 : event.deltaMode === 2 ? 400 : 1;
    const steps = Math.max(-3, Math.min(3, (event.deltaY * lines) / 100));
    if (this.mode === "fly" && !event.ctrlKey) return this.faster(0.8 ** steps);
    const { clientX: x, clientY: y } = event;
    const place = this.picture.share(x, y);
    if (!this.#anchor || Math.hypot(x - this.#anchor.x, y - this.#anchor.y) > CLICK_PX) {
      // at first what the cursor shows at the target's depth, and as soon as that is known, the point itself
      const anchor = { x, y, point: null };
      this.#anchor = anchor;
      this.pick(...place).then((point) => (anchor.point = point), () => {});
    }
    const camera = this.get();
    const view = cameras.viewOf(camera);
    const point = this.#anchor.point ?? cameras.pointAt(view, this.picture.aspect, place, camera.distance);
    this.set(cameras.zoom(camera, 1.15 ** steps, point), true);
    clearTimeout(this.#wheelTimer);
    this.#wheelTimer = setTimeout(() => {
      this.#wheelTimer = 0;
      this.#anchor = null;
      this.set(this.get(), false);
    }, WHEEL_REST_MS);
  }

  faster(factor) {
    this.speed = Math.max(1e-5, Math.min(10, this.speed * factor));
    this.changed();
  }

  // --- keys -------------------------------------------------------------------------------------------------------

  /** True where the key steers. */
  key(event) {
    const arrows = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"].includes(event.code);
    const flies = this.mode === "fly" && ["KeyW", "KeyA", "KeyS", "KeyD", "KeyQ", "KeyE"].includes(event.code);
    const zooms = ["Equal", "NumpadAdd", "Minus", "NumpadSubtract"].includes(event.code) || "+-".includes(event.key);
    if (zooms && this.mode === "fly") {
      this.faster(event.key === "-" || event.code === "NumpadSubtract" ? 0.8 : 1.25);
      return true;
    }
    if (!arrows && !flies && !zooms) return false;
    this.#drop();
    this.#keys.add(event.key === "+" ? "Equal" : event.key === "-" ? "Minus" : event.code);
    this.shift = event.shiftKey;
    return true;
  }

  /** Once an animation frame: what keys and animations do. */
  step(now) {
    const passed_s = Math.min(0.1, (now - this.#last) / 1000);
    this.#last = now;
    if (this.#animation) return this.#animate(now);
    if (this.#keys.size) {
      this.set(this.#keyed(this.get(), passed_s), true);
      this.keyed = true;
    } else if (this.keyed) {
      this.keyed = false;
      this.set(this.get(), false);
    }
  }

  #animate(now) {
    const { from, to, step, start } = this.#animation;
    const passed = Math.max(0, now - start);
    const share = Math.min(1, passed / 250);
    const camera = step ? step(passed) : cameras.between(from, to, share * share * (3 - 2 * share));
    const over = step ? camera === null : share >= 1;
    this.set(camera ?? this.get(), !over);
    if (over) this.#drop();
  }

  #keyed(camera, passed_s) {
    const on = (...codes) => (codes.some((code) => this.#keys.has(code)) ? 1 : 0);
    const right = on("ArrowRight") - on("ArrowLeft");
    const up = on("ArrowUp") - on("ArrowDown");
    if (this.mode === "fly") {
      const way = this.speed * camera.size * passed_s * (this.shift ? 4 : 1);
      const sideways = on("KeyD") - on("KeyA") + right;
      const ahead = on("KeyW") - on("KeyS") + up;
      return cameras.move(camera, sideways * way, (on("KeyE") - on("KeyQ")) * way, ahead * way);
    }
    const nearer = on("Equal", "NumpadAdd") - on("Minus", "NumpadSubtract");
    if (nearer) camera = cameras.zoom(camera, 0.35 ** (nearer * passed_s));
    if (!this.shift) return cameras.orbit(camera, right * KEY_RATE * passed_s, -up * KEY_RATE * passed_s);
    const share = 0.4 * passed_s;
    return cameras.pan(camera, this.picture.aspect, [0, 0], [-right * share, up * share]);
  }
}

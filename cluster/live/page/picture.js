// The picture on the canvas: decoding, order, where it lies in the window, and the size that the run is asked for.

const MULTIPLE = 8; // of the sides asked for
const ALIKE = 0.03; // shapes that differ by less are filled by cutting, others by bars

export class Picture {
  #context;
  #connections = 0;
  /** The header of what is shown, or null. */
  shown = null;

  /** acknowledge(frame), shown(header) : called when a picture is decoded, and when it is on the canvas. */
  constructor(canvas, acknowledge, shown) {
    this.canvas = canvas;
    this.#context = canvas.getContext("bitmaprenderer");
    this.acknowledge = acknowledge;
    this.onShown = shown;
  }

  /** Pictures of a new connection count from anew. */
  restart() {
    this.#connections++;
    this.shown = this.shown && { ...this.shown, frame: -1 };
  }

  async accept(header, payload) {
    const connections = this.#connections;
    let bitmap = null;
    try {
      bitmap = await createImageBitmap(new Blob([payload], { type: `image/${header.encoding}` }));
    } catch {
      // half a picture is none; the next one follows
    }
    if (connections === this.#connections) this.acknowledge(header.frame);
    if (!bitmap) return;
    if (connections !== this.#connections || header.frame <= (this.shown?.frame ?? -1)) return bitmap.close();
    this.shown = { ...header, width: bitmap.width, height: bitmap.height };
    this.canvas.width = bitmap.width;
    this.canvas.height = bitmap.height;
    this.#context.transferFromImageBitmap(bitmap);
    this.place();
    this.onShown(this.shown);
  }

  get aspect() {
    const { width, height } = this.shown ?? { width: this.canvas.clientWidth, height: this.canvas.clientHeight };
    return width / Math.max(1, height);
  }

  /**
   * How the picture lies in the window, a value of CSS's object-fit. none: pixel by pixel, a few at the borders unseen;
   * cover: it fills the window, and a little is cut off; contain: all of it, with bars.
   */
  get #fit() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const over = this.shown ? [this.shown.width - width, this.shown.height - height] : [0, 0];
    if (devicePixelRatio === 1 && over.every((x) => x >= 0 && x < MULTIPLE)) return "none";
    return Math.abs(Math.log((this.aspect * height) / Math.max(1, width))) < ALIKE ? "cover" : "contain";
  }

  /** { left, top, width, height } of the whole picture, CSS pixels of the window. */
  get place_px() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const fit = this.#fit;
    const wider = this.aspect > width / height;
    const tall = fit === "none" && this.shown ? this.shown.height : wider === (fit === "cover") ? height : width / this.aspect;
    const size = { width: tall * this.aspect, height: tall };
    return { left: (width - size.width) / 2, top: (height - size.height) / 2, ...size };
  }

  place() {
    this.canvas.dataset.fit = this.#fit;
  }

  /** Shares of the picture of a place in the window. */
  share(x, y) {
    const { left, top, width, height } = this.place_px;
    return [(x - left) / width, (y - top) / height];
  }

  /** CSS pixels of shares of the picture. */
  pixel([x, y]) {
    const { left, top, width, height } = this.place_px;
    return [left + x * width, top + y * height];
  }

  /** [width, height] that fills the window, multiples of 8. longest : of the wider side, at 16:10. */
  wanted(longest) {
    const density = Math.min(devicePixelRatio || 1, 1.5);
    const width = this.canvas.clientWidth * density;
    const height = this.canvas.clientHeight * density;
    const shortest = (longest * 5) / 8;
    const scale = Math.min(1, longest / Math.max(width, height), shortest / Math.min(width, height));
    return [width, height].map((side) => Math.max(16, Math.ceil((side * scale) / MULTIPLE - 1e-6) * MULTIPLE));
  }
}

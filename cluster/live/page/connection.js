// The connection to the hub (PROTOCOL.md): messages both ways, answers to requests, and coming back after a loss.

const PROTOCOL = 1;
const MAX_HEADER_BYTES = 64 << 10;
const WAITS_S = [0.5, 1, 2, 4, 8];

/** The token of the page's address; it leaves the address bar at once, and reloading still works. */
export function takeToken() {
  const address = new URL(location.href);
  const fragment = new URLSearchParams(address.hash.slice(1));
  const token = address.searchParams.get("token") ?? fragment.get("token");
  if (token) {
    sessionStorage.setItem("token", token);
    address.searchParams.delete("token");
    fragment.delete("token");
    address.hash = fragment.toString();
    history.replaceState(null, "", address.href.replace(/#$/, ""));
  }
  return token ?? sessionStorage.getItem("token") ?? "";
}

/**
 * Events: "state" (after `state` changed) and "message" (detail: { header, payload }), payload a Uint8Array.
 * state : { name: "connecting" | "open" | "waiting" | "ended", why, until }; until: when a new try comes, ms.
 */
export class Connection extends EventTarget {
  #socket = null;
  #tries = 0;
  #timer = 0;
  #requests = new Map();
  #next = 1;
  #bye = "";
  streams = { pictures: true, metrics: false };
  state = { name: "connecting", why: "", until: 0 };
  everOpen = false;

  constructor(token) {
    super();
    const address = new URL("live", document.baseURI);
    address.protocol = address.protocol.replace("http", "ws");
    address.search = new URLSearchParams({ token }).toString();
    address.hash = "";
    this.address = address.href;
    addEventListener("online", () => this.retry());
    addEventListener("pagehide", () => this.send({ kind: "bye" }));
    addEventListener("pageshow", (event) => event.persisted && this.retry());
  }

  connect() {
    clearTimeout(this.#timer);
    this.#bye = "";
    this.#set("connecting");
    const socket = new WebSocket(this.address);
    this.#socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => this.#say({ kind: "hello", protocol: PROTOCOL, client: "page", ...this.streams });
    socket.onmessage = ({ data }) => socket === this.#socket && this.#received(data);
    socket.onclose = () => socket === this.#socket && this.#lost();
  }

  /** At once instead of after the wait. */
  retry() {
    if (this.state.name === "waiting" || this.state.name === "ended") this.connect();
  }

  get open() {
    return this.state.name === "open";
  }

  /** False where there is no connection: what is said then is lost. */
  send(header) {
    return this.open && this.#say(header);
  }

  /** The answer, { header, payload }. Rejects with the hub's line, or where it does not come. */
  request(header, timeout_s = 30) {
    const request = this.#next++;
    if (!this.send({ ...header, request })) return Promise.reject(new Error("There is no connection to the run"));
    return new Promise((resolve, reject) => {
      const timer = setTimeout(() => {
        this.#requests.delete(request);
        reject(new Error(`No answer within ${timeout_s} s`));
      }, timeout_s * 1000);
      this.#requests.set(request, { resolve, reject, timer });
    });
  }

  /** The number of a message that is answered only where it is refused. onrefused(why) : within 30 s. */
  say(header, onrefused) {
    this.request(header).catch((error) => error.refused && onrefused(error.message));
  }

  subscribe(streams) {
    this.streams = { ...this.streams, ...streams };
    this.send({ kind: "subscribe", ...this.streams });
  }

  #say(header) {
    if (this.#socket?.readyState !== WebSocket.OPEN) return false;
    this.#socket.send(JSON.stringify(header));
    return true;
  }

  #received(data) {
    let header;
    let payload = null;
    try {
      if (typeof data === "string") {
        header = JSON.parse(data);
      } else {
        const length = new DataView(data).getUint32(0, true);
        if (length > MAX_HEADER_BYTES || 4 + length > data.byteLength) throw new Error("length");
        header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
        payload = new Uint8Array(data, 4 + length);
      }
    } catch {
      this.#socket.close(); // no message of the protocol
      return;
    }
    if (header.kind === "welcome") {
      this.#tries = 0;
      this.everOpen = true;
      this.#set("open");
    } else if (header.kind === "bye") {
      this.#bye = header.why || "the hub closed";
    } else if (header.kind === "refused" || (header.request != null && this.#requests.has(header.request))) {
      this.#answered(header, payload);
      if (header.kind === "refused") return;
    }
    this.dispatchEvent(new CustomEvent("message", { detail: { header, payload } }));
  }

  #answered(header, payload) {
    const waiting = this.#requests.get(header.request);
    if (!waiting) return;
    this.#requests.delete(header.request);
    clearTimeout(waiting.timer);
    if (header.kind !== "refused") return waiting.resolve({ header, payload });
    waiting.reject(Object.assign(new Error(header.why || "refused"), { refused: true }));
  }

  #lost() {
    this.#socket = null;
    for (const { reject, timer } of this.#requests.values()) {
      clearTimeout(timer);
      reject(new Error("The connection was lost"));
    }
    this.#requests.clear();
    if (/\brun\b.*\b(over|ended|finished|failed|stopped)\b/i.test(this.#bye)) return this.#set("ended", this.#bye);
    const wait_ms = WAITS_S[Math.min(this.#tries++, WAITS_S.length - 1)] * 1000;
    this.#set("waiting", this.#bye, Date.now() + wait_ms);
    this.#timer = setTimeout(() => this.connect(), wait_ms);
  }

  #set(name, why = "", until = 0) {
    this.state = { name, why, until };
    this.dispatchEvent(new Event("state"));
  }
}

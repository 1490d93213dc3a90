// Live pictures: each is decoded, handed on, and only then another one is asked for, as large as the link carries.
import { address } from "./api.js";

const AGAIN_MS = 1000;
const ASK_MS = 1000;
const KEPT_MS = 60000; // clocks of two machines part by some milliseconds in that time
const FIRST_BYTES = 16000;
const FEWEST_BYTES = 4000;
const LINK_S = 0.6; // so long the pictures of all cameras in view may be on the link together
const LOOK_MS = 5000;
const SILENT_LOOKS = 4; // the line is dead, though nobody told: begin another
const text = new TextDecoder();

/** The daemon's clock on this page's: each answer says between which two of our moments one of its moments lay. */
class DaemonClock {
  bounds = [];

  took(fromMs, toMs, nowS) {
    const one = { atMs: toMs, low: fromMs - 1000 * nowS, high: toMs - 1000 * nowS };
    this.bounds = [...this.bounds.filter(({ atMs }) => toMs - atMs < KEPT_MS), one];
    if (this.low() > this.high()) this.bounds = [one]; // a clock was set, or slept
  }

  low() { return Math.max(...this.bounds.map((one) => one.low)); }
  high() { return Math.min(...this.bounds.map((one) => one.high)); }

  /** A moment of the daemon's, seconds, as one of this page's, ms: both ways are taken to be equally long. */
  here(nowS) { return 1000 * nowS + (this.low() + this.high()) / 2; }
  /** How long the shortest way is, ms. */
  wayMs() { return (this.high() - this.low()) / 2; }
}

export class Images {
  constructor(show) {
    this.show = show;
    this.cameras = [];
    setInterval(() => this.look(), LOOK_MS);
  }

  /** Watch these cameras, and no others. */
  watch(cameras) {
    if (cameras.join() === this.cameras.join() && this.line?.readyState <= WebSocket.OPEN) return;
    this.cameras = cameras;
    this.connect();
  }

  connect() {
    const before = this.line;
    this.line = null;
    before?.close();
    if (!this.cameras.length) return;
    const line = new WebSocket(address(`/images?on_request=true&${this.cameras.map((name) => `camera=${encodeURIComponent(name)}`).join("&")}`));
    line.binaryType = "arraybuffer";
    this.line = line;
    this.clock = new DaemonClock();
    this.rate = null; // bytes/s of the link
    this.silent = 0; // looks since anything was heard
    line.onopen = () => this.ask(line);
    line.onmessage = ({ data }) => {
      this.silent = 0;
      if (typeof data === "string") this.answered(line, JSON.parse(data));
      else this.came(line, data, performance.now());
    };
    line.onclose = () => setTimeout(() => this.line === line && this.connect(), AGAIN_MS);
  }

  /** Where no picture comes an answer tells a camera that gives none from a line that is dead. */
  look() {
    const { line } = this;
    if (!line || line.readyState > WebSocket.OPEN) return;
    this.silent += 1;
    if (this.silent > SILENT_LOOKS) this.connect();
    else if (this.silent > 1 && line.readyState === WebSocket.OPEN) this.ask(line);
  }

  ask(line) {
    this.askedMs = performance.now();
    line.send(`? ${this.askedMs}`);
  }

  /** Pictures are asked for once it is known how old they are. */
  answered(line, { asked, now_s: nowS }) {
    if (this.line !== line) return;
    const first = !this.clock.bounds.length;
    this.clock.took(Number(asked), performance.now(), nowS);
    if (first) for (const name of this.cameras) line.send(`${name} ${FIRST_BYTES}`);
  }

  async came(line, data, cameMs) {
    const length = new DataView(data).getUint32(0, true);
    const facts = JSON.parse(text.decode(new Uint8Array(data, 4, length)));
    if (this.line !== line) return;
    const sentMs = this.clock.here(facts.sent_s);
    this.measure(data.byteLength, cameMs - sentMs - this.clock.wayMs());
    facts.exposed_ms = sentMs - 1000 * facts.age_s;
    try {
      const bitmap = await createImageBitmap(new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" }));
      if (this.line === line) this.show(facts, bitmap);
      bitmap.close();
    } catch {
      // it cannot be decoded: the one before grows old in sight
    } finally {
      if (line.readyState === WebSocket.OPEN) {
        if (performance.now() - this.askedMs > ASK_MS) this.ask(line);
        line.send(`${facts.camera} ${Math.max(FEWEST_BYTES, Math.round((this.rate * LINK_S) / this.cameras.length))}`);
      }
    }
  }

  /** A slower link counts at once, a quicker one by and by. */
  measure(bytes, ms) {
    const rate = (1000 * bytes) / Math.max(1, ms);
    this.rate = this.rate === null ? rate : Math.min(rate, 2 * this.rate);
  }
}

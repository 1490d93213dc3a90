// What the daemon pushes: the newest of each topic and key, and whether anything is heard at all.
import { address, live } from "./api.js";

const AGAIN_MS = 1000;
const SILENT_MS = 2500; // the head's joints are told several times a second
const DEAD_MS = 10000; // nothing for so long: the line itself may be dead, though the daemon answers
const KEPT = 64; // keys of a topic: operations and commands come for weeks

export class Events extends EventTarget {
  constructor() {
    super();
    this.known = new Map();
    this.connected = false;
    this.heardMs = 0;
    this.lostMs = performance.now();
    setInterval(() => this.watch(), 500);
  }

  open() {
    this.wanted = true;
    this.connect();
  }

  connect() {
    this.line?.close();
    const line = new WebSocket(address("/events"));
    this.line = line;
    this.toldMs = performance.now();
    line.onmessage = (message) => {
      this.heard();
      this.toldMs = this.heardMs;
      this.take(JSON.parse(message.data));
    };
    line.onclose = () => {
      if (this.line !== line) return;
      this.lost();
      setTimeout(() => this.wanted && this.line === line && this.connect(), AGAIN_MS);
    };
  }

  take(event) {
    const keys = this.known.get(event.topic) ?? new Map();
    this.known.set(event.topic, keys);
    keys.delete(event.key);
    keys.set(event.key, event.value);
    if (keys.size > KEPT) keys.delete(keys.keys().next().value);
    this.dispatchEvent(new CustomEvent(event.topic, { detail: event }));
  }

  heard() {
    this.heardMs = performance.now();
    if (this.connected) return;
    this.connected = true;
    this.known.clear(); // what is told now is the whole: of a daemon that was started again nothing before it holds
    this.dispatchEvent(new Event("connected"));
  }

  lost() {
    if (!this.connected) return;
    this.connected = false;
    this.lostMs = this.heardMs;
    this.dispatchEvent(new Event("lost"));
  }

  /** Where nothing is heard a question tells a head that is silent from a daemon that is gone. */
  async watch() {
    if (!this.connected || this.asking || performance.now() - this.heardMs < SILENT_MS) return;
    this.asking = true;
    try {
      await live();
      this.heardMs = performance.now();
      if (this.heardMs - this.toldMs > DEAD_MS) this.connect();
    } catch {
      this.lost();
      this.connect();
    } finally {
      this.asking = false;
    }
  }

  newest(topic, key) {
    return this.known.get(topic)?.get(key);
  }
}

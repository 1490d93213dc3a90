// Live pictures: each is decoded, handed on, and only then another one is asked for.
import { address } from "./api.js";

const AGAIN_MS = 1000;
const text = new TextDecoder();

export class Images {
  constructor(show) {
    this.show = show;
    this.cameras = [];
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
    const line = new WebSocket(address(`/images?${this.cameras.map((name) => `camera=${encodeURIComponent(name)}`).join("&")}`));
    line.binaryType = "arraybuffer";
    this.line = line;
    line.onmessage = (message) => this.came(line, message.data, performance.now());
    line.onclose = () => setTimeout(() => this.line === line && this.connect(), AGAIN_MS);
  }

  async came(line, data, cameMs) {
    const length = new DataView(data).getUint32(0, true);
    const facts = JSON.parse(text.decode(new Uint8Array(data, 4, length)));
    try {
      const bitmap = await createImageBitmap(new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" }));
      if (this.line === line) this.show(facts, bitmap, cameMs);
      bitmap.close();
    } catch {
      // it cannot be decoded: the one before grows old in sight
    } finally {
      if (line.readyState === WebSocket.OPEN) line.send(facts.camera);
    }
  }
}

// One camera: its newest image, how fresh that is, what is drawn over it, a loupe, and where one points.
import { h, s, say, set } from "./dom.js";
import { camera as called, deg, number } from "./words.js";

const STALE_S = 1.0;
const OLD_S = 1.0;
const MOVING_S = 5.0; // an image of a moving head is shown for so long: it is no place to click in any case
const LOUPE_PX = 21; // image pixels across
const ZOOM = 8;
const SHAKES_PX = 10; // of the screen: a hand that clicks or a thumb that holds moves by less
const HELD_MS = 500;

export class Eye {
  constructor(name, choose, turning = () => false) {
    this.name = name;
    this.choose = choose;
    this.turning = turning; // whether the head turns now
    this.facts = null;
    this.cursor = null;
    this.marks = {};
    this.intervals = [];
    this.canvas = h("canvas", { class: "image", width: 1024, height: 768 });
    this.pen = this.canvas.getContext("2d", { alpha: false });
    this.over = s("svg", { class: "over", viewBox: "0 0 1024 768", "aria-hidden": "true" });
    this.loupe = h("canvas", { class: "loupe", width: LOUPE_PX * ZOOM, height: LOUPE_PX * ZOOM, hidden: true });
    this.glass = this.loupe.getContext("2d");
    this.where = h("span", { class: "where" });
    this.age = h("span", { class: "age" }, "no image yet");
    this.facing = h("span", { class: "facing" });
    this.stale = h("p", { class: "stale-words" }, "No image");
    this.frame = h("div", {
      class: "frame", tabindex: 0, role: "application", "aria-label": `Image of ${called(name)}: arrow keys move the cross-hair, Enter chooses`,
      onpointermove: (event) => this.moved(event), onpointerleave: () => this.left(), onpointerdown: (event) => this.pressed(event),
      onpointerup: (event) => this.released(event), onpointercancel: () => this.cancelled(), oncontextmenu: (event) => event.preventDefault(), onkeydown: (event) => this.key(event), onblur: () => this.left(),
    }, this.canvas, this.over, this.loupe, this.stale);
    this.save = h("a", { class: "save", download: "", hidden: true }, "PNG");
    this.question = h("div", { class: "follow", role: "group", "aria-label": "Follow it?", hidden: true }, h("button", { type: "button", class: "go", onclick: () => this.follow() }, "Follow it"), h("button", { type: "button", onclick: () => this.leave() }, "Cancel"));
    this.element = h("figure", { class: "eye", "data-camera": name, "data-stale": "" }, this.frame,
      h("figcaption", {}, this.question, h("strong", {}, called(name)), this.age, this.facing, this.where, this.save));
  }

  show(facts, bitmap) {
    const [width, height] = facts.size_px;
    if (this.canvas.width !== width || this.canvas.height !== height) {
      [this.canvas.width, this.canvas.height] = [width, height];
      this.over.setAttribute("viewBox", `0 0 ${width} ${height}`);
      this.frame.style.aspectRatio = `${width} / ${height}`;
      this.element.style.setProperty("--ratio", width / height);
    }
    this.pen.drawImage(bitmap, 0, 0, width, height);
    this.coarse = !facts.reduced ? "" : bitmap.width < width ? `, reduced to ${bitmap.width} × ${bitmap.height} px` : ", coarse";
    if (this.facts) this.intervals = [...this.intervals.slice(-4), facts.mid_exposure_s - this.facts.mid_exposure_s];
    this.facts = facts;
    this.draw("track", facts.track ? ellipse("track", facts.track) : null);
    this.draw("targets", s("g", {}, Object.entries(facts.targets ?? {}).map(([name, place]) => ellipse("kept", place, name))));
    set(this.facing, "title", `frame ${facts.frame_id}, mast file ${facts.mast_digest.slice(0, 12)}`);
    this.fresh(performance.now());
    if (this.cursor) this.look(this.cursor);
    document.dispatchEvent(new CustomEvent("image-shown", { detail: { ...facts, shown_ms: performance.timeOrigin + performance.now() } }));
  }

  /** Whether the image is of now; a slow camera's own period is allowed. A moving head's image is shown as moving. */
  fresh(nowMs) {
    const ageS = this.facts ? ageOf(this.facts, nowMs) : Infinity;
    const slow = this.intervals.length ? 2.5 * [...this.intervals].sort((a, b) => a - b)[Math.floor(this.intervals.length / 2)] : 0;
    this.isStale = !(ageS <= Math.max(STALE_S, Math.min(slow, 10)));
    const moving = ageS <= MOVING_S && (this.facts.moving || (this.isStale && this.turning()));
    set(this.element, "data-moving", moving);
    set(this.element, "data-stale", this.isStale && !moving);
    const age = this.facts ? `${number(Math.ceil(10 * ageS) / 10, 1)} s old` : "no image yet"; // until the next reading
    say(this.age, age + (this.facts ? this.coarse : ""));
    set(this.age, "data-old", ageS > OLD_S);
    say(this.stale, moving ? "Moving" : this.facts ? `Image ${age}: not of now` : "No image yet");
    if (this.facts) say(this.facing, `${deg(this.facts.pan_rad)} ${deg(this.facts.tilt_rad)}`);
  }

  pixel(event) {
    const box = this.frame.getBoundingClientRect();
    const { width, height } = this.canvas;
    const x = ((event.clientX - box.left) / box.width) * width - 0.5;
    const y = ((event.clientY - box.top) / box.height) * height - 0.5;
    return [clamp(Math.round(x * 10) / 10, 0, width - 1), clamp(Math.round(y * 10) / 10, 0, height - 1)];
  }

  moved(event) {
    this.cursor = this.pixel(event);
    if (this.drag && this.shaken(event)) {
      clearTimeout(this.drag.held);
      if (event.pointerType !== "touch") this.drawBox();
    }
    this.look(this.cursor);
  }

  left() {
    this.cursor = null;
    this.loupe.hidden = true;
    this.draw("cursor", null);
    say(this.where, "");
  }

  pressed(event) {
    if (event.button !== 0) return;
    this.frame.setPointerCapture?.(event.pointerId);
    this.cursor = this.pixel(event);
    this.leave();
    this.drag = { from: this.cursor, facts: this.facts, at: [event.clientX, event.clientY] };
    if (event.pointerType === "touch") this.drag.held = setTimeout(() => this.holds(), HELD_MS);
    this.look(this.cursor);
  }

  shaken({ clientX, clientY }) {
    return Math.hypot(clientX - this.drag.at[0], clientY - this.drag.at[1]) > SHAKES_PX;
  }

  cancelled() {
    clearTimeout(this.drag?.held);
    this.drag = null;
    this.left();
  }

  /** A finger that stays: what is under it is to be followed. */
  holds() {
    const { from, facts } = this.drag;
    this.drag = null;
    this.propose(from, facts);
  }

  /** A gesture begins no track by itself: hands slip. */
  propose(pixel, facts) {
    this.proposed = { pixel, facts };
    this.question.hidden = false;
    set(this.question, "data-side", pixel[0] < this.canvas.width / 2 ? "right" : "left"); // beside the target, below the loupe
    this.mark("box", pixel, "click", "follow?");
  }

  follow() {
    const { pixel, facts } = this.proposed;
    this.leave();
    this.choose(this, pixel, facts, "track");
  }

  leave() {
    this.question.hidden = true;
    this.draw("box", null);
  }

  released(event) {
    const { drag } = this;
    if (!drag) return;
    clearTimeout(drag.held);
    const touch = event.pointerType === "touch";
    const to = this.pixel(event);
    const [width, height] = [0, 1].map((k) => Math.abs(to[k] - drag.from[k]));
    const shaken = this.shaken(event);
    this.drag = null;
    this.draw("box", null);
    if (shaken && !touch && width > 12 && height > 12) this.propose([(to[0] + drag.from[0]) / 2, (to[1] + drag.from[1]) / 2], drag.facts);
    // a finger hits with its centre where it leaves; a mouse where it went down
    else if (!shaken) this.choose(this, touch ? to : drag.from, drag.facts, "point");
    if (touch) this.left();
  }

  key(event) {
    const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const way = ways[event.key];
    if (way) {
      const step = event.shiftKey ? 10 : event.altKey ? 0.1 : 1;
      const [x, y] = this.cursor ?? [(this.canvas.width - 1) / 2, (this.canvas.height - 1) / 2];
      this.cursor = [clamp(Math.round((x + step * way[0]) * 10) / 10, 0, this.canvas.width - 1), clamp(Math.round((y + step * way[1]) * 10) / 10, 0, this.canvas.height - 1)];
      this.look(this.cursor);
    } else if (event.key === "Enter" && this.cursor) {
      this.choose(this, this.cursor, this.facts, "point");
    } else if (event.key.toLowerCase() === "t" && this.cursor) {
      this.choose(this, this.cursor, this.facts, "track");
    } else return;
    event.preventDefault();
  }

  look([x, y]) {
    const half = Math.floor(LOUPE_PX / 2);
    const pen = this.glass;
    pen.imageSmoothingEnabled = false;
    pen.fillStyle = "#000";
    pen.fillRect(0, 0, this.loupe.width, this.loupe.height);
    const [left, top] = [Math.round(x) - half, Math.round(y) - half];
    pen.drawImage(this.canvas, left, top, LOUPE_PX, LOUPE_PX, 0, 0, this.loupe.width, this.loupe.height);
    const [u, v] = [(x - left + 0.5) * ZOOM, (y - top + 0.5) * ZOOM];
    for (const [style, line] of [["#000", 3], ["#4cc3ea", 1]]) {
      pen.strokeStyle = style;
      pen.lineWidth = line;
      pen.beginPath();
      for (const [a, b] of [[0, u - 6], [u + 6, this.loupe.width]]) { pen.moveTo(a, v); pen.lineTo(b, v); }
      for (const [a, b] of [[0, v - 6], [v + 6, this.loupe.height]]) { pen.moveTo(u, a); pen.lineTo(u, b); }
      pen.stroke();
    }
    this.loupe.hidden = false;
    set(this.loupe, "data-side", x < this.canvas.width / 2 ? "right" : "left");
    say(this.where, `x ${number(x, 1)}  y ${number(y, 1)} px`);
    this.draw("cursor", cross(x, y, "cursor", 14));
  }

  drawBox() {
    const [x0, y0] = this.drag.from;
    const [x1, y1] = this.cursor;
    this.draw("box", s("rect", { class: "box", x: Math.min(x0, x1), y: Math.min(y0, y1), width: Math.abs(x1 - x0), height: Math.abs(y1 - y0) }));
  }

  draw(name, mark) {
    this.marks[name]?.remove();
    this.marks[name] = mark;
    if (mark) this.over.append(mark);
  }

  mark(name, place, kind, words) {
    this.draw(name, place ? s("g", {}, cross(place[0], place[1], kind, 26), words ? s("text", { class: kind, x: place[0] + 14, y: place[1] - 14 }, words) : null) : null);
  }
}

const ageOf = (facts, nowMs) => Math.max(0, (nowMs - facts.exposed_ms) / 1000);

/** What a click in an image that is no longer quite of now is told; "" of one that is. */
export function ageWords(facts) {
  const ageS = ageOf(facts, performance.now());
  return ageS > OLD_S ? `The image was ${number(ageS, 1)} s old when it was chosen.` : "";
}

const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

/** Where a target should be: one sigma thrice enlarged, a cross, and its name if it has one. */
const ellipse = (kind, { x_px: x, y_px: y, major_px: major, minor_px: minor, turn_rad: turn }, name = null) => s("g", {},
  s("ellipse", { class: kind, rx: Math.max(3 * major, 4), ry: Math.max(3 * minor, 4), transform: `translate(${x} ${y}) rotate(${(turn * 180) / Math.PI})` }),
  cross(x, y, kind, 18), name === null ? null : s("text", { class: "named", x: x + 14, y: y - 10 }, name));

export function cross(x, y, kind, size) {
  const gap = size / 4;
  const d = `M${x - size} ${y}H${x - gap}M${x + gap} ${y}H${x + size}M${x} ${y - size}V${y - gap}M${x} ${y + gap}V${y + size}`;
  return s("g", {}, s("path", { class: "halo", d }), s("path", { class: kind, d }));
}

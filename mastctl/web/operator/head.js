// Where the head is: figures against limits, a rose with each camera's field of view, a map of the joints.
import { byId, h, put, s, say, set } from "./dom.js";
import { camera as called, deg, degrees, forTime, number } from "./words.js";

const R = 78;
const OLD_MS = 2000; // the joints are read several times a second

export class HeadPanel {
  constructor(events) {
    this.events = events;
    this.figures = h("div", { class: "bars" });
    this.rose = s("svg", { class: "rose", viewBox: "-136 -112 272 224", role: "img" });
    this.map = s("svg", { class: "map", viewBox: "0 0 220 150", role: "img" });
    this.note = h("p", { class: "quiet" });
    this.sunNote = h("p", { class: "quiet", id: "sun-note" });
    this.old = h("p", { class: "warn", id: "head-old", role: "status", hidden: true });
    put(byId("head"), this.old, this.figures, h("div", { class: "drawings" }, this.rose, this.map), this.sunNote, this.note);
    events.addEventListener("joints", (event) => this.read(event.detail.value));
    setInterval(() => this.age(), 500);
    document.addEventListener("views-changed", () => this.draw());
  }

  use(status, rig, views) {
    [this.limits, this.rig, this.views] = [status.limits, rig, views];
    if (!this.joints && status.joints) this.read(status.joints);
    else this.draw();
  }

  read(joints) {
    this.joints = joints;
    this.readMs = performance.now() - 1000 * joints.age_s;
    this.age();
    this.draw();
  }

  /** Angles that nobody has read for a while are those of then. */
  age() {
    const ms = performance.now() - this.readMs;
    this.old.hidden = !(ms > OLD_MS);
    set(byId("head"), "data-old", !this.old.hidden);
    if (!this.old.hidden) say(this.old, `Last read ${forTime(ms / 1000)} ago: where the head is now is not known.`);
  }

  keptOff({ sun, boxes }) {
    [this.sun, this.sunBoxes] = [sun, boxes];
    this.draw();
  }

  goal(goal) {
    this.wanted = goal;
    this.draw();
  }

  draw() {
    if (!this.limits || !this.rig) return;
    put(this.figures, this.bar("Pan", "pan"), this.bar("Tilt", "tilt"));
    this.drawRose();
    this.drawMap();
    const off = this.joints && Math.max(Math.abs(this.joints.true_pan_rad - this.joints.pan_rad), Math.abs(this.joints.true_tilt_rad - this.joints.tilt_rad));
    const { sun } = this;
    say(this.sunNote, !sun ? "" : sun.active ? `Hatched in the map: the head keeps ${deg(sun.half_angle_rad, 1).slice(1)} off the sun${sun.left_s === null ? "" : `, for ${forTime(sun.left_s)} more when this was told`}.` : "Where the sun stands is not known any more; nothing keeps the head off it.");
    say(this.note, off > 5e-6 ? `By the mast file's joints the head truly stands at ${deg(this.joints.true_pan_rad, 3)} ${deg(this.joints.true_tilt_rad, 3)}.` : "");
  }

  bar(name, axis) {
    const [low, high] = this.limits[`${axis}_rad`];
    const now = this.joints?.[`${axis}_rad`];
    const at = (value) => `${Math.min(100, Math.max(0, (100 * (value - low)) / (high - low)))}`;
    const wanted = this.wanted?.[axis === "pan" ? 0 : 1];
    return h("div", { class: "axis" }, h("span", { class: "name" }, name), h("span", { class: "n big", id: `at-${axis}` }, deg(now)),
      s("svg", { class: "range", viewBox: "0 0 100 10", preserveAspectRatio: "none", "aria-hidden": "true" },
        s("rect", { class: "rail", x: 0, y: 4, width: 100, height: 2 }),
        wanted === undefined ? null : s("rect", { class: "wanted", x: at(wanted) - 0.6, y: 1, width: 1.2, height: 8 }),
        now === undefined ? null : s("rect", { class: "now", x: at(now) - 0.8, y: 0, width: 1.6, height: 10 })),
      h("span", { class: "ends" }, h("span", {}, deg(low, 0)), h("span", {}, deg(high, 0))));
  }

  drawRose() {
    const pan = this.joints?.true_pan_rad ?? 0;
    const ray = (a, r) => `${number2(r * Math.sin(a))} ${number2(-r * Math.cos(a))}`;
    const ticks = Array.from({ length: 24 }, (_, k) => {
      const a = (k * Math.PI) / 12;
      return s("path", { class: "tick", d: `M${ray(a, R)}L${ray(a, k % 6 ? R + 5 : R + 9)}` });
    });
    const names = [["0°", 0], ["90°", Math.PI / 2], ["180°", Math.PI], ["−90°", -Math.PI / 2]].map(([text, a]) =>
      s("text", { class: "tickname", x: (R + 29) * Math.sin(a), y: -(R + 20) * Math.cos(a) + 6 }, text));
    const inView = this.views?.names() ?? [];
    const wedges = Object.entries(this.rig.cameras).sort((a, b) => b[1].width_rad - a[1].width_rad).map(([name, camera]) => {
      const middle = (camera.on === "head" ? pan : 0) + camera.azimuth_rad;
      const half = camera.width_rad / 2;
      const r = camera.on === "head" ? R - 6 : R - 34;
      return s("path", { class: `wedge ${camera.on} ${inView.includes(name) ? "seen" : ""}`, d: `M0 0L${ray(middle - half, r)}A${r} ${r} 0 ${camera.width_rad > Math.PI ? 1 : 0} 1 ${ray(middle + half, r)}Z` },
        s("title", {}, `${called(name)}: ${number(degrees(camera.width_rad), 0)}° wide`));
    });
    const [low, high] = this.limits.pan_rad;
    const arc = high - low >= 2 * Math.PI ? null : s("path", { class: "reach", d: `M${ray(low, R)}A${R} ${R} 0 ${high - low > Math.PI ? 1 : 0} 1 ${ray(high, R)}` });
    const goal = this.wanted ? s("path", { class: "wanted", d: `M0 0L${ray(this.wanted[0], R)}` }) : null;
    this.rose.setAttribute("aria-label", `The head looks ${deg(pan, 0)} from forward; lighter fields are other cameras`);
    put(this.rose, s("circle", { class: "rim", r: R }), arc, wedges, ticks, names, goal, s("path", { class: "now", d: `M0 0L${ray(pan, R)}` }), s("path", { class: "rover", d: "M-9 12V-8L0 -16L9 -8V12Z" }));
  }

  drawMap() {
    const { pan_rad: pan, tilt_rad: tilt, keep_out: boxes } = this.limits;
    const [left, top, width, height] = [46, 8, 168, 114];
    const edge = 0.06 * (pan[1] - pan[0]);
    const x = (value) => left + (width * (value - pan[0] + edge)) / (pan[1] - pan[0] + 2 * edge);
    const y = (value) => top + (height * (tilt[1] + edge - value)) / (tilt[1] - tilt[0] + 2 * edge);
    const turns = [-2, -1, 0, 1, 2].map((k) => 2 * Math.PI * k);
    const sun = this.sunBoxes ?? [];
    const out = [...boxes.map((box) => [box, "out"]), ...sun.map((box) => [box, "sun"])].flatMap(([box, kind]) => turns.map((turn) => {
      const [a, b] = box.pan_rad.map((value) => Math.min(pan[1] + edge, Math.max(pan[0] - edge, value + turn)));
      const [c, d] = box.tilt_rad.map((value) => Math.min(tilt[1] + edge, Math.max(tilt[0] - edge, value)));
      return b > a && d > c ? s("rect", { class: kind, x: x(a), y: y(d), width: x(b) - x(a), height: y(c) - y(d) }, s("title", {}, kind === "sun" ? "the cone around the sun" : `keep-out ${box.name}`)) : null;
    }));
    const here = this.joints ? [x(this.joints.pan_rad), y(this.joints.tilt_rad)] : null;
    this.map.setAttribute("aria-label", `Joint map: pan ${deg(this.joints?.pan_rad, 1)}, tilt ${deg(this.joints?.tilt_rad, 1)}; ${boxes.length ? `${boxes.length} keep-outs` : "no keep-outs"}${sun.length ? "; the cone around the sun" : ""}`);
    put(this.map,
      s("defs", {}, s("pattern", { id: "sun-hatch", width: 5, height: 5, patternUnits: "userSpaceOnUse", patternTransform: "rotate(45)" }, s("rect", { class: "sun-ground", width: 5, height: 5 }), s("path", { class: "sun-line", d: "M0 0V5" }))),
      s("rect", { class: "field", x: x(pan[0]), y: y(tilt[1]), width: x(pan[1]) - x(pan[0]), height: y(tilt[0]) - y(tilt[1]) }),
      s("path", { class: "zero", d: `M${x(0)} ${y(tilt[1])}V${y(tilt[0])}M${x(pan[0])} ${y(0)}H${x(pan[1])}` }),
      out,
      [pan[0], 0, pan[1]].map((value, k) => s("text", { class: `tickname ${["start", "", "end"][k]}`, x: x(value), y: 144 }, deg(value, 0))),
      [tilt[0], 0, tilt[1]].map((value) => s("text", { class: "tickname end", x: 48, y: y(value) + 5 }, deg(value, 0))),
      this.wanted ? s("path", { class: "wanted", d: `M${x(this.wanted[0]) - 6} ${y(this.wanted[1])}h12m-6 -6v12` }) : null,
      here ? s("circle", { class: "now", cx: here[0], cy: here[1], r: 4.5 }) : null);
  }
}

const number2 = (value) => value.toFixed(2);

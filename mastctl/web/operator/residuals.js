// What pointings measured: the newest residuals around the aim, one after the other, and as a table.
import { byId, h, put, s, say } from "./dom.js";
import { get } from "./api.js";
import { camera as called, clock, number, sentence } from "./words.js";
import { hiddenTable, plot, timesOf } from "./plots.js";

const SHOWN = 40;
const REACHES_PX = [0.1, 0.25, 0.5, 1, 2, 5, 10, 50, 200];
const WAITS_MS = [200, 1000, 3000]; // they are judged in a thread that nobody waits for

export class Residuals {
  constructor() {
    this.words = h("p", { class: "quiet" });
    this.scatter = s("svg", { class: "scatter", viewBox: "0 0 280 184", role: "img" });
    this.history = h("div", { class: "plots" });
    this.table = hiddenTable();
    this.asked = 0;
    put(byId("residuals"), this.words, this.scatter, this.history, this.table.place);
  }

  /** Look until a pointing that has ended is among them. */
  async after(operation) {
    for (const wait of WAITS_MS) {
      await new Promise((go) => setTimeout(go, wait));
      if (await this.look(operation)) return;
    }
  }

  /** What was measured by a former mast file is none of this one's; a thread looks for what is. */
  otherMast() {
    this.look();
    setTimeout(() => this.look(), WAITS_MS[1]);
  }

  async look(operation = null) {
    const mine = ++this.asked;
    try {
      const health = await get("/calibration/health");
      if (mine === this.asked) this.told(health); // else it may be of a former mast file
      return health.newest[0]?.operation === operation;
    } catch (error) {
      say(this.words, error.message);
      return true;
    }
  }

  told(health) {
    const all = health.newest.slice(0, SHOWN);
    say(this.words, all.length ? `${sentence(health.sentence)}.`.replace("..", ".") : "None has been measured by this mast file yet: each pointing at a pixel adds one.");
    this.scatter.toggleAttribute("hidden", !all.length);
    put(this.history, null);
    this.table.fill(["at", "camera", "x px", "y px", "range m"], all.map((one) =>
      [clock(1000 * one.time_s), called(one.camera), number(one.residual_px[0], 3, true), number(one.residual_px[1], 3, true), number(one.range_m, 2)]));
    if (!all.length) return;
    const reach = REACHES_PX.find((one) => all.every(({ residual_px: [x, y], match_sigma_px: [sx, sy] }) => Math.hypot(Math.abs(x) + sx, Math.abs(y) + sy) <= one)) ?? REACHES_PX.at(-1);
    this.around(all, reach);
    put(this.history, all.length > 1 ? this.inTurn(all.toReversed(), reach) : null);
  }

  around(all, reach) {
    const [cx, cy, r] = [140, 92, 86];
    const at = (value) => (value * r) / reach;
    put(this.scatter,
      [1, 0.5].map((part) => s("circle", { class: "ring", cx, cy, r: r * part })),
      s("path", { class: "ring", d: `M${cx - r} ${cy}H${cx + r}M${cx} ${cy - r}V${cy + r}` }),
      s("text", { class: "tickname start", x: cx + r + 4, y: cy + 4 }, `${reach} px`),
      all.map((one, k) => s("g", { opacity: 1 - (0.7 * k) / all.length },
        s("ellipse", { class: "sigma", cx: cx + at(one.residual_px[0]), cy: cy + at(one.residual_px[1]), rx: Math.max(1, at(one.match_sigma_px[0])), ry: Math.max(1, at(one.match_sigma_px[1])) }),
        s("circle", { class: k === 0 ? "tip newest" : "tip", cx: cx + at(one.residual_px[0]), cy: cy + at(one.residual_px[1]), r: k === 0 ? 3.5 : 2.2 }))));
    this.scatter.setAttribute("aria-label", `The newest ${all.length} residuals around the aim, all within ${reach} px`);
  }

  inTurn(all, reach) {
    const [x, y] = all.at(-1).residual_px;
    return [h("p", { class: "quiet" }, "One after the other, px: ", h("span", { class: "of-x" }, "● x"), "  ", h("span", { class: "of-y" }, "○ y"), ", bars of one sigma"),
      plot({ label: `The newest ${all.length} residuals one after the other, the last ${number(x, 2, true)} and ${number(y, 2, true)} px`, count: all.length, low: -reach, high: reach, ticks: [[reach, `+${reach}`], [0, "0"], [-reach, `\u2212${reach}`]], axis: timesOf(all.map((one) => 1000 * one.time_s)), height: 104, kind: "history" }, (across, up) =>
        all.map((one, k) => ["of-x", "of-y"].map((kind, axis) => {
          const [value, sigma, place] = [one.residual_px[axis], one.match_sigma_px[axis], across(k) + (axis ? 2.5 : -2.5)];
          return s("g", { class: kind }, s("path", { d: `M${place} ${up(value - sigma)}V${up(value + sigma)}` }), s("circle", { cx: place, cy: up(value), r: 2.6 }));
        })))];
  }
}

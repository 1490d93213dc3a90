// The track: by whom the target is seen, and the approach look by look: range, error, camera in use.
import { byId, h, put, s, say } from "./dom.js";
import { post } from "./api.js";
import { camera as called, clock, deg, forTime, inDegrees, metres, number } from "./words.js";
import { hiddenTable, plot, roundUp, strip, timesOf } from "./plots.js";
import { ageWords } from "./eye.js";
import { placeIn, shownBy } from "./truth.js";

const KEPT = 200; // looks that are drawn
const mm = (value, digits = 1) => number(value === null ? null : 1000 * value, digits);

export class TrackPanel {
  constructor(events, views, say) {
    this.events = events;
    this.say = say;
    this.said = "";
    this.trail = [];
    this.head = h("div");
    this.plots = h("div", { class: "plots" });
    this.table = hiddenTable();
    this.look = h("button", { type: "button", onclick: () => this.act("/track/look") }, "Look again");
    this.end = h("button", { type: "button", onclick: () => this.act("/track/stop") }, "End the track");
    this.buttons = h("div", { class: "buttons" }, this.look, this.end);
    this.hint = h("p", { class: "quiet" }, "Drag a box round a target, hold a finger on it, or press T at the cross-hair.");
    this.bad = h("p", { class: "bad" });
    put(byId("track"), this.head, this.plots, this.table.place, this.bad, this.buttons, this.hint);
    events.addEventListener("connected", () => { this.status = null; this.draw(); }); // it is told again where there is one
    events.addEventListener("track", (event) => this.told(event.detail.value));
    setInterval(() => this.ago(), 1000);
    this.draw();
  }

  allow(may) {
    this.may = may;
    this.draw();
  }

  use(status) {
    this.simulated = status.simulated;
  }

  async begin(eye, pixel, facts) {
    this.said = "";
    if (!this.may) this.said = "You may look. To follow a target, log in with a token of the role operate.";
    else if (!facts || eye.isStale) this.said = "The image is not of now, so nothing in it can be followed.";
    else {
      try {
        const old = ageWords(facts);
        if (old) this.say(old);
        await post("/track", { pixel: { camera: eye.name, frame_id: facts.frame_id, x_px: pixel[0], y_px: pixel[1], mast_digest: facts.mast_digest } });
      } catch (error) {
        this.said = error.message;
      }
    }
    if (this.said) this.say(this.said, true);
    this.draw();
  }

  async act(path) {
    this.said = "";
    try {
      await post(path, {});
    } catch (error) {
      this.said = error.message;
    }
    this.draw();
  }

  told(status) {
    if (status.id !== this.id) [this.trail, this.chosen, this.looks] = [[], null, null];
    if (status.looks !== this.looks || this.status?.state === "starting") this.lookedMs = performance.now() - 1000 * status.age_s;
    this.looks = status.looks;
    [this.status, this.id] = [status, status.id];
    if (status.range_m !== null && !status.predicted && !status.misses && status.looks !== this.trail.at(-1)?.look) {
      const covariance = status.covariance_m2;
      const look = { look: status.looks, at: Date.now() - 1000 * status.age_s, pair: status.pair, range: status.range_m, sigma: covariance ? Math.sqrt(covariance[0][0] + covariance[1][1] + covariance[2][2]) : null, error: null, off: [] };
      this.trail = [...this.trail.slice(1 - KEPT), look];
      if (this.simulated) this.judge(look, status);
    }
    this.draw();
  }

  /** What only a simulation knows: how far the place is off, and what the cameras found of it. */
  async judge(look, { id, pixels, position_m: place }) {
    try {
      const target = await this.whatWasChosen(id);
      if (!target) return;
      for (const eye of Object.values(pixels).filter((one) => one.x_px !== null)) {
        const truth = await placeIn(eye.frame_id, target);
        look.error = Math.hypot(...truth.position_m.map((value, k) => place[k] - value));
        if (truth.pixel_px) look.off.push(Math.hypot(eye.x_px - truth.pixel_px[0], eye.y_px - truth.pixel_px[1]));
      }
    } catch {
      this.chosen = null; // a frame that is no longer kept: sigma stands alone
    }
    this.draw();
  }

  /** The point of the site that the pixel truly showed by which the track began; null if it began otherwise. */
  whatWasChosen(id) {
    const pixel = this.events.newest("operation", id)?.request?.track?.pixel;
    if (!pixel) return null;
    this.chosen ??= shownBy(pixel.frame_id, [pixel.x_px, pixel.y_px]);
    return this.chosen;
  }

  /** How old the last look is: what was seen then need not be there now. */
  ago() {
    if (this.looked) say(this.looked, `${forTime((performance.now() - this.lookedMs) / 1000)} ago`);
  }

  draw() {
    const { status } = this;
    const on = Boolean(status) && ["starting", "tracking", "lost"].includes(status.state);
    const none = !status || status.state === "idle";
    this.bad.textContent = this.said;
    this.hint.hidden = on;
    this.buttons.hidden = none || !this.may;
    for (const button of [this.look, this.end]) button.disabled = !on;
    const row = (name, value) => h("tr", {}, h("th", { scope: "row" }, name), h("td", { class: "n" }, value));
    const pose = status?.pose;
    const stands = pose ? row("Rover at", `${number(pose.position_m[0], 2, true)}, ${number(pose.position_m[1], 2, true)} m, ${deg(2 * Math.atan2(pose.quaternion[3], pose.quaternion[0]), 1)}`) : null;
    this.drawApproach(none ? [] : this.trail);
    if (none) return put(this.head, stands ? h("table", { class: "figures" }, stands) : null);
    const last = status.state === "tracking" && !status.predicted ? this.trail.at(-1) : null; // else it is of a past place
    const hands = status.handoffs.length ? row("Hand-offs", status.handoffs.map((one) => h("div", {}, `${called(one.from_pair)} → ${called(one.to_pair)} at ${metres(one.range_m, 2)}`))) : null;
    put(this.head,
      h("p", {}, h("strong", { class: `word ${status.state}` }, status.state), " ", inDegrees(status.reason)),
      h("table", { class: "figures" }, !on ? null : [
        status.pair ? row("In use", called(status.pair)) : null,
        status.range_m !== null ? row("Range", metres(status.range_m) + (status.predicted ? " (carried over)" : "")) : null,
        last?.sigma == null ? null : row("One sigma", `${mm(last.sigma)} mm`),
        last?.error == null ? null : row("Truly off", `${mm(last.error)} mm${last.off.length ? `, ${number(Math.max(...last.off), 2)} px` : ""}`),
        Object.entries(status.pixels ?? {}).map(([name, eye]) => row(called(name), eye.x_px === null ? eye.verdict.replaceAll("_", " ") : `${number(eye.x_px, 1)}, ${number(eye.y_px, 1)} px`)),
        row("Last look", this.looked = h("span")),
        row("Looks, misses", `${status.looks}, ${status.misses}`)],
        hands, stands));
    this.ago();
  }

  drawApproach(trail) {
    const drawn = trail.length > 1;
    put(this.plots, drawn ? [this.ranges(), this.errors(), strip(trail.map((one) => called(one.pair ?? "")), `Camera in use, now ${called(trail.at(-1).pair ?? "")}`)] : null);
    const judged = trail.some((one) => one.error !== null);
    this.table.fill(["look", "at", "camera", "range m", "sigma mm", ...(judged ? ["truly off mm", "px"] : [])], !drawn ? [] : trail.toReversed().map((one) =>
      [one.look, clock(one.at), called(one.pair ?? ""), number(one.range, 3), mm(one.sigma), ...(judged ? [mm(one.error), one.off.length ? number(Math.max(...one.off), 2) : number(null)] : [])]));
  }

  /** The range of each look; a hand-off is a line between two. */
  ranges() {
    const { trail } = this;
    const high = roundUp(Math.max(...trail.map((one) => one.range)));
    return [h("p", { class: "quiet" }, "Range, m, look by look"),
      plot({ label: `Range over ${trail.length} looks, now ${metres(trail.at(-1).range)}`, count: trail.length, high, ticks: [[high, number(high, 0)], [0, "0"]], axis: timesOf(trail.map((one) => one.at)), kind: "approach" }, (x, y) => [
        trail.map((one, k) => (k && one.pair !== trail[k - 1].pair ? s("path", { class: "handoff", d: `M${(x(k) + x(k - 1)) / 2} 4V76` }) : null)),
        s("polyline", { class: "line", points: trail.map((one, k) => `${x(k)},${y(one.range)}`).join(" ") }),
        s("circle", { class: "tip newest", cx: x(trail.length - 1), cy: y(trail.at(-1).range), r: 3 })])];
  }

  /** How well its place was known, one sigma, and, where that can be known, how far it was off. */
  errors() {
    const { trail } = this;
    const judged = trail.some((one) => one.error !== null);
    const values = trail.flatMap((one) => [one.sigma, one.error]).filter((one) => one !== null);
    if (!values.length) return null;
    const high = roundUp(1000 * Math.max(...values));
    const last = trail.at(-1);
    const now = [last.error === null ? null : `truly ${mm(last.error)} mm off`, last.sigma === null ? null : `one sigma ${mm(last.sigma)} mm`].filter(Boolean).join(", ");
    return [h("p", { class: "quiet" }, judged ? "Truly off, mm, beside one sigma (band)" : "One sigma of its place, mm"),
      plot({ label: `Error of the place: ${now} at ${metres(last.range)}`, count: trail.length, high, ticks: [[high, number(high, high < 1 ? 1 : 0)], [0, "0"]], axis: timesOf(trail.map((one) => one.at)), kind: "approach errors" }, (x, y) => [
        s("polygon", { class: "band", points: [...trail.map((one, k) => `${x(k)},${y(1000 * (one.sigma ?? 0))}`), `${x(trail.length - 1)},${y(0)}`, `${x(0)},${y(0)}`].join(" ") }),
        trail.map((one, k) => {
          const value = judged ? one.error : one.sigma;
          return value === null ? null : s("circle", { class: one === last ? "tip newest" : "tip", cx: x(k), cy: y(1000 * value), r: one === last ? 3.5 : 2.4 }, s("title", {}, `${called(one.pair ?? "")}, ${metres(one.range)}: ${mm(value)} mm`));
        })])];
  }
}

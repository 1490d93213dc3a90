// Click, see what it would mean, send it, read the residual.
import { byId, h, put } from "./dom.js";
import { fileOf, get, post } from "./api.js";
import { camera as called, deg, inDegrees, metres, number, px } from "./words.js";
import { ageWords } from "./eye.js";
import { residualPicture } from "./residual.js";
import { placeIn, shownBy } from "./truth.js";

const STEPS = {
  rest: "the head rests", frames: "a fresh pair is taken", target: "the clicked point is found again", stereo: "found in the other camera", triangulate: "range",
  before: "pictures from before the move", solve: "joint angles", limits: "limits", move: "the head is sent", settle: "it has arrived and rests",
  view: "a view of the panorama", compose: "the mosaic is composed", look: "new pictures", measure: "the target is found in them", eyes: "the other camera confirms it", repeat: "a later picture repeats it",
};

const SMALL = matchMedia("(max-width: 599px) and (max-height: 499px)");
const TURNED_RAD = 0.005; // the joints' readings at rest scatter by less, some counts of a coarse encoder
const ENDED = ["done", "failed", "stopped"];

const FROM = {
  given: "The range was given.", plane: "The range is that of a plane.", parallax: "The range comes from two poses of one camera.",
  surface: "The range is that of the surface for which the panorama was composed.",
  unknown: "One camera alone cannot measure the range; after the first pointing its own parallax may.",
};

const HOW = [
  ["Click", "a point of a fresh image: its range is shown before anything moves"],
  ["Drag", "a box round a target, then confirm, to follow it; on a touch screen hold a finger on it"],
  ["← ↑ → ↓", "move the cross-hair of a focused image (Shift: 10 px, Alt: 0.1 px)", "keys"],
  ["Enter, T", "choose its point; follow it", "keys"],
  ["P", "point at what was chosen", "keys"],
];

const at = (what, [x, y]) => `${what}, x ${number(x, 1)}, y ${number(y, 1)} px`;
/** A refusal without the name of the option that it offers: a button stands beside it. */
const offered = (message) => message.replace(" (by_direction)", "");

/** An operation's steps, shut once it has ended. */
export function steps(record) {
  const over = ENDED.includes(record.state);
  return h("details", { class: "steps", open: !over }, h("summary", {}, over ? `Steps (${record.steps.length})` : "Under way"),
    h("ol", {}, record.steps.map((step) => h("li", { class: step.state }, STEPS[step.name] ?? step.name, h("span", { class: "n" }, `${number(step.duration_s, 2)} s`)))));
}

export class Target {
  constructor(views, events, say) {
    this.views = views;
    this.events = events;
    this.say = say;
    this.state = "none";
    this.number = 0;
    this.place = byId("target");
    this.may = this.latched = false;
    events.addEventListener("operation", (event) => this.operation(event.detail.value));
    events.addEventListener("joints", (event) => this.joints(event.detail.value));
    events.addEventListener("connected", () => this.askAgain());
    events.addEventListener("lost", () => this.disarm("The connection was lost"));
    events.addEventListener("mast", (event) => this.mast(event.detail.value.digest));
    document.addEventListener("views-changed", () => this.draw());
    this.render();
  }

  allow(may) {
    this.may = may;
    this.render();
  }

  use(status, rig) {
    this.simulated = status.simulated;
    this.cameras = rig.cameras;
  }

  /** A preview belongs to the head as it stood: after a stop, a turn or a takeover it is asked for anew. */
  disarm(what) {
    if (!["asked", "preview"].includes(this.state)) return;
    this.number += 1; // an answer that is under way comes too late
    this.refuse(`${what} after this point was chosen. Choose it again.`);
  }

  /** After a loss: a daemon that was started again knows nothing of what was sent to the one before. */
  async askAgain() {
    const { id } = this;
    if (this.state !== "sent" || !id) return;
    try {
      this.operation(await get(`/operations/${id}`));
    } catch (error) {
      if (error.status && this.id === id) this.refuse("The daemon was started again and does not know how the pointing ended. Choose the point again.");
    }
  }

  latch(latched) {
    if (latched === this.latched) return;
    this.latched = latched;
    this.disarm(`The emergency stop was ${latched ? "pressed" : "released"}`);
    this.render();
  }

  joints(now) {
    const then = this.click?.facts;
    if (then && Math.hypot(now.pan_rad - then.pan_rad, now.tilt_rad - then.tilt_rad) > TURNED_RAD) this.disarm("The head turned");
    if (this.state === "sent") this.render();
  }

  refuse(words, code = "") {
    this.state = "refused";
    this.words = words;
    this.code = code;
    this.say(words, true);
    this.draw();
    this.render();
  }

  /** A pixel of a shown image was chosen; nothing moves by it. */
  choose(eye, pixel, facts) {
    const camera = eye.name, old = facts ? ageWords(facts) : "";
    const request = facts && { pixel: { camera, frame_id: facts.frame_id, x_px: pixel[0], y_px: pixel[1], mast_digest: facts.mast_digest } };
    let refused = null;
    if (facts?.moving) refused = ["The head moved while this image was exposed. Click when it rests.", "frame_moving"];
    else if (!facts || eye.isStale) refused = [`The image of ${called(camera)} is not of now, so nothing in it can be clicked. ${old}`, "stale"];
    return this.seek({ label: at(called(camera), pixel), camera, pixel, facts, old, request }, refused);
  }

  /** A pixel of a panorama was chosen; `more`: to evaluate it by another mast file. */
  choosePanorama(id, [x, y], more = {}) {
    return this.seek({ label: at("Panorama", [x, y]), panorama: { id, pixel: [x, y] }, old: "", request: { panorama: { id, x_px: x, y_px: y, ...more } } });
  }

  /** Preview what was clicked, unless it is refused here. */
  async seek(click, refused = null) {
    if (!this.may) return this.refuse("You may look. To point, log in with a token of the role operate.", "role");
    const mine = ++this.number;
    this.click = click;
    this.preview = null;
    if (refused) return this.refuse(...refused);
    this.state = "asked";
    this.say(`Chosen: ${click.label}. ${click.old} Looking for it.`);
    this.draw();
    this.render();
    try {
      const preview = await post("/point/preview", click.request);
      if (mine !== this.number) return;
      this.preview = preview;
      this.state = "preview";
      this.say(`Range ${preview.range_sigma_m === null ? this.interval(preview) : `${metres(preview.range_m)} plus or minus ${metres(preview.range_sigma_m)}`}. ${preview.refused ? inDegrees(preview.refused.message) : "Press P to point."}`);
    } catch (error) {
      if (mine !== this.number) return;
      return this.refuse(error.message, error.code);
    }
    this.draw();
    this.render();
  }

  /** Send what was chosen; `again`: once more, after a pointing at it has ended. */
  send(again = false) {
    if (this.state !== (again ? "ended" : "preview") || (!again && this.preview.refused)) return;
    this.begin(this.click, this.preview, again); // the head has turned since it was chosen: its pixel is another one now
  }

  /** Send a pointing; without a preview: at a kept target, or in a direction alone. */
  async begin(click, preview = null, repeats = false) {
    if (!this.may || this.latched) return;
    Object.assign(this, { click, preview, repeats, state: "sent", record: null, id: null });
    this.number += 1;
    this.draw();
    this.render();
    try {
      this.id = (await post("/point", click.request)).id;
      this.operation(this.events.newest("operation", this.id));
    } catch (error) {
      this.refuse(error.code === "frame_too_old" ? "The image in which the point was chosen is no longer kept. Choose the point again." : error.message, error.code);
    }
  }

  /** What a panorama's refusal leaves: the direction alone, or its angles by the mast file in use. */
  instead(message, code) {
    const { request: { panorama } = {}, panorama: clicked } = this.click ?? {};
    if (!panorama || !this.may || panorama.by_direction) return null;
    const offer = (words, act) => h("div", { class: "buttons" }, h("button", { type: "button", id: "instead", disabled: this.latched, onclick: act }, words));
    if (code === "other_mast_file") return offer("Use its angles by this mast file", () => this.choosePanorama(clicked.id, clicked.pixel, { recompute: true }));
    if (!message.includes("by_direction") && !/^(target_|eyes_disagree|not_in_view)/.test(code)) return null;
    return offer("Point by direction alone", () => this.begin({ ...this.click, label: `${this.click.label}, direction alone`, request: { panorama: { ...panorama, by_direction: true } } }));
  }

  /** The position that is shown, rover frame of now, and its covariance where one is known; null without. */
  position() {
    if (this.state === "preview") return this.preview;
    if (this.state !== "ended" || !this.record.position_m) return null;
    return { covariance_m2: null, ...this.record.steps.findLast((step) => step.name === "triangulate")?.detail, position_m: this.record.position_m };
  }

  operation(record) {
    if (record && !ENDED.includes(record.state) && !record.request?.track) this.disarm("The head was sent elsewhere");
    if (!record || record.id !== this.id) return;
    this.record = record;
    if (ENDED.includes(record.state) && this.state === "sent") {
      this.state = "ended";
      this.truly = null;
      if (this.simulated && record.residual_px && this.click.facts) this.judge(record);
      if (record.residual_px) this.say(`Residual x ${number(record.residual_px[0], 2, true)}, y ${number(record.residual_px[1], 2, true)} pixels.`);
      else if (record.error) this.say(inDegrees(record.error.message), true);
      this.draw();
    }
    this.render();
  }

  /** What only a simulation knows: how far what was chosen truly is from the aim in the new image. */
  async judge(record) {
    const { click } = this;
    const last = record.pointings.at(-1);
    try {
      click.place ??= await shownBy(click.facts.frame_id, click.pixel);
      const { place } = click;
      const there = place && (await placeIn(last.frame_id, place)).pixel_px;
      if (!there || this.record !== record) return;
      this.truly = there.map((value, k) => value - last.aim_px[k]);
      this.render();
    } catch {
      // an image that is not kept any more: what was measured stands alone
    }
  }

  mast(digest) {
    if (this.click?.facts?.mast_digest !== digest) this.disarm("Another mast file came into use");
  }

  /** Cross-hairs in the images: what was clicked, the other eye's match, the aim. */
  draw() {
    for (const [name, eye] of this.views.eyes) {
      let click = null, match = null, aim = null, found = null;
      const chosen = this.state === "sent" ? !this.repeats && !this.moving() : ["asked", "preview"].includes(this.state);
      if (chosen && this.click.camera === name) click = this.click.pixel;
      if (chosen && this.click.camera && this.preview?.other_camera === name) match = this.preview.other_pixel_px;
      const last = this.state === "ended" ? this.record?.pointings.at(-1) : null;
      if (last?.camera === name) [aim, found] = [last.aim_px, last.target_px];
      eye.mark("click", click, "click", null);
      eye.mark("match", match, "match", match ? number(this.preview.correlation, 2) : null);
      eye.mark("aim", aim, "aim", aim && !found ? "aim" : null);
    }
  }

  moving() {
    return this.record?.steps.some((step) => step.name === "move") ?? false;
  }

  render() {
    const parts = {
      none: () => [h("dl", { class: "how" }, HOW.map(([what, words, kind]) => h("div", { class: kind }, h("dt", {}, what), h("dd", {}, words))))],
      asked: () => [this.chosen(), h("p", { class: "busy" }, "Looking for it in fresh images …")],
      preview: () => [this.chosen(), this.seen(), this.way(), this.go()],
      refused: () => [h("p", { class: "bad" }, offered(this.words)), this.instead(this.words, this.code), this.code === "no_stereo" ? h("p", { class: "quiet" }, "Without a second camera a pixel has no range; turn the head by angles or by hand.") : null],
      sent: () => [this.preview ? this.seen() : this.chosen(), this.progress()],
      ended: () => [this.result(), this.progress()],
    };
    put(this.place, parts[this.state]());
    document.dispatchEvent(new CustomEvent("target-changed"));
    // Where a window holds little more than the image, what came of it is brought into sight.
    if (this.place.dataset.state !== this.state && ["preview", "refused", "ended"].includes(this.state) && SMALL.matches) this.place.parentElement.scrollIntoView();
    this.place.dataset.state = this.state;
    if (this.state === "ended" && this.record?.pointings.at(-1)?.aim_px && this.record.residual_px && this.drawn !== this.record.id) this.picture();
  }

  chosen() {
    const { label, old } = this.click;
    return [h("p", {}, label), old ? h("p", { class: "warn", id: "old" }, old) : null];
  }

  seen() {
    const seen = this.preview;
    if (!seen) return null;
    const row = (name, value, more) => h("tr", {}, h("th", { scope: "row" }, name), h("td", { class: "n", ...more }, value));
    const place = seen.position_m?.map((value, k) => row(["x forward", "y right", "z down"][k], `${number(value, 3, true)}${seen.sigma_m ? ` ± ${number(seen.sigma_m[k], 3)}` : ""} m`));
    if (seen.range_sigma_m === null) {
      return [h("table", { class: "figures" }, row("Range", this.interval(seen), { id: "range", class: "n big" }), place),
        h("p", { class: "quiet" }, FROM[seen.range_from] ?? "")];
    }
    const clear = seen.correlation - seen.second > 0.3;
    return h("table", { class: "figures" },
      row("Range", `${number(seen.range_m, 3)} ± ${number(seen.range_sigma_m, 3)} m`, { id: "range", class: "n big" }), place,
      row("Match", `${number(seen.correlation, 3)}, next ${number(seen.second, 2)} (${clear ? "clear" : "close"})`),
      row("Off epipolar", px(seen.across_px)));
  }

  /** What one camera alone knows of the range. */
  interval({ range_m: range, range_interval_m: between }) {
    if (!between) return range === null ? "not known" : metres(range, 2);
    const [low, high] = between;
    return high === null || high > 1000 ? `beyond ${metres(low, 2)}` : `${number(low, 2)} to ${metres(high, 2)}`;
  }

  way() {
    const seen = this.preview;
    if (seen.refused) return h("p", { class: "bad" }, inDegrees(seen.refused.message));
    const here = this.events.newest("joints", "pan_tilt");
    const row = (name, k, now) => h("tr", {}, h("th", { scope: "row" }, name), h("td", { class: "n" }, deg(now)), h("td", {}, "→"), h("td", { class: "n" }, deg(seen.goal_rad[k])));
    return h("table", { class: "figures" }, row("Pan", 0, here?.pan_rad), row("Tilt", 1, here?.tilt_rad));
  }

  go() {
    if (this.preview.refused) return null;
    if (this.latched) return h("p", { class: "bad" }, "The emergency stop is latched. Release it, then choose the point again.");
    return h("div", { class: "buttons" }, h("button", { type: "button", class: "go", id: "point", onclick: () => this.send() }, "Point ", h("kbd", {}, "P")));
  }

  progress() {
    const record = this.record;
    if (!record) return h("p", { class: "busy" }, "Sent …");
    return steps(record);
  }

  result() {
    const record = this.record;
    if (record.state !== "done") return record.error ? [h("p", { class: "bad" }, offered(inDegrees(record.error.message))), this.instead(record.error.message, record.error.code)] : h("p", { class: "bad" }, `The operation was ${record.state}.`);
    const last = record.pointings.at(-1);
    if (!last.residual_px) return h("p", { class: "quiet" }, last.note);
    const [x, y] = last.residual_px;
    const [sx, sy] = last.residual_sigma_px;
    return [
      h("div", { class: "residual" },
        h("div", {}, h("p", { class: "quiet" }, "Residual in the new image"),
          h("p", { class: "huge", id: "residual" }, h("span", {}, "x ", `${number(x, 3, true)} ± ${number(sx, 3)} px`), h("span", {}, "y ", `${number(y, 3, true)} ± ${number(sy, 3)} px`)),
          this.truly ? h("p", { class: "quiet", id: "truly", title: "Only the simulation knows where it truly is" }, `truly ${this.truly.map((one) => number(one, 3, true)).join(", ")} px`) : null),
        h("div", { class: "inset", id: "inset" }, this.drawn === record.id ? this.inset : null)),
      h("table", { class: "figures" },
        h("tr", {}, h("td", {}), h("th", { scope: "col" }, "commanded"), h("th", { scope: "col" }, "measured")),
        h("tr", {}, h("th", { scope: "row" }, "Pan"), h("td", { class: "n" }, deg(last.commanded_pan_rad, 3)), h("td", { class: "n" }, deg(last.measured_pan_rad, 3))),
        h("tr", {}, h("th", { scope: "row" }, "Tilt"), h("td", { class: "n" }, deg(last.commanded_tilt_rad, 3)), h("td", { class: "n" }, deg(last.measured_tilt_rad, 3)))),
      h("p", { class: "quiet", id: "gain" }, this.gain(record, last)),
      this.may ? h("div", { class: "buttons" }, h("button", { type: "button", id: "again", disabled: this.latched, onclick: () => this.send(true) }, "Point again")) : null,
    ];
  }

  /** Whether another pointing could leave less: not where the match and the head's counts leave as much. */
  gain(record, last) {
    const counts = record.steps.findLast((step) => step.name === "settle")?.detail.count_rad ?? {};
    const camera = this.cameras?.[last.camera];
    if (!camera) return "";
    const [width, height] = camera.size_px;
    const shares = [["pan", width / 2 / Math.tan(camera.width_rad / 2) * Math.cos(last.true_tilt_rad ?? 0)], ["tilt", height / 2 / Math.tan(camera.height_rad / 2)]];
    const bounds = shares.map(([axis, pxPerRad], k) => 2 * last.residual_sigma_px[k] + ((counts[axis] ?? 0) / 2) * pxPerRad);
    if (last.residual_px.some((value, k) => Math.abs(value) > bounds[k])) return "";
    return `Nothing is to be gained by pointing again: two sigma of the match and half a count of the head come to ${bounds.map((one) => number(one, 2)).join(", ")} px.`;
  }

  async picture() {
    const record = this.record;
    this.drawn = record.id;
    const last = record.pointings.at(-1);
    this.inset = h("div");
    const path = `/snapshot/${encodeURIComponent(last.camera)}?format=png&frame_id=${encodeURIComponent(last.frame_id)}`;
    this.inset = await residualPicture(fileOf(path), last);
    if (this.record === record) this.render();
  }
}

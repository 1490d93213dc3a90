// Exposure, gain, white balance and focus of a camera: seen by everybody, changed by the holder of the lease.
import { byId, h, put, say } from "./dom.js";
import { ask, get, held } from "./api.js";
import { camera as called, sentence } from "./words.js";

const NAMES = { exposure_s: "Exposure", gain: "Gain", white_balance_k: "White balance", focus: "Focus" };
const plain = (value) => String(Number(value.toPrecision(6)));

export class Settings {
  constructor() {
    this.choice = h("select", { "aria-label": "Camera", onchange: () => this.choose() });
    this.rows = h("table", { class: "figures" });
    this.set = h("button", { type: "submit" }, "Set");
    this.hint = h("p", { class: "quiet" });
    this.said = h("p", { class: "bad", role: "alert" });
    this.form = h("form", { onsubmit: (event) => { event.preventDefault(); this.send(); } }, this.choice, this.rows, h("div", { class: "buttons" }, this.set), this.hint, this.said);
    put(byId("settings"), this.form);
    setInterval(() => this.draw(), 1000);
  }

  use(_status, rig) {
    const names = Object.keys(rig.cameras);
    if (names.join() === this.names?.join()) return;
    this.names = names;
    put(this.choice, names.map((name) => h("option", { value: name }, called(name))));
    this.choose();
  }

  /** Another camera: the fields of the one before must not stand beside its name, also where it does not answer. */
  choose() {
    this.now = null;
    put(this.rows);
    for (const told of [this.hint, this.said]) say(told, "");
    this.set.disabled = true;
    return this.look();
  }

  allow(may) {
    this.may = may;
    this.draw();
  }

  /** What the camera is set to now; another client may have changed it. */
  async look() {
    if (!this.choice.value) return;
    try {
      this.told(await get(`/cameras/${encodeURIComponent(this.choice.value)}/settings`));
      say(this.said, "");
    } catch (error) {
      say(this.said, error.message);
    }
  }

  /** Show it; a number that somebody types meanwhile stays. */
  told(now, own = false) {
    if (now.camera !== this.choice.value) return;
    if (!own && this.now?.camera === now.camera && this.rows.contains(document.activeElement)) {
      this.now.fixed = now.fixed;
      return this.draw();
    }
    this.now = now;
    this.fields = new Map(now.settings.map((one) => [one, h("input", {
      type: "number", step: one.step || "any", min: plain(one.minimum), max: plain(one.maximum), size: 8,
      value: one.value === null ? "" : plain(one.value), "aria-label": `${NAMES[one.name] ?? one.name} of ${called(now.camera)}`,
    })]));
    put(this.rows, now.settings.map((one) => h("tr", {}, h("th", { scope: "row" }, NAMES[one.name] ?? one.name),
      h("td", {}, this.fields.get(one), ` ${one.unit}`, h("div", { class: "quiet" }, one.refusal ? sentence(`it ${one.refusal}`) : `${plain(one.minimum)} to ${plain(one.maximum)}${one.automatic ? ", automatic" : ""}`)))));
    this.draw();
  }

  draw() {
    if (!this.now) return;
    const can = Boolean(this.may && held.lease && !this.now.fixed);
    for (const [one, field] of this.fields) field.disabled = !can || Boolean(one.refusal);
    this.set.disabled = !can || !this.now.settings.length;
    say(this.hint, !this.now.settings.length ? "Nothing of this camera can be changed while it runs." : this.now.fixed ? "An operation keeps them." : this.may && !held.lease ? "Take control to change them." : "");
  }

  async send() {
    if (!this.now) return;
    const changed = [...this.fields].filter(([one, field]) => field.value !== "" && field.value !== (one.value === null ? "" : plain(one.value)));
    if (!changed.length) return;
    try {
      const now = await ask("PATCH", `/cameras/${encodeURIComponent(this.now.camera)}/settings`, Object.fromEntries(changed.map(([one, field]) => [one.name, Number(field.value)])));
      this.told(now, true);
      say(this.said, now.notes.join(" "));
    } catch (error) {
      say(this.said, error.message);
    }
  }
}

// Turning the head by hand: heartbeats for as long as a key or a finger holds, and an end whatever ends it.
import { byId, h, put, say } from "./dom.js";
import { ask, beat, get, post } from "./api.js";
import { deg, degrees, figure, inDegrees, number } from "./words.js";

const BEAT_MS = 120;
const WAYS = { up: [0, 1, "▲", "Tilt up"], left: [-1, 0, "◀", "Pan left"], right: [1, 0, "▶", "Pan right"], down: [0, -1, "▼", "Tilt down"] };
const PLACE = /^[\p{L}\p{N}_+\u2212-][\p{L}\p{N}_ .,:°+\u2212-]*$/u;
const KEYS = { ArrowUp: "up", ArrowLeft: "left", ArrowRight: "right", ArrowDown: "down" };

export class Jog {
  constructor(tell) {
    this.tell = tell;
    this.down = new Set();
    this.rates = [0, 0];
    this.sequence = 0;
    this.id = null;
    this.speed = h("input", { type: "range", id: "speed", min: 0.5, max: 30, step: 0.5, value: 5, oninput: () => this.told() });
    this.speedWords = h("output", { for: "speed" });
    this.held = h("p", { class: "warn", role: "status" });
    this.pad = h("div", { class: "pad", id: "pad", tabindex: 0, role: "application", "aria-label": "Turn the head: hold an arrow key",
      onkeydown: (event) => this.key(event, true), onkeyup: (event) => this.key(event, false), onblur: () => this.release() },
      Object.entries(WAYS).map(([name, [, , sign, words]]) => h("button", { type: "button", class: name, tabindex: -1, "aria-label": words, "data-way": name,
        onpointerdown: (event) => { event.currentTarget.setPointerCapture(event.pointerId); event.preventDefault(); this.pad.focus(); this.hold(name, true); },
        onpointerup: () => this.hold(name, false), onpointercancel: () => this.hold(name, false), onlostpointercapture: () => this.hold(name, false), oncontextmenu: (event) => event.preventDefault() }, sign)));
    this.pan = h("input", { id: "goal-pan", inputmode: "decimal", autocomplete: "off", size: 7 });
    this.tilt = h("input", { id: "goal-tilt", inputmode: "decimal", autocomplete: "off", size: 7 });
    this.presets = h("div", { class: "presets" });
    this.name = h("input", { id: "place-name", "aria-label": "Name of this place", placeholder: "name", autocomplete: "off", maxlength: 40, size: 9 });
    this.goSaid = h("p", { class: "bad", role: "alert" });
    this.all = h("fieldset", {},
      h("div", { class: "side" }, this.pad, h("div", { class: "stack" }, h("label", { for: "speed" }, "Speed ", this.speedWords), this.speed, this.held)),
      h("form", { class: "angles", onsubmit: (event) => { event.preventDefault(); this.goTyped(); } },
        h("label", {}, "Pan ", this.pan, " °"), h("label", {}, "Tilt ", this.tilt, " °"), h("button", { type: "submit" }, "Go")),
      this.presets,
      h("form", { class: "angles", onsubmit: (event) => { event.preventDefault(); this.keep(); } }, this.name, h("button", { type: "submit", class: "quiet" }, "Keep this place")),
      this.goSaid);
    put(byId("jog"), this.all);
    for (const [place, name] of [[window, "blur"], [window, "pagehide"], [document, "visibilitychange"]]) place.addEventListener(name, () => this.release());
    this.told();
    this.drawPlaces({ home: { pan_rad: 0, tilt_rad: 0 } });
  }

  use(limits) {
    this.limits = limits;
    this.speed.max = number(degrees(limits.speed_rad_per_s), 1);
    this.told();
  }

  allow(may) {
    this.all.disabled = !may;
    this.pad.tabIndex = may ? 0 : -1;
    this.may = may;
    if (!may) this.release();
  }

  told() {
    say(this.speedWords, `${number(Number(this.speed.value), 1)} °/s`);
    this.turn();
  }

  key(event, down) {
    const way = KEYS[event.key];
    if (!way) return;
    event.preventDefault();
    if (!event.repeat) this.hold(way, down);
  }

  hold(way, down) {
    if (!this.may) return;
    if (down) this.down.add(way);
    else this.down.delete(way);
    for (const button of this.pad.children) button.dataset.held = this.down.has(button.dataset.way);
    this.turn();
  }

  release() {
    if (!this.down.size) return;
    this.down.clear();
    for (const button of this.pad.children) button.dataset.held = false;
    this.turn();
  }

  turn() {
    const rate = (Number(this.speed.value) * Math.PI) / 180;
    const sum = [0, 0];
    for (const way of this.down) { sum[0] += WAYS[way][0]; sum[1] += WAYS[way][1]; }
    const rates = [sum[0] * rate, sum[1] * rate];
    if (rates.join() === this.rates.join()) return;
    this.rates = rates;
    if (!this.busy) this.work();
    else this.wake?.();
  }

  /** One heartbeat after the other, the next at once when the rates change. */
  async work() {
    this.busy = true;
    try {
      for (;;) {
        const rates = this.rates;
        const still = rates[0] === 0 && rates[1] === 0;
        if (still && this.id === null) break;
        const body = { pan_rad_per_s: rates[0], tilt_rad_per_s: rates[1], sequence: ++this.sequence };
        if (this.id !== null) body.id = this.id;
        const told = await beat(body);
        this.id = told.id;
        say(this.held, inDegrees(Object.values(told.held ?? {}).join(" ")));
        if (still) { this.id = null; this.sequence = 0; continue; }
        if (rates === this.rates) {
          await new Promise((go) => { this.wake = go; setTimeout(go, BEAT_MS); });
        }
      }
    } catch (error) {
      this.id = null;
      this.sequence = 0;
      this.down.clear();
      this.rates = [0, 0];
      for (const button of this.pad.children) button.dataset.held = false;
      say(this.held, error.message);
    } finally {
      this.busy = false;
    }
  }

  async go(panRad, tiltRad) {
    say(this.goSaid, "");
    try {
      await post("/point", { pan_rad: panRad, tilt_rad: tiltRad });
    } catch (error) {
      say(this.goSaid, error.message);
    }
  }

  goTyped() {
    const [pan, tilt] = [this.pan, this.tilt].map((input) => figure(input.value));
    if (!Number.isFinite(pan) || !Number.isFinite(tilt)) return say(this.goSaid, "Two angles in degrees are expected, such as 12.5 and -8.");
    for (const [name, typed] of [["Pan", pan], ["Tilt", tilt]]) if (Math.abs(typed) > 360) return say(this.goSaid, `${name} ${number(typed, 1)}° where \u2212360° to 360° is expected.`);
    this.go((pan * Math.PI) / 180, (tilt * Math.PI) / 180);
  }

  /** The places that the daemon keeps, for everybody. */
  async look() {
    await this.change(() => get("/places"));
  }

  async change(act) {
    say(this.goSaid, "");
    try {
      this.drawPlaces((await act()).places);
    } catch (error) {
      say(this.goSaid, error.message);
    }
  }

  drawPlaces(places) {
    const told = JSON.stringify(places);
    if (told === this.drawn) return;
    this.drawn = told;
    put(this.presets, Object.entries(places).map(([name, { pan_rad: pan, tilt_rad: tilt }]) => {
      const home = name === "home";
      const there = `${deg(pan, 1)} ${deg(tilt, 1)}`;
      return h("span", { class: "preset" },
        h("button", { type: "button", id: home ? "home" : null, title: there, onclick: () => this.go(pan, tilt) }, home ? "Home" : name),
        home ? null : h("button", { type: "button", class: "minus", "aria-label": `Forget ${name}`, onclick: () => this.change(() => ask("DELETE", `/places/${encodeURIComponent(name)}`)) }, "×"));
    }));
  }

  /** Keep where the head is, by the name that was typed, else by its angles; as home it is where Home goes. */
  async keep() {
    if (!this.here) return;
    const [pan, tilt] = this.here;
    const typed = this.name.value.trim();
    if (typed && !PLACE.test(typed)) return say(this.goSaid, `'${typed}' where a name of letters, digits, spaces and . , : ° + - is expected, which begins with a letter or a digit.`);
    const name = typed.toLowerCase() === "home" ? "home" : typed || `${deg(pan, 1)} ${deg(tilt, 1)}`;
    await this.change(() => post(`/places/${encodeURIComponent(name)}`, { pan_rad: pan, tilt_rad: tilt }));
    if (!this.goSaid.textContent) this.name.value = "";
  }
}

// A simulated rover: faults from a drawer, and driving it.
import { byId, h, put, say } from "./dom.js";
import { ask, get, post } from "./api.js";
import { camera as called, deg, figure, number, unitOf } from "./words.js";

const LOOK_MS = 5000; // a fault may end by itself
const CHOICES = { axis: ["pan", "tilt", "both"], moving: ["no", "yes"] };
const LABELS = { after_s: "begins after", for_s: "lasts", call: "which call", sender: "servo's id, 0 any" };

/** A parameter's name and unit, and how many of that unit one of the daemon's is. */
function named(name) {
  const [stem, unit, scale] = unitOf(name);
  return [LABELS[name] ?? stem.replaceAll("_", " "), unit, scale];
}

export class Simulation {
  constructor() {
    this.words = null;
    this.device = h("select", { "aria-label": "Device", onchange: () => this.offer() });
    this.word = h("select", { "aria-label": "Fault", onchange: () => this.explain() });
    this.does = h("p", { class: "quiet", id: "fault-does" });
    this.parameters = h("div", { class: "parameters" });
    this.list = h("ul", { class: "set" });
    this.said = h("p", { class: "bad", role: "alert" });
    this.rover = h("p", { class: "quiet" });
    this.refused = h("p", { class: "bad", id: "drive-said", role: "alert" });
    this.set = h("button", { type: "submit" }, "Set");
    this.clear = h("button", { type: "button", onclick: () => this.act(() => ask("DELETE", "/simulation/faults")) }, "Clear all");
    this.drive = h("div", { class: "buttons" }, [["Ahead 0.25 m", 0.25, 0], ["Back 0.25 m", -0.25, 0], ["Turn left 5°", 0, -0.0873], ["Turn right 5°", 0, 0.0873]].map(([words, ahead, turn]) =>
      h("button", { type: "button", onclick: () => this.act(() => this.stand(ahead, turn), this.refused) }, words)));
    this.form = h("form", { onsubmit: (event) => { event.preventDefault(); this.act(() => this.setFault()); } },
      h("div", { class: "two" }, this.device, this.word), this.does, this.parameters, h("div", { class: "buttons" }, this.set, this.clear));
    put(byId("simulated"), this.form, this.list, this.said, h("h3", {}, "Drive the simulated rover"), this.drive, this.refused, this.rover);
    setInterval(() => this.words && !document.hidden && this.look(), LOOK_MS);
  }

  async use(status) {
    byId("simulation").hidden = !status.simulated;
    if (!status.simulated) return;
    if (!this.words) await this.learn();
    this.look();
  }

  /** Which words each device takes, with their parameters: as the daemon says. */
  async learn() {
    try {
      const { devices } = await get("/simulation/words");
      this.words = devices;
      put(this.device, Object.keys(devices).map((name) => h("option", { value: name }, called(name))));
      this.offer();
    } catch (error) {
      say(this.said, error.message);
    }
  }

  offer() {
    put(this.word, Object.keys(this.words[this.device.value]).map((word) => h("option", { value: word }, word.replaceAll("_", " "))));
    this.explain();
  }

  explain() {
    const { effect, parameters } = this.words[this.device.value][this.word.value];
    say(this.does, `${effect[0].toUpperCase()}${effect.slice(1)}.`);
    this.inputs = new Map(Object.entries(parameters).map(([name, told]) => [name, this.input(name, told)]));
    put(this.parameters, [...this.inputs].map(([name, input]) => h("label", {}, h("span", {}, named(name)[0]), input, h("span", { class: "unit" }, named(name)[1]))));
  }

  input(name, { default: usual, least, most }) {
    const choices = CHOICES[name];
    if (choices) return h("select", {}, choices.map((words, k) => h("option", { value: k, selected: k === usual }, words)));
    const [, unit, scale] = named(name);
    const told = (value) => (value === null ? "without end" : String(Number((value * scale).toPrecision(4))));
    return h("input", { inputmode: "decimal", autocomplete: "off", placeholder: name === "for_s" ? "until cleared" : told(usual), title: `${told(least)} to ${told(most)} ${unit}`, size: 7 });
  }

  async setFault() {
    const parameters = {};
    for (const [name, input] of this.inputs) {
      const [label, unit, scale] = named(name);
      if (!input.value.trim()) continue;
      const value = figure(input.value);
      if (!Number.isFinite(value)) throw new Error(`${label}: '${input.value}' where a number${unit ? ` in ${unit}` : ""} is expected.`);
      const { least, most } = this.words[this.device.value][this.word.value].parameters[name];
      const [low, high] = [least, most].map((end) => (end === null ? null : Number((end * scale).toPrecision(4))));
      if ((low !== null && value < low) || (high !== null && value > high)) throw new Error(`${label} is ${value} where ${high === null ? `${low} or more` : `${low} to ${high}`}${unit ? ` ${unit}` : ""} is expected.`);
      parameters[name] = value / scale;
    }
    await post("/simulation/faults", { device: this.device.value, word: this.word.value, parameters });
  }

  allow(may) {
    for (const one of [this.device, this.word, this.set, this.clear, ...this.drive.children]) one.disabled = !may;
  }

  async act(work, place = this.said) {
    say(place, "");
    try {
      await work();
    } catch (error) {
      say(place, error.message);
    }
    this.look();
  }

  async look() {
    try {
      const { faults } = await get("/simulation/faults");
      const told = JSON.stringify(faults);
      if (told === this.told) return;
      this.told = told;
      put(this.list, faults.map(({ device, word, parameters }) => h("li", {}, h("strong", {}, called(device)), ` ${word.replaceAll("_", " ")}${this.unusual(device, word, parameters)}`)));
    } catch {
      // it cannot be asked now
    }
  }

  /** The parameters of a fault that are not as usual, in words. */
  unusual(device, word, parameters) {
    const usual = this.words?.[device]?.[word]?.parameters ?? {};
    const words = Object.entries(parameters).filter(([name, value]) => usual[name]?.default !== value).map(([name, value]) => {
      const [label, unit, scale] = named(name);
      return `${label} ${CHOICES[name]?.[value] ?? Number((value * scale).toPrecision(4))}${unit === "°" ? unit : unit ? ` ${unit}` : ""}`;
    });
    return words.length ? `: ${words.join(", ")}` : "";
  }

  /** Drive a little way, and tell the daemon where the rover truly stands, as an odometer would. */
  async stand(ahead, turn) {
    const now = await get("/simulation/pose");
    const [w, , , z] = now.quaternion;
    const heading = 2 * Math.atan2(z, w);
    const place = { x_m: now.position_m[0] + ahead * Math.cos(heading), y_m: now.position_m[1] + ahead * Math.sin(heading), heading_rad: heading + turn };
    const { state: followed } = await get("/track");
    const pose = await post("/simulation/pose", place);
    say(this.rover, `The rover stands at ${number(place.x_m, 2, true)}, ${number(place.y_m, 2, true)} m, heading ${deg(place.heading_rad, 1)}.`);
    const told = { position_m: pose.position_m, quaternion: pose.quaternion, sigma: { position_m: 0.01, rotation_rad: 0.009 } };
    const { track } = await post("/pose", told).catch((error) => { throw new Error(`The rover has moved, but the daemon refused its pose: ${error.message}`); });
    if (track.state === "stopped" && followed !== "stopped") throw new Error(`The track has ended: ${track.reason}.`);
  }
}

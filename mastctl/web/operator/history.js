// The last hours: joints and temperatures over time, and what happened; asked for while somebody has it open.
import { byId, h, put, s, say } from "./dom.js";
import { get, person } from "./api.js";
import { camera as called, degrees, forTime, inDegrees, number } from "./words.js";
import { hiddenTable, plot } from "./plots.js";

const AGAIN_MS = 10000;
const SPANS_S = [["10 minutes", 600], ["1 hour", 3600], ["10 hours", 36000]];
const PARTS = 1000; // of the time axis
const SHOWN = 60; // events in words

export class History {
  constructor() {
    this.span = h("select", { "aria-label": "How far back", onchange: () => this.draw() }, SPANS_S.map(([words, value]) => h("option", { value }, words)));
    this.plots = h("div", { class: "plots" });
    this.list = h("table", { class: "figures list" });
    this.table = hiddenTable();
    this.said = h("p", { class: "quiet" });
    this.whole = h("details", { ontoggle: () => this.look() }, h("summary", {}, "Joints, temperatures and events over time"), h("p", {}, "The last ", this.span), this.plots, this.table.place, this.said, h("div", { class: "wide", tabindex: 0, role: "region", "aria-label": "Events" }, this.list));
    put(byId("history"), this.whole);
    setInterval(() => document.hidden || this.look(), AGAIN_MS);
  }

  async look() {
    if (!this.whole.open) return;
    try {
      this.told = await get("/history");
      this.draw();
    } catch (error) {
      say(this.said, error.message);
    }
  }

  draw() {
    const { told } = this;
    if (!told) return;
    const span = Number(this.span.value);
    const events = told.events.filter((one) => one.age_s <= span);
    const pan = told.pan_rad.map(degrees), tilt = told.tilt_rad.map(degrees);
    const axes = Object.entries(told.temperatures_c);
    put(this.plots,
      this.over("Joints, °", [["pan", pan, "of-x"], ["tilt", tilt, "of-y"]], events, span, "°"),
      axes.length ? this.over("Temperatures, °C", axes.map(([name, values], k) => [name, values, k ? "of-y" : "of-x"]), events, span, " °C") : h("p", { class: "quiet" }, "The driver of this head reports no temperatures."));
    const newest = events.slice(-SHOWN).reverse();
    say(this.said, events.length ? `${events.length} events, marked below the plots; the newest ${newest.length}:` : "Nothing has happened in this time.");
    put(this.list, newest.map((one) => h("tr", {}, h("td", { class: "n" }, `${forTime(one.age_s)} ago`), h("td", { class: one.well ? "" : "bad" }, person(inDegrees(one.words))))));
    this.table.fill(["s ago", "pan °", "tilt °", ...axes.map(([name]) => `${called(name)} °C`)], told.age_s.map((age, k) => [number(age, 0), number(pan[k], 2, true), number(tilt[k], 2, true), ...axes.map(([, values]) => number(values[k], 1))]).filter((_, k) => told.age_s[k] <= span).reverse().slice(0, 200));
  }

  /** Lines over the time that is asked for, the present on the right; events as ticks at the foot. */
  over(words, lines, events, span, unit) {
    const { age_s: ages } = this.told;
    const first = Math.max(0, ages.findIndex((age) => age <= span) - 1); // from where the line comes in
    const drawn = lines.map(([name, values, kind]) => [name, values.map((value, k) => [Math.min(span, ages[k]), value]).slice(ages.some((age) => age <= span) ? first : -1).filter(([, value]) => value !== null), kind]);
    const all = drawn.flatMap(([, points]) => points.map(([, value]) => value));
    const now = drawn.map(([name, points]) => `${name} ${number(points.at(-1)?.[1] ?? null, 1, true)}${unit}`).join(", ");
    if (!all.length) return null;
    const [low, high] = [Math.floor(Math.min(...all) - 0.5), Math.ceil(Math.max(...all) + 0.5)];
    const at = (age) => PARTS * (1 - Math.min(1, age / span));
    return [h("p", { class: "quiet" }, `${words}: `, drawn.map(([name, , kind], k) => [k ? "  " : "", h("span", { class: kind }, `${k ? "╌" : "─"} ${name}`)])),
      plot({ label: `${words} over the last ${forTime(span)}; now ${now}; ${events.length} events`, count: PARTS + 1, low, high, ticks: [[high, number(high, 0)], [low, number(low, 0)]], height: 104, kind: "over-time" }, (x, y) => [
        events.map((one) => s("path", { class: one.well ? "tick" : "tick worse", d: `M${x(at(one.age_s))} 100V92` }, s("title", {}, one.words))),
        drawn.map(([, points, kind]) => s("polyline", { class: `line ${kind}`, points: [...points, [0, points.at(-1)?.[1]]].filter(([, value]) => value !== undefined).map(([age, value]) => `${x(at(age)).toFixed(1)},${y(value).toFixed(1)}`).join(" ") }))])];
  }
}

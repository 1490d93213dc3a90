// What came since the page was opened: the joints over time, and what happened. Nothing is stored in the daemon.
import { byId, h, put, s, say } from "./dom.js";
import { person } from "./api.js";
import { degrees, forTime, inDegrees, number } from "./words.js";
import { hiddenTable, plot } from "./plots.js";

const AGAIN_MS = 2000;
const APART_S = 2; // between two samples
const MOST_S = 3600;
const SPANS_S = [["10 minutes", 600], ["1 hour", MOST_S]];
const PARTS = 1000; // of the time axis
const EVENTS = 300; // kept
const SHOWN = 60; // as text
const QUIET = ["lease.renew", "jog"]; // commands that repeat

const nowS = () => performance.now() / 1000;
const joined = (first, more) => (more ? `${first}: ${more}` : first);
const roundTime = (seconds) => (seconds > 7200 ? `${seconds / 3600} h` : `${seconds / 60} min`);

export class History {
  constructor(events) {
    this.samples = [];
    this.happened = [];
    this.faults = new Map();
    this.span = h("select", { "aria-label": "How far back", onchange: () => this.draw() }, SPANS_S.map(([words, value]) => h("option", { value }, words)));
    this.plots = h("div", { class: "plots" });
    this.list = h("table", { class: "figures list" });
    this.table = hiddenTable();
    this.said = h("p", { class: "quiet" });
    this.whole = h("details", { ontoggle: () => this.draw() }, h("summary", {}, "Joints and events since the page was opened"), h("p", {}, "The last ", this.span), this.plots, this.table.place, this.said, h("div", { class: "wide", tabindex: 0, role: "region", "aria-label": "Events" }, this.list));
    put(byId("history"), this.whole);
    events.addEventListener("joints", ({ detail }) => this.take(detail.value));
    events.addEventListener("state", ({ detail: { value } }) => {
      if (value.state === this.state) return;
      this.state = value.state;
      this.note(joined(value.state, value.reason), !["fault", "stopped"].includes(value.state));
    });
    events.addEventListener("fault", ({ detail: { key, value } }) => {
      const before = this.faults.get(key) ?? [];
      this.faults.set(key, value.map((one) => one.code));
      for (const one of value) if (!before.includes(one.code)) this.note(joined(key, one.message), false);
      if (before.length && !value.length) this.note(`${key}: the fault is over`, true);
    });
    events.addEventListener("command", ({ detail: { value } }) => {
      const good = value.result === "ok" || value.state === "done";
      if (value.result && !(good && QUIET.includes(value.command))) this.note(joined(`${value.who}: ${value.command}`, good ? "" : value.message), good);
      else if (value.ended) this.note(joined(`${value.ended}: ${value.state}`, value.message), good);
    });
    setInterval(() => document.hidden || this.draw(), AGAIN_MS);
  }

  take({ pan_rad: pan, tilt_rad: tilt }) {
    const time = nowS(), last = this.samples.at(-1);
    if (last && time - last.time < APART_S) Object.assign(last, { pan, tilt });
    else this.samples.push({ time, pan, tilt });
    while (time - this.samples[0].time > MOST_S) this.samples.shift();
  }

  note(words, well) {
    this.happened.push({ time: nowS(), words, well });
    if (this.happened.length > EVENTS) this.happened.shift();
  }

  draw() {
    if (!this.whole.open) return;
    const now = nowS(), span = Number(this.span.value);
    const within = (one) => now - one.time <= span;
    const samples = this.samples.filter(within), events = this.happened.filter(within);
    put(this.plots, this.over(samples, events, span, now));
    const newest = events.slice(-SHOWN).reverse();
    say(this.said, events.length ? `${events.length} events, marked below the plot; the newest ${newest.length}:` : "Nothing has happened in this time.");
    put(this.list, newest.map((one) => h("tr", {}, h("td", { class: "n" }, `${forTime(now - one.time)} ago`), h("td", { class: one.well ? "" : "bad" }, person(inDegrees(one.words))))));
    this.table.fill(["s ago", "pan °", "tilt °"], samples.slice(-200).reverse().map((one) => [number(now - one.time, 0), number(degrees(one.pan), 2, true), number(degrees(one.tilt), 2, true)]));
  }

  /** Pan and tilt over the chosen time, the present on the right; events as ticks at the foot. */
  over(samples, events, span, now) {
    if (!samples.length) return null;
    const at = (time) => PARTS * (1 - (now - time) / span);
    const lines = [["pan", "of-x"], ["tilt", "of-y"]].map(([name, kind]) => [name, kind, samples.map((one) => [at(one.time), degrees(one[name])])]);
    const all = lines.flatMap(([, , points]) => points.map(([, value]) => value));
    const [low, high] = [Math.floor(Math.min(...all) - 0.5), Math.ceil(Math.max(...all) + 0.5)];
    const latest = lines.map(([name, , points]) => `${name} ${number(points.at(-1)[1], 1, true)}°`).join(", ");
    return [h("p", { class: "quiet" }, "Joints, °: ", lines.map(([name, kind], k) => [k ? "  " : "", h("span", { class: kind }, `${k ? "╌" : "─"} ${name}`)])),
      plot({ label: `Joints over the last ${forTime(span)}; now ${latest}; ${events.length} events`, count: PARTS + 1, low, high, ticks: [[high, number(high, 0)], [low, number(low, 0)]], axis: [[0, `${roundTime(span)} ago`], [PARTS / 2, roundTime(span / 2)], [PARTS, "now"]], height: 104, kind: "over-time" }, (x, y) => [
        events.map((one) => s("path", { class: one.well ? "tick" : "tick worse", d: `M${x(at(one.time))} 100V92` }, s("title", {}, one.words))),
        lines.map(([, kind, points]) => s("polyline", { class: `line ${kind}`, points: [...points, [PARTS, points.at(-1)[1]]].map(([place, value]) => `${x(place).toFixed(1)},${y(value).toFixed(1)}`).join(" ") }))])];
  }
}

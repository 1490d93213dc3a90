// Small plots of one thing after the other, the newest on the right; what they show stands in a table too.
import { h, put, s } from "./dom.js";
import { clock } from "./words.js";

const WIDTH = 280;
const LEFT = 40;
const FOOT = 8;
const AXIS = 14; // below the plot: when each was

/** A plot over `count` things: `draw(x, y)` makes its marks, of an index and of a value from `low` to `high`.
 *  `axis` names some of the indices by their time. */
export function plot({ label, count, low = 0, high, ticks, axis, height = 84, kind = "" }, draw) {
  const x = (k) => (count > 1 ? LEFT + 8 + ((WIDTH - LEFT - 18) * k) / (count - 1) : (LEFT + WIDTH) / 2);
  const y = (value) => 8 + ((height - 8 - FOOT) * (high - value)) / (high - low);
  return s("svg", { class: `plot ${kind}`, viewBox: `0 0 ${WIDTH} ${height + AXIS}`, role: "img", "aria-label": label },
    axis.map(([k, words]) => [
      s("path", { class: "ring", d: `M${x(k)} ${height - FOOT}v4` }),
      s("text", { class: `tickname time ${k === 0 && count > 1 ? "start" : k === count - 1 ? "end" : ""}`, x: k === 0 && count > 1 ? LEFT : k === count - 1 ? WIDTH : x(k), y: height + 8 }, words)]),
    s("path", { class: "ring", d: `M${LEFT} 4V${height - FOOT + 4}M${LEFT} ${y(Math.max(low, 0))}H${WIDTH - 4}` }),
    ticks.map(([value, words]) => s("text", { class: "tickname end", x: LEFT - 4, y: y(value) + 4 }, words)),
    draw(x, y));
}

/** The axis of things that were at some times, ms of this browser's clock: the first, the middle and the last. */
export function timesOf(all) {
  const last = all.length - 1;
  return [...new Set([0, last > 3 ? Math.round(last / 2) : 0, last])].map((k) => [k, clock(all[k])]);
}

/** Which of a few names stood for each of many things: a strip under a plot. */
export function strip(names, label) {
  const width = (WIDTH - LEFT - 4) / names.length;
  const runs = [];
  names.forEach((name, k) => { if (name === runs.at(-1)?.name) runs.at(-1).length += 1; else runs.push({ name, from: k, length: 1 }); });
  return s("svg", { class: "plot strip", viewBox: `0 0 ${WIDTH} 18`, role: "img", "aria-label": label },
    runs.map(({ name, from, length }) => [
      s("rect", { class: "field", x: LEFT + from * width + 0.5, y: 1, width: length * width - 1, height: 16, rx: 2 }, s("title", {}, name)),
      length * width > 6.5 * name.length ? s("text", { class: "tickname", x: LEFT + (from + length / 2) * width, y: 13 }, name) : null]));
}

/** A table that is opened by who wants the figures; `fill` puts new ones. */
export function hiddenTable() {
  const table = h("table", { class: "figures list" });
  const place = h("details", { class: "as-table", hidden: true }, h("summary", {}, "As a table"), h("div", { class: "wide" }, table));
  const fill = (heads, rows) => {
    place.hidden = !rows.length;
    put(table, h("tr", {}, heads.map((name) => h("th", { scope: "col" }, name))), rows.map((row) => h("tr", {}, row.map((value) => h("td", { class: "n" }, value)))));
  };
  return { place, fill };
}

/** The next round number at or above a value. */
export function roundUp(value) {
  if (!(value > 0)) return 1;
  const ten = 10 ** Math.floor(Math.log10(value));
  return ten * [1, 1.5, 2, 3, 4, 5, 6, 8, 10].find((one) => one * ten >= value * 0.999999);
}

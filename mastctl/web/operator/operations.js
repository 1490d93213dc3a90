// The last operations: what was asked by whom, what came of it, and each one's picture, opened by who wants it.
import { byId, h, put } from "./dom.js";
import { fileOf, person } from "./api.js";
import { clock, deg, inDegrees, number } from "./words.js";
import { residualPicture } from "./residual.js";
import { steps } from "./target.js";

const SHOWN = 8;
const ASKED = { panorama: "Point in a panorama", pixel: "Point at a pixel", position_m: "Point at a position", pan_rad: "Turn to angles", track: "Begin a track", jog: "Turn by hand" };

export class OperationList {
  constructor(events) {
    this.records = new Map();
    this.by = new Map();
    this.items = new Map();
    events.addEventListener("operation", (event) => this.told(event.detail.value));
    events.addEventListener("command", (event) => this.asked(event.detail.value));
    events.addEventListener("connected", () => { for (const each of [this.records, this.by, this.items]) each.clear(); this.soon(); });
    this.draw();
  }

  told(record) {
    this.records.delete(record.id);
    this.records.set(record.id, record);
    this.soon();
  }

  /** Who began it, and when by the daemon's clock. */
  asked({ operation, who, time }) {
    if (!operation || !time) return;
    this.by.set(operation, `${clock(time)}, ${person(who)}`);
    this.items.delete(operation);
    this.soon();
  }

  soon() {
    this.drawing ??= setTimeout(() => this.draw(), 200);
  }

  draw() {
    this.drawing = null;
    const newest = [...this.records.values()].sort((a, b) => b.created_s - a.created_s).slice(0, SHOWN);
    const shown = new Set(newest.map((record) => record.id));
    for (const each of [this.records, this.by, this.items]) for (const id of each.keys()) if (!shown.has(id)) each.delete(id);
    put(byId("operations"), newest.length ? newest.map((record) => this.item(record)) : h("p", { class: "quiet" }, "None since the daemon began."));
  }

  item(record) {
    const before = this.items.get(record.id);
    if (before?.record === record) return before.place;
    const [what] = Object.keys(record.request ?? {});
    const result = record.residual_px ? `${record.residual_px.map((one) => number(one, 2, true)).join(", ")} px` : "";
    const place = h("details", { class: "operation", open: before?.place.open ?? false },
      h("summary", {}, h("span", { class: `word ${record.state}` }, record.state), h("span", { class: "what" }, typeof record.request?.track === "string" ? "Look for the target" : typeof record.request?.panorama === "string" ? "Take a panorama" : ASKED[what] ?? what ?? ""), h("span", { class: "n" }, result)));
    const fill = () => { if (place.open && place.children.length === 1) place.append(this.whole(record)); };
    place.addEventListener("toggle", fill);
    fill();
    this.items.set(record.id, { record, place });
    return place;
  }

  whole(record) {
    const last = record.pointings?.at(-1);
    const place = h("div", { class: "whole" }, h("p", { class: "quiet" }, `${record.id}${this.by.has(record.id) ? `, ${this.by.get(record.id)}` : ""}`),
      record.error ? h("p", { class: "bad" }, inDegrees(record.error.message)) : null);
    if (last) {
      place.append(h("table", { class: "figures" },
        h("tr", {}, h("td", {}), h("th", { scope: "col" }, "commanded"), h("th", { scope: "col" }, "measured")),
        ["pan", "tilt"].map((axis) => h("tr", {}, h("th", { scope: "row" }, axis === "pan" ? "Pan" : "Tilt"), h("td", { class: "n" }, deg(last[`commanded_${axis}_rad`], 3)), h("td", { class: "n" }, deg(last[`measured_${axis}_rad`], 3)))),
        last.residual_px ? [0, 1].map((k) => h("tr", {}, h("th", { scope: "row" }, `Residual ${"xy"[k]}`), h("td", { class: "n", colspan: 2 }, `${number(last.residual_px[k], 3, true)} ± ${number(last.residual_sigma_px?.[k], 3)} px`))) : null));
    }
    if (last?.frame_id) this.picture(place, last);
    place.append(steps(record));
    return place;
  }

  /** The image after the move, whole and around the aim, for as long as the daemon keeps it. */
  async picture(place, last) {
    const path = fileOf(`/snapshot/${encodeURIComponent(last.camera)}?format=png&frame_id=${encodeURIComponent(last.frame_id)}`);
    const frame = h("div", { class: "pictures" });
    const whole = h("img", { alt: `Image of ${last.camera.replaceAll("_", " ")} after the move`, src: path });
    whole.addEventListener("error", () => put(frame, h("p", { class: "quiet" }, "The image is not kept any more.")));
    whole.addEventListener("load", async () => { if (last.residual_px && last.aim_px) frame.append(await residualPicture(path, last)); });
    frame.append(h("a", { href: path, target: "_blank", rel: "noopener" }, whole));
    place.append(frame);
  }
}

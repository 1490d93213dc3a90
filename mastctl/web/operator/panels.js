// The quiet panels: faults, recording, mast file, residuals, operations, track, simulated faults.
import { byId, h, put, s, say } from "./dom.js";
import { ask, fileOf, get, post } from "./api.js";
import { camera as called, deg, forTime, metres, moment, number, sentence } from "./words.js";

const NAMES = { point: "Point", track: "Track", look: "Look", jog: "Jog" };

/** A fault's message without the device's name, which stands before it. */
const plain = ({ device, message }) => (message.startsWith(`${device}: `) ? message.slice(device.length + 2) : message).replace(/\.$/, "");

export class Faults {
  constructor(events, alarm) {
    this.list = byId("faults");
    this.faults = new Map();
    this.alarm = alarm;
    events.addEventListener("fault", (event) => this.told(event.detail.key, event.detail.value));
    events.addEventListener("connected", () => { this.faults.clear(); this.draw(); });
  }

  told(device, faults) {
    const before = (this.faults.get(device) ?? []).map((one) => one.code).join();
    this.faults.set(device, faults);
    if (faults.length && faults.map((one) => one.code).join() !== before) this.alarm(`${called(device)}: ${plain(faults[0])}, until ${faults[0].until}`);
    this.draw();
  }

  draw() {
    put(this.list, [...this.faults].flatMap(([device, faults]) => faults.map((fault) =>
      h("li", {}, h("strong", {}, called(device)), ` ${sentence(plain(fault))}. `, h("span", { class: "until" }, `Clears when ${fault.until}.`)))));
  }
}

export class Recording {
  constructor(alarm) {
    this.alarm = alarm;
    byId("record").addEventListener("click", () => this.press());
    setInterval(() => this.look(), 15000);
  }

  allow(may) {
    this.may = may;
    byId("record").disabled = !may;
  }

  async look() {
    if (document.hidden) return;
    try {
      const { recorder, free_mb: free } = await get("/recordings");
      this.told(recorder, free);
    } catch {
      say(byId("recording"), "not known");
    }
  }

  told(recorder, free) {
    this.run = recorder.run;
    const what = recorder.run ? `run ${recorder.run}` : recorder.recording ? `last ${forTime(recorder.ring_s)}` : "off";
    const space = free === null ? "" : `, ${number(free / 1000, 1)} GB free`;
    say(byId("recording"), recorder.fault ? `fault: ${recorder.fault}` : what + space);
    byId("recording").parentElement.dataset.on = recorder.recording;
    say(byId("record"), recorder.run ? "End run" : "Record");
  }

  async press() {
    try {
      await post(this.run ? "/recordings/stop" : "/recordings/start", {});
    } catch (error) {
      this.alarm(error.message);
    }
    this.look();
  }
}

export class MastFile {
  constructor(alarm) {
    this.alarm = alarm;
    this.choice = h("select", { "aria-label": "Mast file" });
    this.use = h("button", { type: "button", onclick: () => this.load(() => post("/mast", { file: this.choice.value })) }, "Use");
    this.back = h("button", { type: "button", onclick: () => this.load(() => post("/mast/back", {})) }, "Go back");
    this.facts = h("table", { class: "figures" });
    this.said = h("p", { class: "bad", role: "alert" });
    this.drift = h("p", { id: "drift" });
    setInterval(() => this.look(), 60000);
    put(byId("mast-file"), this.facts, this.drift, h("div", { class: "buttons" }, this.choice, this.use, this.back), this.said);
  }

  /** What the drift sentinel has found. */
  async look() {
    if (document.hidden) return;
    try {
      const found = await get("/sentinel");
      const age = found.last_look === null ? "" : found.age_s === null ? " Last look: at an unknown time." : ` Last look ${forTime(found.age_s)} ago.`;
      this.drift.className = { good: "", bad: "bad", unsure: "warn", none: "quiet" }[found.level];
      say(this.drift, `Drift sentinel: ${found.sentence}.${age}`);
    } catch (error) {
      say(this.drift, `Drift sentinel: ${error.message}`);
    }
  }

  told(status, rig) {
    const { mast, former_mast: former, calibration } = status;
    const verdict = calibration ? { good: "holds", drifts: "drifts", few: "too few pointings yet", unknown: "not known" }[calibration.verdict] : "not known";
    const [made, from] = rig.made ? [String(rig.made), "as the file says"] : rig.written_s ? [moment(rig.written_s), "the file's own time; it says no date"] : ["", "no date is known"];
    byId("mast").replaceChildren(mast.file, h("span", { class: "verdict", title: from }, made ? `${rig.made ? "made" : "file of"} ${made.slice(0, 10)}` : "no date"), h("span", { class: `verdict ${calibration?.verdict ?? ""}` }, verdict));
    const row = (name, value) => h("tr", {}, h("th", { scope: "row" }, name), h("td", {}, value));
    put(this.facts, row("In use", `${mast.file} (${mast.name})`), row(rig.made ? "Made" : "Written", made ? `${made}, ${from}` : from), row("Digest", h("code", {}, mast.digest.slice(0, 12))),
      row("Calibration", sentence(calibration?.sentence) || "No verdict"), former ? row("Before it", former.file) : null);
    put(this.choice, rig.mast_files.map((name) => h("option", { value: name, selected: name === mast.file }, name)));
    this.back.hidden = !former;
  }

  allow(may) {
    for (const one of [this.choice, this.use, this.back]) one.disabled = !may;
  }

  async load(act) {
    say(this.said, "");
    try {
      await act();
    } catch (error) {
      say(this.said, error.message);
    }
  }
}

export class Residuals {
  constructor() {
    this.plot = s("svg", { class: "scatter", viewBox: "0 0 260 200", role: "img" });
    this.table = h("details", {}, h("summary", {}, "As a table"), h("table", { class: "figures" }));
    this.words = h("p", { class: "quiet" });
    put(byId("residuals"), this.plot, this.words, this.table);
  }

  async look() {
    try {
      this.told(await get("/calibration/health"));
    } catch (error) {
      say(this.words, error.message);
    }
  }

  told(health) {
    const all = health.newest.slice(0, 40);
    const reach = [0.1, 0.25, 0.5, 1, 2, 5, 10, 50].find((one) => all.every(({ residual_px: [x, y], match_sigma_px: [sx, sy] }) => Math.hypot(Math.abs(x) + sx, Math.abs(y) + sy) <= one)) ?? 200;
    const [cx, cy, r] = [130, 98, 86];
    const at = (value) => (value * r) / reach;
    put(this.plot,
      [1, 0.5].map((part) => s("circle", { class: "ring", cx, cy, r: r * part })),
      s("path", { class: "ring", d: `M${cx - r} ${cy}H${cx + r}M${cx} ${cy - r}V${cy + r}` }),
      s("text", { class: "tickname start", x: cx + r + 4, y: cy + 3 }, `${reach} px`),
      all.map((one, k) => s("g", { opacity: 1 - (0.7 * k) / Math.max(1, all.length) },
        s("ellipse", { class: "sigma", cx: cx + at(one.residual_px[0]), cy: cy + at(one.residual_px[1]), rx: Math.max(1, at(one.match_sigma_px[0])), ry: Math.max(1, at(one.match_sigma_px[1])) }),
        s("circle", { class: k === 0 ? "tip newest" : "tip", cx: cx + at(one.residual_px[0]), cy: cy + at(one.residual_px[1]), r: k === 0 ? 3.5 : 2.2 }))));
    this.plot.setAttribute("aria-label", `${all.length} newest residuals, all within ${reach} px`);
    say(this.words, all.length ? sentence(health.sentence) : "No pointing has been measured yet.");
    put(this.table.lastChild, h("tr", {}, ["camera", "x px", "y px", "range"].map((name) => h("th", { scope: "col" }, name))),
      all.map((one) => h("tr", {}, h("td", {}, called(one.camera)), h("td", { class: "n" }, number(one.residual_px[0], 3, true)), h("td", { class: "n" }, number(one.residual_px[1], 3, true)), h("td", { class: "n" }, metres(one.range_m, 2)))));
  }
}

export class OperationList {
  constructor(events) {
    this.records = new Map();
    events.addEventListener("operation", (event) => this.told(event.detail.value));
    events.addEventListener("connected", () => this.records.clear());
  }

  told(record) {
    this.records.delete(record.id);
    this.records.set(record.id, record);
    if (!this.drawing) this.drawing = setTimeout(() => this.draw(), 200);
  }

  /** The image after the move, for as long as the daemon keeps it. */
  picture(pointing) {
    if (!pointing?.frame_id) return null;
    const path = fileOf(`/snapshot/${encodeURIComponent(pointing.camera)}?format=png&frame_id=${encodeURIComponent(pointing.frame_id)}`);
    return [" ", h("a", { class: "save", href: path, target: "_blank" }, "image")];
  }

  draw() {
    this.drawing = null;
    const newest = [...this.records.values()].sort((a, b) => b.created_s - a.created_s).slice(0, 8);
    put(byId("operations"), newest.length ? h("table", { class: "figures list" }, newest.map((record) => {
      const [what] = Object.keys(record.request ?? {});
      const name = { pixel: "Point at a pixel", position_m: "Point at a position", pan_rad: "Turn to angles", track: "Begin a track", jog: "Jog", look: "Look for the track" }[what] ?? NAMES[what] ?? what ?? "";
      const result = record.residual_px ? record.residual_px.map((one) => number(one, 2, true)).join(", ") + " px" : record.error ? record.error.message : "";
      return h("tr", {}, h("td", { class: `word ${record.state}` }, record.state), h("td", {}, name), h("td", { class: "result" }, result, this.picture(record.pointings?.at(-1))));
    })) : h("p", { class: "quiet" }, "None yet."));
  }
}

export class TrackPanel {
  constructor(events, views, say) {
    this.say = say;
    this.views = views;
    this.place = byId("track");
    events.addEventListener("track", (event) => this.told(event.detail.value));
    this.said = "";
    this.trail = [];
  }

  allow(may) {
    this.may = may;
    if (this.status) this.draw();
  }

  async begin(eye, pixel, facts) {
    this.said = "";
    if (!this.may) this.said = "You may look. To follow a target, log in with a token of the role operate.";
    else if (!facts || eye.isStale) this.said = "The image is not of now, so nothing in it can be followed.";
    else {
      try {
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
    if (status.id !== this.status?.id) this.trail = [];
    this.status = status;
    if (status.range_m !== null && !status.predicted && status.looks !== this.trail.at(-1)?.look) this.trail = [...this.trail.slice(-199), { look: status.looks, range: status.range_m, pair: status.pair, sigma: status.covariance_m2 ? Math.sqrt(status.covariance_m2[0][0] + status.covariance_m2[1][1] + status.covariance_m2[2][2]) : null }];
    this.draw();
  }

  draw() {
    const status = this.status;
    const on = status && ["starting", "tracking"].includes(status.state);
    const hint = h("p", { class: "quiet" }, "Drag a box round a target, or press T at the cross-hair.");
    const said = this.said ? h("p", { class: "bad" }, this.said) : null;
    const row = (name, value) => h("tr", {}, h("th", { scope: "row" }, name), h("td", { class: "n" }, value));
    const pose = status?.pose;
    const stands = pose ? row("Rover at", `${number(pose.position_m[0], 2, true)}, ${number(pose.position_m[1], 2, true)} m, heading ${deg(2 * Math.atan2(pose.quaternion[3], pose.quaternion[0]), 1)}`) : null;
    if (!status || status.state === "idle") return put(this.place, hint, stands ? h("table", { class: "figures" }, stands) : null, said);
    put(this.place,
      h("p", {}, h("strong", { class: `word ${status.state}` }, status.state), " ", status.reason),
      h("table", { class: "figures" },
        status.pair ? row("Seen by", called(status.pair)) : null,
        status.range_m !== null ? row("Range", metres(status.range_m) + (status.predicted ? " (carried over)" : "")) : null,
        Object.entries(status.pixels ?? {}).map(([name, eye]) => row(called(name), eye.x_px === null ? eye.verdict : `${number(eye.x_px, 1)}, ${number(eye.y_px, 1)} px, ${eye.verdict}`)),
        row("Looks, misses", `${status.looks}, ${status.misses}`),
        status.handoffs.length ? row("Hand-offs", status.handoffs.map((one) => `${one.from_pair} → ${one.to_pair} at ${metres(one.range_m, 2)}`).join("; ")) : null,
        stands),
      this.plot(),
      this.errors(),
      said,
      this.may ? h("div", { class: "buttons" }, h("button", { type: "button", disabled: !on, onclick: () => this.act("/track/look") }, "Look again"), h("button", { type: "button", disabled: !on, onclick: () => this.act("/track/stop") }, "End the track")) : null,
      on ? null : hint);
  }

  /** The approach: range of each look. */
  plot() {
    const { trail } = this;
    if (trail.length < 2) return null;
    const caption = h("p", { class: "quiet" }, "Range, m, look by look");
    const top = Math.max(...trail.map((one) => one.range)) * 1.1;
    const [width, height] = [260, 80];
    const x = (k) => 30 + ((width - 36) * k) / (trail.length - 1);
    const y = (range) => height - 12 - ((height - 20) * range) / top;
    return [caption, s("svg", { class: "approach", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `Range over ${trail.length} looks, now ${metres(trail.at(-1).range)}` },
      s("path", { class: "ring", d: `M30 ${height - 12}H${width}M30 4V${height - 12}` }),
      s("polyline", { class: "line", points: trail.map((one, k) => `${x(k)},${y(one.range)}`).join(" ") }),
      trail.map((one, k) => (k && one.pair !== trail[k - 1].pair ? s("path", { class: "handoff", d: `M${x(k)} 4V${height - 12}` }) : null)),
      s("text", { class: "tickname end", x: 27, y: 10 }, number(top, 1)), s("text", { class: "tickname end", x: 27, y: height - 10 }, "0 m"))];
  }

  /** The approach: how well the place was known, one sigma, against range; nearer is to the right. */
  errors() {
    const known = this.trail.filter((one) => one.sigma !== null);
    if (known.length < 2) return null;
    const far = Math.max(...known.map((one) => one.range));
    const near = Math.min(...known.map((one) => one.range));
    const top = 1.1 * Math.max(...known.map((one) => one.sigma));
    const [width, height] = [260, 92];
    const x = (range) => 38 + (width - 50) * (far > near ? (far - range) / (far - near) : 0.5);
    const y = (sigma) => height - 24 - ((height - 32) * sigma) / top;
    const last = known.at(-1);
    return [h("p", { class: "quiet" }, "One sigma of its place, mm, against range"),
      s("svg", { class: "approach errors", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `One sigma of the place against range, now ${number(1000 * last.sigma, 1)} mm at ${metres(last.range)}` },
        s("path", { class: "ring", d: `M38 ${height - 24}H${width - 6}M38 4V${height - 24}` }),
        known.map((one) => s("circle", { class: one === last ? "tip newest" : "tip", cx: x(one.range), cy: y(one.sigma), r: one === last ? 3.5 : 2.2 }, s("title", {}, `${called(one.pair ?? "")} ${metres(one.range)}: ${number(1000 * one.sigma, 1)} mm`))),
        s("text", { class: "tickname end", x: 35, y: 12 }, number(1000 * top, 1)), s("text", { class: "tickname end", x: 35, y: height - 21 }, "0"),
        s("text", { class: "tickname start", x: 38, y: height - 10 }, metres(far, 1)), s("text", { class: "tickname end", x: width - 8, y: height - 10 }, metres(near, 1)))];
  }
}

const WORDS = ["off", "stuck", "frozen", "garbage", "wrong", "slow", "delayed", "intermittent", "dark", "dropped"];

export class Simulation {
  constructor() {
    this.device = h("select", { "aria-label": "Device" });
    this.word = h("select", { "aria-label": "Fault" }, WORDS.map((word) => h("option", {}, word)));
    this.list = h("ul", { class: "set" });
    this.said = h("p", { class: "bad", role: "alert" });
    this.rover = h("p", { class: "quiet" });
    this.set = h("button", { type: "button", onclick: () => this.act(() => post("/simulation/faults", { device: this.device.value, word: this.word.value })) }, "Set");
    this.clear = h("button", { type: "button", onclick: () => this.act(() => ask("DELETE", "/simulation/faults")) }, "Clear all");
    this.drive = h("div", { class: "buttons" }, [["Ahead 0.25 m", 0.25, 0], ["Back 0.25 m", -0.25, 0], ["Turn left 5°", 0, -0.0873], ["Turn right 5°", 0, 0.0873]].map(([words, ahead, turn]) =>
      h("button", { type: "button", onclick: () => this.act(() => this.stand(ahead, turn)) }, words)));
    put(byId("simulated"), h("div", { class: "buttons" }, this.device, this.word, this.set, this.clear), this.list, this.said, h("h3", {}, "Drive the simulated rover"), this.drive, this.rover);
  }

  use(status) {
    byId("simulation").hidden = !status.simulated;
    if (!status.simulated) return;
    const devices = ["pan_tilt", ...Object.keys(status.cameras)];
    if (this.device.children.length !== devices.length) put(this.device, devices.map((name) => h("option", { value: name }, called(name))));
    this.look();
  }

  allow(may) {
    for (const one of [this.device, this.word, this.set, this.clear, ...this.drive.children]) one.disabled = !may;
  }

  async act(work) {
    say(this.said, "");
    try {
      await work();
    } catch (error) {
      say(this.said, error.message);
    }
    this.look();
  }

  async look() {
    try {
      const { faults } = await get("/simulation/faults");
      put(this.list, faults.map((one) => h("li", {}, `${called(one.device)}: ${one.word}`)));
    } catch {
      // no simulated rover
    }
  }

  /** Drive a little way, and tell the daemon where the rover truly stands, as an odometer would. */
  async stand(ahead, turn) {
    const now = await get("/simulation/pose");
    const [w, , , z] = now.quaternion;
    const heading = 2 * Math.atan2(z, w);
    const place = { x_m: now.position_m[0] + ahead * Math.cos(heading), y_m: now.position_m[1] + ahead * Math.sin(heading), heading_rad: heading + turn };
    const pose = await post("/simulation/pose", place);
    await post("/pose", { position_m: pose.position_m, quaternion: pose.quaternion, sigma: { position_m: 0.01, rotation_rad: 0.009 } });
    say(this.rover, `The rover stands at ${number(place.x_m, 2, true)}, ${number(place.y_m, 2, true)} m, heading ${deg(place.heading_rad, 1)}.`);
  }
}

// The quiet panels: faults, recording, mast file.
import { byId, h, keep, kept, put, say, set } from "./dom.js";
import { ask, fileOf, get, post } from "./api.js";
import { camera as called, forTime, inDegrees, number, sentence } from "./words.js";

const READ = "mastctl read";

/** A fault's message without the device's name, which stands before it. */
const plain = ({ device, message: told }, message = inDegrees(told)) => (message.startsWith(`${device}: `) ? message.slice(device.length + 2) : message).replace(/\.$/, "");

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

/** Why a move failed, an alarm until somebody has read it: the daemon itself is ready for the next. */
export class Failure {
  constructor(events, announce) {
    [this.events, this.announce] = [events, announce];
    this.words = h("span");
    put(byId("failed"), h("button", { type: "button", onclick: () => this.read() }, "Read"), this.words);
    events.addEventListener("connected", () => { [this.newestS, this.sinceS] = [-Infinity, Infinity]; });
    events.addEventListener("joints", ({ detail: { value } }) => { this.sinceS = Math.min(this.sinceS, value.measured_s + value.age_s); });
    events.addEventListener("operation", (event) => this.told(event.detail.value));
  }

  told(record) {
    const newest = record.created_s >= this.newestS;
    if (newest) this.newestS = record.created_s;
    if (record.state === "failed" && (newest || record.ended_s > this.sinceS) && !this.ofBench()) this.show(record);
    else if (newest && !(this.endedS > this.sinceS)) this.hide(); // it failed before anybody looked here, and others went well since
  }

  /** It takes another attitude where one cannot be reached, and says why itself. */
  ofBench() {
    return ["running", "asking"].includes(this.events.newest("bench", "run")?.state);
  }

  show({ id, error, ended_s: endedS }) {
    if (kept(READ) === id) return;
    [this.id, this.endedS] = [id, endedS];
    say(this.words, `Failed: ${error ? inDegrees(error.message) : "the daemon told no reason"}`);
    byId("failed").hidden = false;
    this.announce(this.words.textContent);
  }

  hide() {
    byId("failed").hidden = true;
  }

  read() {
    keep(READ, this.id);
    this.hide();
  }
}

export class Recording {
  constructor(alarm) {
    this.alarm = alarm;
    byId("record").addEventListener("click", () => this.press());
    setInterval(() => this.look(), 15000);
  }

  allow(may, role) {
    byId("record").disabled = !may;
    this.deletes = role === "admin";
  }

  async look() {
    if (document.hidden) return;
    try {
      const { recorder, free_mb: free, recordings } = await get("/recordings");
      this.told(recorder, free);
      this.list(recordings, recorder);
    } catch {
      say(byId("recording"), "not known");
    }
  }

  told(recorder, free) {
    this.run = recorder.run;
    const what = recorder.run ? `run ${recorder.run}` : recorder.recording ? `last ${forTime(recorder.ring_s)}` : "off";
    const space = free === null ? "" : `, ${number(free / 1000, 1)} GB free`;
    say(byId("recording"), recorder.fault ? `fault: ${recorder.fault}` : what + space);
    set(byId("recording"), "title", byId("recording").textContent);
    byId("recording").parentElement.dataset.on = recorder.recording;
    say(byId("record"), recorder.run ? "End run" : "Record");
  }

  /** What is kept on the daemon's disk, the newest first: each file can be had; what can be deleted wants two presses. */
  list(recordings, recorder) {
    this.all = [recordings, recorder];
    const drawn = JSON.stringify([recordings.map((one) => [one.name, one.names, one.kind === "ring" || one.size_mb]), recorder.file, this.sure, this.deletes]);
    if (drawn === this.drawn) return;
    this.drawn = drawn;
    const kinds = { run: "run", kept: "kept at a fault", ring: "the newest minutes" };
    put(byId("recordings"), recordings.length ? h("table", { class: "figures list" }, recordings.toReversed().map((one) => h("tr", {},
      h("td", {}, one.kind === "run" ? null : h("div", {}, one.name), one.names.map((file) => h("div", {}, file === recorder.file ? `${file}, being written` : h("a", { class: "save", href: fileOf(`/recordings/${encodeURIComponent(one.name)}/${encodeURIComponent(file)}`), download: file }, file)))),
      h("td", { class: "words" }, kinds[one.kind]), h("td", { class: "n" }, `${number(one.size_mb, 1)} MB`),
      h("td", { class: "n" }, !this.deletes || one.kind === "ring" || one.names.includes(recorder.file) ? null : this.remover(one.name)))))
      : h("p", { class: "quiet" }, `None yet. They lie in ${recorder.folder}.`));
  }

  remover(name) {
    const words = this.sure === name ? "Really delete" : "Delete";
    return h("button", { type: "button", class: "quiet", "aria-label": `${words} ${name}`, onclick: () => this.remove(name) }, words);
  }

  async remove(name) {
    if (this.sure !== name) {
      this.sure = name;
      setTimeout(() => { if (this.sure === name) { this.sure = null; this.list(...this.all); } }, 5000);
      return this.list(...this.all);
    }
    this.sure = null;
    try {
      await ask("DELETE", `/recordings/${encodeURIComponent(name)}`);
    } catch (error) {
      this.alarm(error.message);
    }
    this.look();
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
    put(byId("mast-file"), this.facts, this.drift, h("div", { class: "buttons" }, this.choice, this.use, this.back), this.said);
  }

  told(status, rig) {
    const { mast, former_mast: former, calibration, sentinel } = status;
    this.drift.className = { good: "", bad: "bad", unsure: "warn", none: "quiet" }[sentinel.level];
    say(this.drift, `Drift sentinel: ${sentinel.sentence}.`);
    const verdict = calibration ? { good: "holds", drifts: "drifts", few: "too few pointings yet", unknown: "not known" }[calibration.verdict] : "not known";
    const [made, from] = rig.mast_date ? [String(rig.mast_date), "as the file says"] : ["", "the file says no date"];
    put(byId("mast"), h("span", { class: "name", title: mast.file }, mast.file), h("span", { class: "verdict" }, h("span", { title: from }, made ? `made ${made.slice(0, 10)}` : "no date"), ", ", h("span", { class: calibration?.verdict ?? "" }, verdict)));
    const row = (name, value) => h("tr", {}, h("th", { scope: "row" }, name), h("td", {}, value));
    put(this.facts, row("In use", `${mast.file} (${mast.name})`), row("Made", made ? `${made}, ${from}` : from), row("Digest", h("code", {}, mast.digest.slice(0, 12))),
      row("Calibration", sentence(calibration?.sentence) || "No verdict"), former ? row("Before it", former.file) : null);
    const offered = [mast.file, ...rig.mast_files].join();
    if (offered !== this.offered) put(this.choice, rig.mast_files.map((name) => h("option", { value: name, selected: name === mast.file }, name)));
    this.offered = offered; // what somebody is choosing stays chosen
    this.back.hidden = !former;
    if (former) say(this.back, `Go back to ${former.file}`);
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

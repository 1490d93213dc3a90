// A bench calibration, step by step: where the board goes, how far it is, and what came of it.
import { byId, h, put, say } from "./dom.js";
import { ask, fileOf, get, held, post } from "./api.js";
import { camera as called, deg, number, sentence } from "./words.js";
import { asSeen, coverage, curve, fromAbove } from "./bench_drawn.js";

const STEPS = [["place", "Place the board"], ["search", "Look for it"], ["pictures", "Take pictures"], ["check", "Check"], ["fit", "Fit"], ["over", "Verdict"]];
const GRADES = { good: "good", care: "warn", bad: "bad" };
const px = (value) => (value === null || value === undefined ? "–" : `${number(value, value < 10 ? 2 : 0)} px`);
const short = (value) => (value === null || value === undefined ? "–" : number(value, 3));
const two = (pair) => (pair ? pair.map((one) => number(one, 3)).join(", ") : "–");
const paper = (name) => (name.startsWith("charuco_") ? `ChArUco, ${name.slice(8).toUpperCase()} paper, as drawn` : name.replaceAll("_", " "));
const clock = (iso) => iso.slice(0, 16).replace("T", " ");

export class Bench {
  constructor(events, speak) {
    this.speak = speak;
    this.kept = [];
    this.build();
    this.heard = 0; // what is pushed is newer than any answer that was under way meanwhile
    events.addEventListener("bench", (event) => { this.heard += 1; this.update(event.detail.value); });
    events.addEventListener("connected", () => this.look());
    events.addEventListener("mast", (event) => { this.inUse = event.detail.value.file; this.later(); });
  }

  build() {
    const button = (words, act, name = null) => h("button", { type: "button", class: name, onclick: act }, words);
    this.steps = h("ol", { class: "bench-steps", "aria-label": "Steps" });
    this.words = h("p", { class: "bench-words" });
    this.where = h("div", { class: "sketches" });
    this.stands = button("It stands", () => this.act(() => post("/bench/stands", {})), "go stands");
    this.leave = button("End it for now", () => this.act(() => post("/bench/leave", {})));
    this.goOn = button("Go on", () => this.begin({ resume: this.run.name }), "go");
    this.fresh = button("Begin another …", () => { this.closed = this.run?.name; this.anew.open = true; this.draw(); });
    this.place = h("div", { class: "bench-place" }, h("h3", {}, "Where the board goes"), this.words, this.where, this.stands);
    this.seen = h("div", { class: "coverages" });
    this.cover = h("div", {}, h("h3", {}, "Seen so far"), this.seen);
    this.plot = h("div");
    this.facts = h("table", { class: "figures" });
    this.table = h("details", {}, h("summary", {}, "As a table"), h("table", { class: "figures" }));
    this.error = h("div", {}, h("h3", {}, "Predicted error of a first pointing"), this.plot, this.facts, this.table);
    this.verdict = h("div", { class: "bench-verdict" });
    this.log = h("ul", { class: "bench-log", "aria-label": "What it said last" });
    this.next = h("p", { class: "bench-next" });
    this.now = h("div", { class: "bench-now" }, this.steps, this.verdict, this.next, h("div", { class: "buttons" }, this.goOn, this.fresh), h("div", { class: "bench-parts" }, this.place, h("div", { class: "bench-side" }, this.cover, this.error)), this.log, h("div", { class: "buttons" }, this.leave));
    this.said = h("p", { class: "bad", role: "alert" });
    this.buildForm();
    this.others = h("details", { class: "bench-runs" }, h("summary", {}, "Earlier runs"), h("table", { class: "figures list" }));
    this.anew = h("details", { class: "bench-new" }, h("summary", {}, "Begin a bench calibration …"), this.form);
    put(byId("bench"), this.anew, this.now, this.said, this.others);
    this.now.hidden = true;
  }

  buildForm() {
    this.board = h("select", { onchange: () => this.draw() });
    this.file = h("input", { type: "file", accept: ".yaml,.yml" });
    this.fileRow = h("label", {}, "BOARD.yaml ", this.file);
    this.wanted = h("input", { type: "number", min: "0.01", max: "20", step: "any", value: "0.2", required: true });
    this.pictures = h("input", { type: "number", min: "12", max: "500", step: "1", value: "60", required: true });
    this.hand = h("input", { type: "checkbox" });
    this.handRow = h("label", { class: "check" }, this.hand, " I place the simulated board, by the button");
    this.start = h("button", { type: "submit", class: "go" }, "Begin");
    this.form = h("form", { class: "bench-form", onsubmit: (event) => { event.preventDefault(); this.submit(); } },
      h("p", { class: "quiet" }, "A new mast file from pictures of one printed board: the head looks for it and turns by itself, and asks for two to four placements. STOP ends it at any moment; nothing that was seen is lost."),
      h("div", { class: "bench-fields" }, h("label", {}, "Board ", this.board), this.fileRow, h("label", {}, "Wanted, px rms ", this.wanted), h("label", {}, "Pictures a camera, at most ", this.pictures)),
      this.handRow, h("div", { class: "buttons" }, this.start));
  }

  allow(may) {
    this.may = may;
    this.draw();
  }

  async look() {
    const { heard } = this;
    try {
      const kept = await get("/bench");
      [this.kept, this.simulated, this.folder] = [kept.runs, kept.simulated, kept.folder];
      if (this.board.options.length !== kept.boards.length + 1) put(this.board, kept.boards.map((name) => h("option", { value: name }, paper(name))), h("option", { value: "" }, "another: its BOARD.yaml …"));
      if (!this.known) { this.known = true; this.board.value = this.simulated && kept.boards.includes("charuco_a2") ? "charuco_a2" : ""; }
      if (heard === this.heard) this.run = kept.run; // null after a restart of the daemon
      this.later();
    } catch (error) {
      say(this.said, error.message);
    }
  }

  update(run) {
    const before = this.run;
    this.run = run;
    if (run.name !== before?.name || run.state !== before.state || run.requested?.name !== before.requested?.name) {
      if (run.state === "waiting") this.speak(`Put the board ${run.requested.description}. Then press It stands.`);
      else if (run.state === "done") this.speak(`Bench calibration: ${run.sentence}.`);
      else if (run.state === "interrupted") this.speak(`Bench calibration interrupted: ${run.sentence}.`, run.code !== "left");
      if (["done", "interrupted"].includes(run.state)) this.look();
    }
    if (run.state === "running" && before?.name !== run.name) this.look();
    this.later();
  }

  async submit() {
    const wanted = { wanted_px: Number(this.wanted.value), pictures: Number(this.pictures.value) };
    if (this.simulated) wanted.by_hand = this.hand.checked;
    if (this.board.value) return this.begin({ board: this.board.value, ...wanted });
    const [file] = this.file.files;
    if (!file) return say(this.said, "Choose the board's BOARD.yaml, which 'mastctl board make' wrote beside the print.");
    return this.begin({ board_file: await file.text(), ...wanted });
  }

  begin(body) {
    return this.act(async () => {
      const { heard } = this;
      const { run } = await post("/bench", body);
      held.lease = null; // it steers from now on
      this.closed = null;
      if (heard === this.heard) this.update(run);
    });
  }

  async act(work) {
    say(this.said, "");
    this.busy = true;
    this.draw();
    try {
      await work();
    } catch (error) {
      say(this.said, error.message);
    }
    this.busy = false;
    this.draw();
  }

  /** Several events in a row are drawn once. */
  later() {
    this.drawing ??= setTimeout(() => { this.drawing = null; this.draw(); }, 120);
  }

  draw() {
    const { run, may } = this;
    const over = run && ["done", "interrupted"].includes(run.state);
    const shown = run && this.closed !== run.name;
    const going = run && !over;
    this.anew.hidden = Boolean(shown);
    this.now.hidden = !shown;
    this.fileRow.hidden = this.board.value !== "";
    this.handRow.hidden = !this.simulated;
    for (const one of [this.start, this.goOn, this.leave]) one.disabled = !may || this.busy;
    this.start.disabled ||= Boolean(going);
    this.drawOthers(going);
    if (!shown) return;
    this.goOn.hidden = this.next.hidden = run.state !== "interrupted";
    say(this.next, `Its pictures are kept in ${this.folder ?? ""}/${run.name}: ${run.pictures} pictures a camera. ${this.may ? "" : "A client with the role operate chooses: "}Go on continues from there, with the board where it stands; Begin another starts anew.`);
    this.leave.hidden = over;
    this.fresh.hidden = !over;
    this.drawSteps(run);
    this.drawPlace(run);
    put(this.seen, Object.entries(run.cameras).map(([name, image]) => coverage(name, image)));
    this.cover.hidden = !Object.keys(run.cameras).length;
    this.drawError(run);
    this.drawVerdict(run);
    put(this.log, run.sentences.slice(-6).map((words) => h("li", {}, sentence(words))));
  }

  drawSteps(run) {
    this.steps.hidden = run.state === "interrupted"; // it has left out those before the verdict
    const at = run.step === "begin" ? -1 : STEPS.findIndex(([name]) => name === run.step);
    put(this.steps, STEPS.map(([name, words], k) => h("li", { "aria-current": k === at ? "step" : null, class: k < at ? "past" : null },
      words, name === "place" && run.placements ? ` (${run.placements} of 2 to 4)` : name === "pictures" && run.pictures ? ` (${run.pictures})` : "")));
  }

  drawPlace(run) {
    const { requested } = run;
    const waiting = run.state === "waiting";
    this.place.dataset.waiting = waiting;
    this.place.hidden = run.step === "over" || (!requested && run.step !== "begin");
    this.stands.hidden = !waiting;
    this.stands.disabled = !this.may || this.busy;
    say(this.words, !requested ? "The calibration program starts …" : `${waiting ? `Placement ${requested.name}: put the board ` : `Placement ${requested.name}: `}${requested.description}.${waiting ? " It need not be exact. Lean it against something that does not move." : ""}`);
    const key = requested && JSON.stringify([requested, run.board_m]);
    if (key === this.sketched) return;
    this.sketched = key;
    const size = run.board_m ?? [0.5, 0.35];
    put(this.where, requested ? [h("figure", {}, fromAbove(requested, size), h("figcaption", {}, "From above")), h("figure", {}, asSeen(requested, size), h("figcaption", {}, "As the head sees it, pan 0, tilt 0"))] : []);
  }

  drawError(run) {
    const row = (name, value) => h("tr", {}, h("th", { scope: "row" }, name), h("td", { class: "n" }, value));
    this.error.hidden = !run.curve.length;
    put(this.plot, curve(run));
    const next = run.next_rad && !["done", "interrupted"].includes(run.state) ? row("Most helps now", `pan ${deg(run.next_rad[0], 0)}, tilt ${deg(run.next_rad[1], 0)}: to ${px(run.expected_px)}`) : null;
    put(this.facts, row("Now, wanted", `${px(run.predicted_px)}, ${px(run.target_px)}`), row("Counts alone leave", px(run.counts_px)), row("Pictures a camera", ["done", "interrupted"].includes(run.state) ? String(run.pictures) : `${run.pictures} of ${run.most} at most`), next);
    put(this.table.lastChild, h("tr", {}, h("th", { scope: "col" }, "pictures"), h("th", { scope: "col" }, "predicted, px")), run.curve.map(([k, value]) => h("tr", {}, h("td", { class: "n" }, k), h("td", { class: "n" }, number(value, 3)))));
  }

  drawVerdict(run) {
    this.verdict.hidden = !["done", "interrupted"].includes(run.state);
    if (run.state === "interrupted") return put(this.verdict, h("p", {}, h("strong", { class: "warn" }, "Interrupted. "), `${sentence(run.sentence)}.`));
    if (!run.result) return put(this.verdict);
    const { result } = run;
    const { check } = result;
    const cell = (value) => h("td", { class: "n" }, value);
    const head = (...names) => h("tr", {}, names.map((name) => h("th", { scope: "col" }, name)));
    const using = this.inUse === run.mast_file;
    return put(this.verdict,
      h("p", { class: `bench-grade ${GRADES[result.verdict.grade] ?? ""}` }, sentence(result.verdict.words)),
      h("ul", {}, result.verdict.reasons.map((reason) => h("li", {}, sentence(reason.sentence)))),
      h("table", { class: "figures residual-table" },
        head("rms x, y, px", "fitted", "not fitted", "promised"),
        Object.entries(result.rms_px).map(([name, rms]) => h("tr", {}, h("th", { scope: "row" }, called(name)), cell(two(rms)), cell(two(result.check_rms_px[name])), cell(short(check.promised_px[name])))),
        h("tr", {}, h("th", { scope: "row" }, `pointing at ${check.pointings.length} corners`), cell(""), cell(two(check.pointing_rms_px)), cell(short(check.pointing_promised_px)))),
      h("p", { class: "quiet" }, `A first pointing is left ${px(result.calibrated_px)} by the calibration, ${px(result.counts_px)} by the encoders' counts alone. ${result.placements} placements, ${result.pictures} pictures a camera.`),
      h("div", { class: "buttons" },
        h("button", { type: "button", class: "go", id: "bench-use", disabled: !this.may || using, onclick: () => this.use(run.mast_file) }, using ? "This mast file is in use" : "Use this mast file"),
        run.report ? this.link(run.report, "Read the report") : null),
      h("p", { class: "quiet" }, `${run.mast_file} lies beside the other mast files; "Go back" in the panel of the mast file takes it back.`));
  }

  link(name, words) {
    return h("a", { class: "report-link", href: fileOf(`/reports/${encodeURIComponent(name)}`), target: "_blank", rel: "noopener" }, words);
  }

  use(file) {
    return this.act(async () => {
      await post("/mast", { file });
      this.speak(`Mast file ${file} is in use.`);
    });
  }

  drawOthers(going) {
    const rows = this.kept.filter((one) => one.name !== this.run?.name || this.closed === one.name);
    this.others.hidden = !rows.length;
    const cut = !this.run && this.kept[0]?.state === "interrupted"; // by the end of its daemon: nothing else tells it
    if (cut && !this.cut) this.others.open = true;
    this.cut = cut;
    say(this.others.firstChild, cut ? "Earlier runs; the last was interrupted: go on with it, or begin another" : "Earlier runs");
    put(this.others.lastChild, rows.map((one) => h("tr", {},
      h("td", {}, clock(one.begun)), h("td", {}, one.board), h("td", { class: "n" }, `${one.pictures} pictures, ${number(one.size_mb, 0)} MB`),
      h("td", { class: one.grade ? GRADES[one.grade] : "" }, one.state === "done" ? "done" : sentence(one.sentence)),
      h("td", { class: "n" }, one.state === "interrupted" ? h("button", { type: "button", disabled: !this.may || going || this.busy, onclick: () => this.begin({ resume: one.name }) }, "Go on") : one.mast_file, one.report ? [" ", this.link(one.report, "report")] : null),
      h("td", {}, one.state === "running" ? null : this.remover(one)))));
  }

  remover({ name, begun }) {
    const words = this.sure === name ? "Really remove" : "Remove";
    return h("button", { type: "button", class: "quiet", disabled: !this.may || this.busy, "aria-label": `${words} the run of ${clock(begun)}`, onclick: () => this.forget(name) }, words);
  }

  /** A second press within some seconds removes a run; its mast file stays. */
  forget(name) {
    if (this.sure === name) {
      this.sure = null;
      return this.act(async () => { this.kept = (await ask("DELETE", `/bench/runs/${encodeURIComponent(name)}`)).runs; });
    }
    this.sure = name;
    this.draw();
    setTimeout(() => { if (this.sure === name) { this.sure = null; this.draw(); } }, 5000);
  }
}

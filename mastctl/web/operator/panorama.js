// A panorama as a strip: taken, seen closely, clicked; and the targets that are kept by a name.
import { byId, h, put, s, say, set } from "./dom.js";
import { ask, fileOf, get, post } from "./api.js";
import { camera as called, degrees, figure, inDegrees, number, sentence } from "./words.js";
import { cross } from "./eye.js";

const POLL_MS = 1000;
const ZOOM = 1.3;
const CLOSEST = 6; // screen pixels to one of the mosaic
const SHAKES_PX = 8; // of the screen: a hand that clicks moves by less
const EDGE_PX = 24; // so far from the border the cross-hair stays when keys move it
const TILT_DEG = [-40, 11]; // the daemon's own default

const clamp = (value, low, high) => Math.min(Math.max(value, low), Math.max(low, high));

/** A picture that is zoomed and moved, and marks that stay as large as they are. */
class Strip {
  constructor(choose) {
    this.choose = choose;
    this.pointers = new Map();
    this.svg = s("svg", { class: "over", "aria-hidden": "true" });
    this.where = h("span", { class: "where" });
    this.frame = h("div", {
      class: "pano-frame", tabindex: 0, role: "application", "aria-label": "Panorama: plus and minus zoom, arrow keys move the cross-hair, Home shows it whole, Enter chooses",
      onpointerdown: (event) => this.pressed(event), onpointermove: (event) => this.moved(event), onpointerup: (event) => this.released(event), onpointercancel: (event) => this.pointers.delete(event.pointerId),
      onkeydown: (event) => this.key(event), onblur: () => this.point(null),
    }, this.svg, this.where);
    this.frame.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    const zooms = [["+", "Zoom in", () => this.zoom(ZOOM)], ["−", "Zoom out", () => this.zoom(1 / ZOOM)], ["Whole", "Show the whole panorama", () => this.home()]];
    this.buttons = zooms.map(([text, name, act]) => h("button", { type: "button", "aria-label": name, onclick: act }, text));
    this.marks = {};
    new ResizeObserver(() => this.home(this.isHome)).observe(this.frame);
  }

  /** Another picture; `fine` is one of all its pixels, fetched when somebody comes so close. */
  show(address, fine) {
    this.fine = fine;
    const image = this.image(address);
    image.addEventListener("load", () => { while (image.previousElementSibling?.matches("image")) image.previousElementSibling.remove(); });
  }

  image(href) {
    const image = s("image", { href, preserveAspectRatio: "none" });
    this.svg.prepend(...this.svg.querySelectorAll("image"), image);
    this.fit();
    return image;
  }

  size([width, height]) {
    if (this.width === width && this.height === height) return;
    [this.width, this.height] = [width, height];
    this.frame.style.setProperty("--ratio", width / height);
    this.home();
  }

  fit() {
    for (const image of this.svg.querySelectorAll("image")) for (const [name, value] of Object.entries({ x: -0.5, y: -0.5, width: this.width ?? 0, height: this.height ?? 0 })) image.setAttribute(name, value);
  }

  /** The whole of it, or what was shown before where the frame has another size. */
  home(whole = true) {
    if (!this.width) return;
    const { width, height } = this.frame.getBoundingClientRect();
    this.box = [Math.max(1, width), Math.max(1, height)];
    this.least = Math.min(this.box[0] / this.width, this.box[1] / this.height);
    if (whole) Object.assign(this, { scale: this.least, middle: [(this.width - 1) / 2, (this.height - 1) / 2] });
    this.fit();
    this.draw();
  }

  zoom(times, about = this.cursor ?? this.middle) {
    if (!this.width) return;
    const before = this.scale;
    this.scale = clamp(before * times, this.least, CLOSEST);
    this.middle = this.middle.map((value, k) => about[k] + ((value - about[k]) * before) / this.scale);
    this.draw();
  }

  draw() {
    const half = this.box.map((side) => side / this.scale / 2);
    this.middle = this.middle.map((value, k) => {
      const side = k ? this.height : this.width;
      return 2 * half[k] >= side ? (side - 1) / 2 : clamp(value, half[k] - 0.5, side - half[k] - 0.5);
    });
    const [x, y] = this.middle;
    this.svg.setAttribute("viewBox", `${x - half[0]} ${y - half[1]} ${2 * half[0]} ${2 * half[1]}`);
    this.isHome = this.scale <= this.least * 1.001;
    set(this.frame, "data-close", !this.isHome);
    for (const mark of this.svg.querySelectorAll("[data-at]")) mark.setAttribute("transform", `translate(${mark.dataset.at}) scale(${1 / this.scale})`);
    if (this.fine && this.scale > this.fine.from) {
      this.image(this.fine.address);
      this.fine = null;
    }
  }

  /** A cross of a kind with a name, or none. */
  mark(name, place, kind, text) {
    this.put(name, place && this.width ? s("g", { "data-at": place.join(" "), transform: `translate(${place.join(" ")}) scale(${1 / this.scale})` }, cross(0, 0, kind, 13), text ? s("text", { x: 9, y: -8 }, text) : null) : null);
  }

  put(name, mark) {
    this.marks[name]?.remove();
    this.marks[name] = mark;
    if (mark) this.svg.append(mark);
  }

  /** The pixel under a place of the screen. */
  pixel({ clientX, clientY }) {
    const box = this.frame.getBoundingClientRect();
    return [(clientX - box.left - box.width / 2) / this.scale + this.middle[0], (clientY - box.top - box.height / 2) / this.scale + this.middle[1]].map((value) => Math.round(value * 100) / 100);
  }

  point(pixel) {
    this.cursor = pixel;
    this.mark("cursor", pixel, "cursor");
    say(this.where, pixel ? `x ${number(pixel[0], 1)}  y ${number(pixel[1], 1)} px` : "");
  }

  wheel(event) {
    if (!this.width || (event.deltaY > 0 && this.isHome)) return; // the page goes on from there
    event.preventDefault();
    this.zoom(ZOOM ** (-event.deltaY / 100), this.pixel(event));
  }

  pressed(event) {
    if (event.button !== 0 || !this.width) return;
    this.frame.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, event);
    if (this.pointers.size === 1) this.from = event;
    else this.from = null; // two fingers choose nothing
  }

  /** One pointer draws the picture along, two spread it. */
  moved(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    if (this.from && Math.hypot(event.clientX - this.from.clientX, event.clientY - this.from.clientY) > SHAKES_PX) this.from = null;
    this.pointers.set(event.pointerId, event);
    const other = [...this.pointers.values()].find((one) => one.pointerId !== event.pointerId);
    const apart = (one) => Math.max(1, Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY));
    if (other) this.zoom(apart(event) / apart(before), this.pixel({ clientX: (event.clientX + other.clientX) / 2, clientY: (event.clientY + other.clientY) / 2 }));
    if (this.from || (this.isHome && !other)) return;
    const part = other ? 2 : 1; // the middle of two fingers moves by half
    this.middle = [this.middle[0] - (event.clientX - before.clientX) / this.scale / part, this.middle[1] - (event.clientY - before.clientY) / this.scale / part];
    this.draw();
  }

  released(event) {
    this.pointers.delete(event.pointerId);
    const { from } = this;
    this.from = null;
    if (!from) return;
    const pixel = this.pixel(event.pointerType === "touch" ? event : from);
    if ([this.width, this.height].every((side, k) => pixel[k] >= -0.5 && pixel[k] <= side - 0.5)) this.choose(pixel);
  }

  key(event) {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!this.width || event.ctrlKey || event.metaKey) return;
    if (way) this.step(way, (event.shiftKey ? 40 : event.altKey ? 0.5 : 4) / this.scale);
    else if (event.key === "+" || event.key === "=") this.zoom(ZOOM);
    else if (event.key === "-") this.zoom(1 / ZOOM);
    else if (event.key === "Home") this.home();
    else if (event.key === "Enter" && this.cursor) this.choose(this.cursor);
    else return;
    event.preventDefault();
  }

  /** Move the cross-hair, and the picture where it would leave the frame. */
  step(way, by) {
    const from = this.cursor ?? this.middle;
    const place = from.map((value, k) => clamp(Math.round((value + by * way[k]) * 100) / 100, 0, (k ? this.height : this.width) - 1));
    const reach = this.box.map((side) => (side / 2 - EDGE_PX) / this.scale);
    this.middle = this.middle.map((value, k) => clamp(value, place[k] - reach[k], place[k] + reach[k]));
    this.draw();
    this.point(place);
  }
}

export class PanoramaPanel {
  constructor(events, target, announce) {
    Object.assign(this, { events, target, announce, all: [], targets: {} });
    this.strip = new Strip((pixel) => this.clicked(pixel));
    this.choice = h("select", { "aria-label": "Panorama", onchange: () => { this.chosen = this.choice.value; this.refresh(); } });
    this.progress = h("p", { class: "quiet", id: "pano-state", role: "status" });
    this.more = h("button", { type: "button", hidden: true, onclick: () => this.take({ resume: this.one.id }) }, "Go on");
    this.seams = h("p", { id: "seams" });
    this.bar = h("div", { class: "pano-bar", hidden: true }, this.strip.buttons, this.choice, this.more);
    this.pair = h("select", { "aria-label": "Cameras" });
    this.angles = ["Pan from", "to", "Tilt from", "to"].map((text, k) => h("input", { inputmode: "decimal", autocomplete: "off", size: 5, "aria-label": `${k < 2 ? "Pan" : "Tilt"}, ${k % 2 ? "to" : "from"}, degrees`, id: `pano-${k}` }));
    this.go = h("button", { type: "submit", class: "go" }, "Take a panorama");
    this.field = h("form", { class: "angles", onsubmit: (event) => { event.preventDefault(); this.begin(); } },
      this.go, ["Pan", "Tilt"].map((text, k) => h("span", {}, `${text} `, this.angles[2 * k], " to ", this.angles[2 * k + 1], " °")), this.pair);
    this.bad = h("p", { class: "bad", role: "alert" });
    this.name = h("input", { "aria-label": "Name of the target", placeholder: "name", maxlength: 40, required: true });
    this.keeps = h("button", { type: "submit" }, "Keep");
    this.keeper = h("form", { class: "angles", id: "keep-target", onsubmit: (event) => { event.preventDefault(); this.keepTarget(); } }, h("span", { class: "quiet" }), this.name, this.keeps);
    this.list = h("ul", { id: "kept-targets" });
    this.exports = h("p", { hidden: true }, "Save as ", [["CSV", "text/csv", csv], ["JSON", "application/json", features]].map(([kind, type, text]) => h("a", { class: "save", href: "#", download: `targets.${kind.toLowerCase()}`, onclick: ({ currentTarget }) => { currentTarget.href = URL.createObjectURL(new Blob([text(this.targets)], { type })); } }, kind)).flatMap((one, k) => (k ? [", ", one] : [one])));
    put(byId("panorama"), this.strip.frame, this.bar, this.progress, this.seams, this.field, this.bad, h("h3", {}, "Targets kept by a name"), this.list, this.exports, this.keeper);
    events.addEventListener("connected", () => this.refresh());
    events.addEventListener("command", ({ detail: { value } }) => { if (/^(target|panorama)/.test(value.command ?? "")) this.refresh(); });
    events.addEventListener("operation", ({ detail: { value } }) => { if (typeof value.request?.panorama === "string") this.refresh(); });
    events.addEventListener("joints", () => { this.turned = true; });
    document.addEventListener("target-changed", () => this.show());
    setInterval(() => document.hidden || (this.taking() ? this.refresh() : this.overlay()), POLL_MS);
  }

  use({ limits }, { cameras }) {
    const pairs = [...new Set(Object.values(cameras).filter((one) => one.on === "head" && one.pair && one.partner).map((one) => one.pair))];
    const names = pairs.length ? pairs : Object.keys(cameras).filter((name) => cameras[name].on === "head");
    this.kind = pairs.length ? "pair" : "camera";
    if (names.join() !== this.names) put(this.pair, names.map((name) => h("option", { value: name, selected: name === "navcam" }, called(name))));
    this.names = names.join();
    this.pair.hidden = names.length < 2;
    this.field.hidden = !names.length;
    [...limits.pan_rad.map(degrees), ...TILT_DEG].forEach((value, k) => set(this.angles[k], "placeholder", number(value, 0)));
  }

  allow(may) {
    this.may = may;
    this.show();
  }

  async act(work) {
    say(this.bad, "");
    try {
      await work();
    } catch (error) {
      say(this.bad, error.message);
    }
    this.refresh();
  }

  begin() {
    const typed = this.angles.map((input) => figure(input.value || input.placeholder));
    const wrong = this.angles.findIndex((_, k) => !Number.isFinite(typed[k]));
    if (wrong >= 0) return say(this.bad, `'${this.angles[wrong].value}' where an angle in degrees is expected.`);
    const [a, b, c, d] = typed.map((value) => (value * Math.PI) / 180);
    return this.take({ [this.kind]: this.pair.value, pan_rad: [a, b], tilt_rad: [c, d] });
  }

  take(body) {
    this.chosen = body.resume;
    return this.act(() => post("/panoramas", body));
  }

  /** Whether what is shown is being taken; a daemon that was killed leaves one that only says so. */
  taking({ state, id } = this.one ?? {}) {
    return state === "running" && [...(this.events.known.get("operation")?.values() ?? [])].some((one) => one.request?.panorama === id && !one.ended_s);
  }

  /** What there is: the panoramas, the newest first, and the kept targets. One request at a time. */
  async refresh() {
    if (this.refreshing) { this.again = true; return; }
    this.refreshing = true;
    try {
      [this.all, this.targets] = (await Promise.all([get("/panoramas"), get("/targets")])).map((one) => one.panoramas ?? one.targets);
      this.one = this.all.find(({ id }) => id === this.chosen) ?? this.all[0];
      this.drawing = this.drawing?.id === this.one?.id ? this.drawing : null;
      await this.picture();
      this.turned = true;
      this.facing = ""; // targets may be others
      await this.overlay();
    } catch (error) {
      if (error.status && error.status !== 401) say(this.bad, error.message);
    }
    this.show();
    setTimeout(() => { this.refreshing = false; if (this.again) { this.again = false; this.refresh(); } }, POLL_MS / 2);
  }

  /** The picture and what its seams say, where another view came or it was composed. */
  async picture() {
    const { one } = this;
    const version = one && `${one.id} ${one.state === "done"} ${one.views.taken ?? 0}`;
    if (!one || version === this.version) return;
    const index = one.state === "done" ? await get(`/panoramas/${one.id}`) : {};
    const path = fileOf(`/panoramas/${one.id}`), views = `?views=${one.views.taken ?? 0}`;
    this.drawing = null;
    if (index.mosaic) this.strip.show(`${path}/files/preview.jpg${views}`, { address: `${path}/files/mosaic.png${views}`, from: Math.min(1, 2048 / index.mosaic.size_px[0]) });
    else if (one.views.taken) this.strip.show(`${path}/picture${views}`, null);
    this.version = version;
    const { whole, slip } = index, pixels = (values) => values.map((value) => number(value, 2)).join(", ");
    put(this.seams, whole ? [`Seams: ${pixels(whole.rms_px)} px rms in x and y of ${whole.count} patches (the matches alone: ${pixels(whole.sigma_px)} px)`, whole.across_px ? `; across the parallax ${number(whole.across_px[0], 2)} px (${number(whole.across_px[1], 2)} px)` : "", ". ", slip ? h("strong", { class: "warn" }, sentence(slip.sentence), ".") : ""] : []);
  }

  /** The camera's present view, and the targets, in the picture's pixels. */
  async overlay() {
    const { one, turned } = this;
    if (!one?.views.taken || !turned || !this.events.connected) return;
    this.turned = false;
    const facing = JSON.stringify(["pan_rad", "tilt_rad"].map((axis) => Math.round(2000 * (this.events.newest("joints", "pan_tilt")?.[axis] ?? 0))));
    if (this.drawing && facing === this.facing) return;
    this.facing = facing;
    const drawing = await get(`/panoramas/${one.id}/drawing`).catch(() => null);
    if (!drawing || one !== this.one) return;
    this.drawing = { ...drawing, id: one.id };
    this.strip.frame.hidden = false;
    this.strip.size(drawing.size_px);
    this.strip.put("view", drawing.view_px ? s("g", {}, ["halo", "head-view"].map((kind) => s("path", { class: kind, d: `M${drawing.view_px.map((one) => one.join(" ")).join("L")}Z` }))) : null);
    for (const name of Object.keys(this.strip.marks)) if (name.startsWith("target ") && !(name.slice(7) in drawing.targets_px)) this.strip.mark(name, null);
    for (const [name, place] of Object.entries(drawing.targets_px)) this.strip.mark(`target ${name}`, place, "kept", name);
  }

  show() {
    const { one, target, all } = this, taking = this.taking();
    this.strip.frame.hidden = !one?.views.taken;
    this.bar.hidden = !one;
    for (const part of [...this.angles, this.go, this.pair, this.more]) part.disabled = !this.may || taking;
    const place = target.position();
    const clicked = target.click?.panorama;
    this.strip.mark("click", clicked && clicked.id === one?.id && target.state !== "none" ? clicked.pixel : null, "click");
    say(this.keeper.firstChild, place ? `Keep the point at ${place.position_m.map((value) => number(value, 2, true)).join(", ")} m as` : "A point that was chosen can be kept by a name.");
    for (const part of [this.name, this.keeps]) part.hidden = !place || !this.may;
    const drawn = JSON.stringify([this.targets, this.may]);
    if (drawn !== this.listed) put(this.list, Object.entries(this.targets).map((entry) => this.row(...entry)));
    this.listed = drawn;
    this.exports.hidden = !Object.keys(this.targets).length;
    const ids = all.map(({ id, state }) => `${id} ${state}`).join();
    if (ids !== this.ids) put(this.choice, all.map(({ id, time, camera, state }) => h("option", { value: id }, `${new Date(time).toLocaleString("en-GB", { dateStyle: "short", timeStyle: "short" })}, ${called(camera)}${state === "done" ? "" : ", not whole"}`)));
    this.ids = ids;
    if (!one) return;
    this.choice.value = one.id;
    const { taken = 0, missing = 0, forbidden = 0, wanted = 0 } = one.views;
    const left = [missing && `${missing} missing`, forbidden && `${forbidden} left out: limits or keep-outs`].filter(Boolean).map((text) => `, ${text}`).join("");
    const count = `${taken} of ${taken + missing + wanted + forbidden} views${left}`;
    const running = taken && !wanted ? "composing the mosaic" : "STOP ends it, and what was taken is kept";
    if (taking) say(this.progress, `Taking: ${count}; ${running}.`);
    else say(this.progress, one.state === "done" ? `${count}. Click a point to see its range.` : `Ended early: ${count}. ${sentence(inDegrees(one.reason || "the daemon ended meanwhile."))}`);
    this.more.hidden = taking || (one.state === "done" && !missing);
  }

  clicked(pixel) {
    if (this.one?.state !== "done") return this.announce("The panorama can be clicked when it is whole.", true);
    this.target.choosePanorama(this.one.id, pixel);
  }

  row(name, { position_m: place, frame, covariance_m2: covariance }) {
    const sigma = covariance ? ` ± ${number(Math.sqrt(covariance[0][0] + covariance[1][1] + covariance[2][2]), 3)}` : "";
    const button = (text, act) => h("button", { type: "button", class: "quiet", "aria-label": `${text} ${name}`, disabled: !this.may, onclick: act }, text);
    return h("li", {}, h("strong", {}, name), h("span", { class: "quiet" }, `${place.map((value) => number(value, 2, true)).join(", ")}${sigma} m, ${frame}`),
      h("span", {}, button("Point at", () => this.target.begin({ label: `Target ${name}`, old: "", request: { position_m: place, frame } })), " ", button("Forget", () => this.act(() => ask("DELETE", `/targets/${encodeURIComponent(name)}`)))));
  }

  keepTarget() {
    const { position_m: position, covariance_m2: covariance } = this.target.position();
    const name = this.name.value.trim();
    return this.act(async () => {
      await post(`/targets/${encodeURIComponent(name)}`, { position_m: position, frame: "rover", ...(covariance ? { covariance_m2: covariance } : {}) });
      this.name.value = "";
      this.announce(`${name} is kept.`);
    });
  }
}

function csv(targets) {
  const rows = Object.entries(targets).map(([name, one]) => [`"${name}"`, one.frame, ...one.position_m, (one.covariance_m2 ?? []).flat().join(" ")].join(","));
  return `${["name,frame,x_m,y_m,z_m,covariance_m2", ...rows].join("\n")}\n`;
}

function features(targets) {
  const all = Object.entries(targets).map(([name, { position_m: coordinates, frame, covariance_m2 }]) => ({ type: "Feature", geometry: { type: "Point", coordinates }, properties: { name, frame, covariance_m2 } }));
  return `${JSON.stringify({ type: "FeatureCollection", features: all }, null, 1)}\n`;
}

// Which cameras are in view, and their images.
import { byId, h, keep, kept, put } from "./dom.js";
import { Eye } from "./eye.js";
import { Images } from "./images.js";
import { fileOf } from "./api.js";

export class Views {
  constructor(choose) {
    this.choose = choose;
    this.eyes = new Map();
    this.images = new Images((facts, bitmap) => this.shown(facts, bitmap));
    this.groups = [];
    this.turning = false;
    setInterval(() => this.eyes.forEach((eye) => eye.fresh(performance.now())), 100);
    document.addEventListener("visibilitychange", () => this.watch());
  }

  use(rig) {
    const groups = new Map();
    for (const [name, told] of Object.entries(rig.cameras)) {
      const key = told.pair ?? name;
      groups.set(key, [...(groups.get(key) ?? []), name]);
    }
    this.groups = [...groups].map(([key, names]) => [key, names.sort((a, b) => (rig.cameras[a].side ?? "").localeCompare(rig.cameras[b].side ?? ""))]);
    const before = kept("mastctl view");
    const first = ["navcam", ...groups.keys()].find((key) => groups.has(key));
    this.choosePair(groups.has(before) ? before : first);
  }

  choosePair(key) {
    this.key = key;
    keep("mastctl view", key ?? "");
    put(byId("tabs"), this.groups.map(([name]) => h("button", { type: "button", "aria-pressed": String(name === key), onclick: () => this.choosePair(name) }, name.replaceAll("_", " "))));
    const names = this.names();
    this.eyes = new Map(names.map((name) => [name, this.eyes.get(name) ?? new Eye(name, this.choose, () => this.turning)]));
    put(byId("eyes"), [...this.eyes.values()].map((eye) => eye.element));
    this.watch();
    document.dispatchEvent(new CustomEvent("views-changed"));
  }

  /** Pictures of the cameras in view, while anybody sees the page. */
  watch() {
    this.images.watch(document.hidden ? [] : this.names());
  }

  names() {
    return this.groups.find(([name]) => name === this.key)?.[1] ?? [];
  }

  /** Bring a camera into view. */
  bring(camera) {
    const group = this.groups.find(([, names]) => names.includes(camera));
    if (group && group[0] !== this.key) this.choosePair(group[0]);
    return this.eyes.get(camera);
  }

  shown(facts, bitmap) {
    const eye = this.eyes.get(facts.camera);
    if (!eye) return;
    eye.show(facts, bitmap);
    eye.save.hidden = false;
    eye.save.href = fileOf(`/snapshot/${encodeURIComponent(facts.camera)}?format=png&frame_id=${encodeURIComponent(facts.frame_id)}`);
  }
}

// The page: what is always in sight, and the panels told of what changes.
import { byId, h, keep, kept, put, say, set } from "./dom.js";
import { NAME, ask as request, get, me, person, post } from "./api.js";
import { forTime, inDegrees, sentence } from "./words.js";
import { Bench } from "./bench.js";
import { Control } from "./control.js";
import { Events } from "./events.js";
import { Failure, Faults, MastFile, Recording } from "./panels.js";
import { HeadPanel } from "./head.js";
import { History } from "./history.js";
import { Jog } from "./jog.js";
import { OperationList } from "./operations.js";
import { PanoramaPanel } from "./panorama.js";
import { Residuals } from "./residuals.js";
import { Settings } from "./settings.js";
import { Simulation } from "./simulation.js";
import { Target } from "./target.js";
import { TrackPanel } from "./track.js";
import { Views } from "./views.js";

const WORDS = { starting: "starting", ready: "ready", moving: "moving", tracking: "tracking", holding: "holding", stopping: "stopping", stopped: "stopped", fault: "fault", closing: "closing" };

/** Told to screen readers at once; what is seen elsewhere needs no notice. */
function announce(words) {
  const place = byId("alarm");
  place.textContent = "";
  place.textContent = words;
}

function alarm(words) {
  announce(words);
  notice(words);
}

function speak(words, urgent = false) {
  if (urgent) alarm(words);
  else say(byId("said"), words);
}

/** What was refused beside its place, seen for some seconds. */
let noticeTimer;
function notice(words) {
  clearTimeout(noticeTimer);
  document.querySelector(".notice")?.remove();
  const place = h("p", { class: "notice" }, words);
  document.body.append(place);
  noticeTimer = setTimeout(() => place.remove(), 8000);
}

// The stops are in stop.js. Whatever was chosen before one is not sent after it.
document.addEventListener("stop", ({ detail: { title, state } }) => {
  if (state === "failed") failedAfter = command;
  if (state !== "sent") return;
  target.disarm(`${title} was pressed`);
  for (const eye of views.eyes.values()) eye.leave();
});
/** A stop that was carried out late, or a head that rests when the connection is back, ends the alarm. */
const stopConfirmed = () => { byId("stop-failed").hidden = true; };
let doubted = false; // a stop was not confirmed, and the connection was lost since
let command = 0; // number of the newest that was told
let failedAfter = 0;

/** A dialogue that leaves the stops within reach: of the browser's own kinds one shuts them out, the other nothing. */
function ask(dialog) {
  document.querySelector("main").inert = true;
  if (!dialog.open) dialog.show();
}
function answered(dialog) {
  dialog.close();
  document.querySelector("main").inert = Boolean(document.querySelector("dialog[open]"));
}

const events = new Events();
const views = new Views((eye, pixel, facts, what) => (what === "track" ? track.begin(eye, pixel, facts) : target.choose(eye, pixel, facts)));
const target = new Target(views, events, (words, urgent) => (urgent ? announce : speak)(words)); // seen in its panel
const panorama = new PanoramaPanel(events, target, speak);
const track = new TrackPanel(events, views, speak);
const head = new HeadPanel(events);
const jog = new Jog(alarm);
const control = new Control(alarm, (holder) => target.disarm(`${holder} took over`));
const recording = new Recording(alarm);
const mastFile = new MastFile(alarm);
const residuals = new Residuals();
const simulation = new Simulation();
const settings = new Settings();
new Faults(events, announce);
new Failure(events, announce);
new OperationList(events);
const bench = new Bench(events, speak);
new History(events);

// What is pushed

let since = 0;
let latched = "";
function standing(now) {
  set(byId("state"), "data-word", now.state);
  views.turning = ["moving", "stopping"].includes(now.state);
  const before = byId("word").textContent;
  say(byId("word"), WORDS[now.state] ?? now.state);
  say(byId("reason"), now.estop ? "" : sentence(person(inDegrees(now.reason ?? "")))); // the latch tells who and why itself
  since = performance.now() - 1000 * now.state_for_s;
  if (before !== now.state) {
    if (["stopping", "stopped"].includes(now.state)) target.disarm("The head was stopped");
    if (["stopped", "fault"].includes(now.state) && now.reason) announce(`${now.state}. ${inDegrees(now.reason)}`);
    else speak(`${now.state}. ${inDegrees(now.reason ?? "")}`);
  }
  if (doubted && ["ready", "holding", "stopped"].includes(now.state)) stopConfirmed();
  doubted = false;
  const latch = now.estop;
  target.latch(Boolean(latch));
  byId("estop").hidden = !latch;
  set(byId("latch"), "aria-pressed", String(Boolean(latch)));
  const entries = now.estops ?? [];
  const words = latch ? ` by ${entries.map((one) => `${person(one.name)}: ${one.reason}`).join("; by ")}. Nothing moves until it is released, not even after a restart of the daemon. ` : "";
  if (words !== latched) put(byId("estop"), h("span", {}, h("strong", {}, "Emergency stop"), words), ...(latch ? [h("button", { type: "button", id: "release", onclick: () => ask(byId("reset")) }, "Release …")] : []));
  latched = words;
  for (const button of byId("estop").querySelectorAll("button")) button.disabled = !may;
  document.title = `${now.state} – mastctl`;
}
setInterval(() => say(byId("state-for"), events.connected ? `for ${forTime((performance.now() - since) / 1000)}` : ""), 500);

let pushed = 0; // an answer that was asked for before the last of these is older than they are
events.addEventListener("state", (event) => { pushed += 1; standing(event.detail.value); });
events.addEventListener("lease", (event) => { pushed += 1; control.told(event.detail.value.control); });
events.addEventListener("joints", (event) => { jog.here = [event.detail.value.pan_rad, event.detail.value.tilt_rad]; });
events.addEventListener("mast", () => { refresh(); residuals.otherMast(); });
events.addEventListener("fault", (event) => { if (event.detail.key === "sun") refresh(); });
events.addEventListener("command", (event) => {
  const { command: kind = "", number, result, ended } = event.detail.value;
  if (kind.endsWith("stop") && result === "ok" && !ended && number > failedAfter) stopConfirmed();
  command = number;
  if (kind === "stop") target.disarm("The head was stopped");
  refresh();
  if (kind.startsWith("record")) recording.look();
  if (kind.startsWith("place")) jog.look();
  if (kind === "camera.settings") settings.look();
});
events.addEventListener("operation", (event) => {
  const record = event.detail.value;
  if (record.state !== "running") settings.look();
  if (record.residual_px && record.state === "done") residuals.after(record.id);
  const going = record.state === "running" ? record.steps.findLast((step) => step.name === "limits") : null;
  head.goal(going ? [going.detail.pan_rad, going.detail.tilt_rad] : undefined);
});
events.addEventListener("connected", () => { byId("lost").hidden = true; doubted = !byId("stop-failed").hidden; head.goal(); refresh(); recording.look(); residuals.look(); jog.look(); control.again(); });
events.addEventListener("lost", () => {
  byId("lost").hidden = false;
  views.turning = false;
  jog.release();
  say(byId("reason"), `When it was last heard it was ${byId("word").textContent}.`);
  say(byId("word"), "no connection");
  set(byId("state"), "data-word", "lost");
  document.title = "no connection – mastctl";
});
setInterval(() => { if (!document.hidden) refresh(); }, 60000); // the age of a verdict is no event
setInterval(() => {
  if (!events.connected && events.heardMs) {
    byId("lost").hidden = false;
    say(byId("lost-words"), `Connection lost for ${forTime((performance.now() - events.lostMs) / 1000)}.`);
  }
}, 500);

// What is asked when something has changed, at most twice a second

let may = false;
let rig = null;
let again = false;
async function refresh() {
  if (refresh.busy) { again = true; return; }
  refresh.busy = true;
  try {
    const before = pushed;
    const status = await get("/status");
    if (!rig || rig.digest !== status.mast.digest || Object.keys(rig.cameras).length !== Object.keys(status.cameras).length) {
      rig = await get("/rig");
      views.use(rig);
    }
    head.keptOff(await get("/limits/sun"));
    show(status);
    if (before === pushed) {
      standing(status);
      control.told(status.control);
    }
  } catch (error) {
    if (error.status) notice(error.message);
  }
  setTimeout(() => { refresh.busy = false; if (again) { again = false; refresh(); } }, 500);
}

function show(status) {
  const simulated = status.hardware === "simulated";
  const badge = byId("hardware");
  say(badge, { simulated: "SIMULATED", real: "HARDWARE", replayed: "REPLAYED", mixed: "HARDWARE, PART SIMULATED" }[status.hardware] ?? status.hardware);
  set(badge, "data-kind", status.hardware);
  head.use(status, rig, views);
  jog.use(status.limits);
  mastFile.told(status, rig);
  for (const part of [simulation, settings, track, target, panorama]) part.use(status, rig);
  set(document.body, "data-simulated", simulated);
}

function allow(role) {
  may = role !== "view";
  set(document.body, "data-role", role);
  for (const part of [target, panorama, track, jog, control, recording, mastFile, simulation, settings, bench]) part.allow(may, role);
}

// Who one is

async function enter() {
  try {
    const session = await get("/session");
    answered(byId("login"));
    allow(session.role);
    byId("logout").hidden = !session.needs_token;
    events.open();
  } catch (error) {
    if (error.status === 401) {
      say(byId("word"), "not logged in");
      ask(byId("login"));
    }
    else { notice(error.message); setTimeout(enter, 2000); }
  }
}
byId("login-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  try {
    await request("POST", "/session", {}, { token: byId("token").value.trim() });
    byId("token").value = "";
    say(byId("login-said"), "");
    enter();
  } catch (error) {
    say(byId("login-said"), error.message);
  }
});
byId("logout").addEventListener("click", async () => {
  try {
    await control.leave();
    await request("DELETE", "/session");
    location.reload();
  } catch (error) {
    alarm(error.message);
  }
});

// What is this browser's own: a name, and whether single keys do something

const KEYS = "mastctl keys";
const singleKeys = byId("single-keys");
singleKeys.checked = kept(KEYS) !== "off";
singleKeys.addEventListener("change", () => keep(KEYS, singleKeys.checked ? "on" : "off"));
byId("keys-open").addEventListener("click", () => ask(byId("keys")));
document.addEventListener("keydown", (event) => {
  const key = event.key.toLowerCase();
  if (!singleKeys.checked || event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input:not([type=checkbox]), select, textarea")) return;
  if (key === "?") (byId("keys").open ? answered : ask)(byId("keys"));
  if (key === "p" && !document.querySelector("dialog[open]")) target.send();
});
const showName = () => { say(byId("name-open"), me.name ? `as ${me.name}` : "Your name …"); set(byId("name-open"), "title", me.name || null); };
showName();
byId("name-open").addEventListener("click", () => {
  byId("name").value = me.name;
  ask(byId("named"));
  byId("name").focus();
});
byId("name-form").addEventListener("submit", (event) => {
  event.preventDefault();
  me.name = byId("name").value.trim();
  keep(NAME, me.name);
  showName();
  answered(byId("named"));
});
document.addEventListener("no-session", () => ask(byId("login")));
for (const dialog of document.querySelectorAll("dialog")) dialog.querySelector("[data-closes]")?.addEventListener("click", () => answered(dialog));
byId("reset-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  try {
    await post("/reset", { reason: byId("reset-reason").value, name: byId("reset-name").value });
    answered(byId("reset"));
  } catch (error) {
    say(byId("reset-said"), error.message);
  }
});

enter();

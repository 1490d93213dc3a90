// Requests to the daemon. At most four are under way besides stops, so that a browser, which opens six
// connections, always has one free for a stop.
import { kept } from "./dom.js";
import { inDegrees } from "./words.js";

const PREFIX = "/api/v1";
const AT_ONCE = 4;
const ANSWER_MS = 20000;

const words = new Uint32Array(1);
crypto.getRandomValues(words);
/** By which this page is told from others; `me.name` is what its user is called, for people. */
export const client = `page-${words[0].toString(36)}`;
export const NAME = "mastctl name";
export const me = { name: kept(NAME) ?? "" };
const called = () => (me.name ? `${me.name}, ${client}` : client);
/** A name, or words about people, without what tells one page of theirs from another. */
export const person = (words) => words.replace(/, page-[0-9a-z]+/g, "");
/** A header holds bytes: those of UTF-8. */
const bytes = (text) => String.fromCharCode(...new TextEncoder().encode(text));

export class Refusal extends Error {
  constructor(status, code, message, detail) {
    super(code === "not_found" ? "The daemon does not know what the page asked for. Reload the page." : person(inDegrees(message)));
    this.status = status;
    this.code = code;
    this.detail = detail;
  }
}

export const held = { lease: null };
let free = AT_ONCE;
const waiting = [];

async function turn(method) {
  if (free > 0) free -= 1;
  else await new Promise((go, refuse) => waiting.push({ method, go, refuse }));
}

function done() {
  const next = waiting.shift();
  if (next) next.go();
  else free += 1;
}

/** What still waits here when a stop is pressed is never sent: nothing moves by it afterwards. */
function dropWaiting() {
  const dropped = waiting.filter(({ method }) => method !== "GET");
  waiting.splice(0, waiting.length, ...waiting.filter(({ method }) => method === "GET"));
  for (const { refuse } of dropped) refuse(new Refusal(0, "stopped", "It was not sent: STOP was pressed before."));
}

async function sent(method, path, body, options) {
  const headers = { "Mastctl-Client": bytes(called()) };
  if (held.lease && method !== "GET") headers["Mastctl-Lease"] = held.lease;
  if (method !== "GET") headers["Content-Type"] = "application/json";
  let answer;
  try {
    answer = await fetch(PREFIX + path, {
      method, headers, body: method === "GET" ? undefined : JSON.stringify(body ?? {}), cache: "no-store",
      signal: AbortSignal.timeout(options.ms ?? ANSWER_MS), keepalive: options.keepalive ?? false, priority: options.priority ?? "auto",
    });
  } catch (error) {
    const late = error.name === "TimeoutError";
    throw new Refusal(0, late ? "timeout" : "no_daemon", late ? "The daemon did not answer in time." : "The daemon cannot be reached.");
  }
  if (options.raw && answer.ok) return answer;
  const told = await answer.json().catch(() => null);
  if (!answer.ok) {
    const error = told?.error ?? { code: "no_daemon", message: `The answer was ${answer.status}.` };
    if (answer.status === 401) document.dispatchEvent(new CustomEvent("no-session"));
    throw new Refusal(answer.status, error.code, error.message, error.detail);
  }
  return told;
}

export async function ask(method, path, body, options = {}) {
  await turn(method);
  try {
    return await sent(method, path, body, options);
  } finally {
    done();
  }
}

export const get = (path, options) => ask("GET", path, undefined, options);
export const post = (path, body, options) => ask("POST", path, body, options);

/** Stops wait for nothing here. */
function first(path, body) {
  const answer = sent("POST", path, body, { ms: 4000, priority: "high", keepalive: true });
  dropWaiting();
  return answer;
}
export const stop = () => first("/stop", {});
/** It latches: nothing moves until somebody releases it with a reason. */
export const estop = () => first("/estop", { reason: "pressed on the page", name: called() });
/** Nor does the question whether anybody is there. */
export const live = () => sent("GET", "/health/live", null, { ms: 2000 });
/** Neither do heartbeats, of which one is under way at a time, nor what is said on leaving. */
export const beat = (body) => sent("POST", "/jog", body, { ms: 2000, keepalive: true });
export const parting = (method, path) => sent(method, path, {}, { keepalive: true }).catch(() => null);

export function address(path) {
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  return `${scheme}//${location.host}${PREFIX}${path}`;
}

export const fileOf = (path) => PREFIX + path;

// Requests to the daemon. At most four are under way besides stops, so that a browser, which opens six
// connections, always has one free for a stop.
import { inDegrees } from "./words.js";

const PREFIX = "/api/v1";
const AT_ONCE = 4;
const ANSWER_MS = 20000;

/** This page as the daemon knows it, from stop.js, which came first: `me.name` is what its user is called. */
export const me = window.mastctl;
export const { client, NAME } = me;
/** A name, or a message about people, without what tells one page of theirs from another. */
export const person = (message) => message.replace(/, page-[0-9a-z]+/g, "");

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

/** Commands that still wait when a stop is pressed are never sent: nothing moves by them afterwards. */
document.addEventListener("stop", ({ detail }) => {
  if (detail.state !== "sent") return;
  const dropped = waiting.filter(({ method }) => method !== "GET");
  waiting.splice(0, waiting.length, ...waiting.filter(({ method }) => method === "GET"));
  for (const { refuse } of dropped) refuse(new Refusal(0, "stopped", "It was not sent: STOP was pressed before."));
});

async function sent(method, path, body, options) {
  const headers = { "Mastctl-Client": me.header };
  if (held.lease && method !== "GET") headers["Mastctl-Lease"] = held.lease;
  if (method !== "GET") headers["Content-Type"] = "application/json";
  if (options.token) headers.Authorization = `Bearer ${options.token}`;
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

/** These wait for no other request: whether the daemon lives, */
export const live = () => sent("GET", "/health/live", null, { ms: 2000 });
/** heartbeats, of which one is under way at a time, and what is sent on leaving. */
export const beat = (body) => sent("POST", "/jog", body, { ms: 2000, keepalive: true });
export const parting = (method, path) => sent(method, path, {}, { keepalive: true }).catch(() => null);

export function address(path) {
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  return `${scheme}//${location.host}${PREFIX}${path}`;
}

export const fileOf = (path) => PREFIX + path;

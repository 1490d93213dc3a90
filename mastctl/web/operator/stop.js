// STOP and E-STOP: armed before anything is drawn, without any other file. No lease, no confirmation, no queue.
// Escape does what STOP does wherever the focus is. The modules hear of each press by the event "stop".
{
  const LATE_MS = 4000; // not confirmed after so long, it is an alarm; the request goes on
  const GIVEN_UP_MS = 60000;
  const NAME = "mastctl name";
  const number = new Uint32Array(1);
  crypto.getRandomValues(number);
  let name = "";
  try { name = localStorage.getItem(NAME) ?? ""; } catch { /* nothing is kept in this browser */ }

  /** By what this page is known to the daemon: `client` tells it from others, `name` is what its user is called. */
  const page = {
    client: `page-${number[0].toString(36)}`, name, NAME,
    get called() { return page.name ? `${page.name}, ${page.client}` : page.client; },
    /** A header holds bytes: those of UTF-8. */
    get header() { return String.fromCharCode(...new TextEncoder().encode(page.called)); },
  };
  window.mastctl = page;

  const byId = (id) => document.getElementById(id);
  const STOPS = {
    stop: { title: "STOP", path: "/stop", body: () => ({}), done: "Stopped." },
    latch: { title: "E-STOP", path: "/estop", body: () => ({ reason: "pressed on the page", name: page.called }), done: "Emergency stop. Nothing moves until it is released." },
  };

  function show(id, state, message = "") {
    const { title, done } = STOPS[id];
    const [button, failed, status] = [byId(id), byId("stop-failed"), byId("said")];
    if (button) button.dataset.pressed = state;
    if (failed && state !== "sent") failed.hidden = state === "confirmed";
    if (failed && state === "failed") failed.textContent = `${title} IS NOT CONFIRMED. ${message} Use the switch in the supply.`;
    if (status && state === "confirmed") status.textContent = done;
    document.dispatchEvent(new CustomEvent("stop", { detail: { title, state } }));
  }

  async function answerOf(request) {
    const answer = await request.catch(() => null);
    if (!answer) return "The daemon cannot be reached.";
    if (answer.ok) return "";
    const refused = await answer.json().catch(() => null);
    return refused?.error?.message ?? `The answer was ${answer.status}.`;
  }

  let presses = 0;
  async function press(id) {
    const mine = ++presses;
    const { path, body } = STOPS[id];
    const request = fetch(`/api/v1${path}`, {
      method: "POST", headers: { "Mastctl-Client": page.header, "Content-Type": "application/json" }, body: JSON.stringify(body()),
      cache: "no-store", keepalive: true, priority: "high", signal: AbortSignal.timeout(GIVEN_UP_MS),
    });
    show(id, "sent");
    const late = setTimeout(() => show(id, "failed", "The daemon did not answer in time."), LATE_MS);
    const refusal = await answerOf(request);
    clearTimeout(late);
    show(id, refusal ? "failed" : "confirmed", refusal);
    setTimeout(() => { if (mine === presses && byId(id)) byId(id).dataset.pressed = ""; }, 1200);
  }

  // Listened for on the document: the buttons need not be there yet.
  const pressed = ({ target }) => target.closest?.("#stop, #latch")?.id;
  const first = { capture: true };
  document.addEventListener("pointerdown", (event) => { if (event.button === 0 && pressed(event)) { event.preventDefault(); press(pressed(event)); } }, first);
  document.addEventListener("keydown", (event) => {
    const id = event.key === "Escape" ? "stop" : ["Enter", " "].includes(event.key) && pressed(event);
    if (!id) return;
    if (event.key !== "Escape") event.preventDefault();
    if (!event.repeat) press(id);
  }, first);
  document.addEventListener("click", (event) => { if (event.detail === 0 && pressed(event)) press(pressed(event)); }, first); // a screen reader's or a switch's press
}

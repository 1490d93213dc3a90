// Who steers: the lease, renewed while it is held, and given back on leaving.
import { byId, h, put, say, set } from "./dom.js";
import { client, held, parting, person, post, ask } from "./api.js";
import { forTime } from "./words.js";

const FOR_S = 30;
const RENEW_MS = 10000;
const BENCH = "bench calibration"; // it takes the lease from nobody but from who begins it

export class Control {
  constructor(alarm, taken) {
    [this.alarm, this.taken] = [alarm, taken];
    this.words = byId("control");
    [this.name, this.comma, this.more] = [h("span", { class: "name" }), h("span", { class: "comma" }), h("span", { class: "more" })];
    put(this.words, this.name, this.comma, this.more);
    this.button = byId("take");
    this.button.addEventListener("click", () => this.press());
    setInterval(() => held.lease && this.renew(), RENEW_MS);
    setInterval(() => this.draw(), 1000);
    window.addEventListener("pagehide", () => held.lease && parting("DELETE", "/lease"));
  }

  told(control) {
    const other = control?.kind === "lease" && !control.holder.endsWith(client);
    if (other && control.holder !== this.control?.holder) this.taken(person(control.holder));
    this.control = control;
    this.toldMs = performance.now();
    if (control?.holder === BENCH) held.lease = null;
    if (held.lease && !this.own() && !this.leaving) this.renew(); // it says how ours has ended, if it has
    this.draw();
  }

  allow(may) {
    this.may = may;
    this.draw();
  }

  /** Whether the lease is told to be this page's. */
  own() {
    return this.control?.kind === "lease" && this.control.holder.endsWith(client);
  }

  draw() {
    const { control } = this;
    const left = control?.for_s == null ? null : control.for_s - (performance.now() - this.toldMs) / 1000;
    const gone = left !== null && left <= 0;
    const mine = held.lease !== null && this.own();
    const whose = control?.holder.endsWith(client) ? "you" : control && person(control.holder);
    if (mine) this.say("you", "renewed");
    else if (!control || gone) this.say("nobody", "");
    else if (control.kind === "operation") this.say(whose, "while it runs");
    else this.say(person(control.holder), `${forTime(left)} left`);
    this.words.parentElement.dataset.whose = mine ? "mine" : control && !gone && !control.holder.endsWith(client) ? "other" : "nobody";
    if (this.sure && (mine || gone || control?.kind !== "lease")) this.sure = false;
    say(this.button, !this.may ? "View only" : this.sure ? "Take it from them?" : mine ? "Release" : control && !gone && control.kind === "lease" ? "Take over" : "Take");
    this.button.disabled = !this.may;
  }

  say(name, more) {
    say(this.name, name);
    say(this.comma, more && ", ");
    say(this.more, more);
    set(this.name, "title", name);
  }

  async press() {
    try {
      if (held.lease) {
        await this.leave();
      } else if (this.sure || this.button.textContent === "Take over") {
        if (!this.sure) return this.makeSure();
        this.sure = false;
        this.has(await post("/lease/take", { for_s: FOR_S, reason: "taken over on the page" }));
      } else {
        this.has(await post("/lease", { for_s: FOR_S }));
      }
    } catch (error) {
      this.alarm(error.message);
    }
    this.draw();
  }

  /** Give the lease back; one that has ended is given back already. */
  async leave() {
    if (!held.lease) return;
    this.leaving = true;
    try {
      await ask("DELETE", "/lease");
    } catch (error) {
      if (!["lease_over", "lease_unknown"].includes(error.code)) throw error;
    } finally {
      this.leaving = false;
    }
    held.lease = null;
  }

  has(lease) {
    held.lease = lease.lease_id;
    this.told({ ...lease, kind: "lease" });
  }

  /** A second press within some seconds takes over: a dialogue of the browser's would keep STOP out. */
  makeSure() {
    this.sure = true;
    this.draw();
    setTimeout(() => { this.sure = false; this.draw(); }, 5000);
  }

  /** A daemon that was started again knows no lease of before. */
  again() {
    if (held.lease) this.renew();
  }

  async renew() {
    const { lease } = held;
    try {
      await post("/lease/renew", { for_s: FOR_S });
    } catch (error) {
      if (error.status === 0 || held.lease !== lease) return; // the next one may come through
      held.lease = null;
      this.alarm(`You steer no longer: ${error.message}`);
      this.draw();
    }
  }
}

// The reports that the daemon keeps; each opens by itself, where it can do nothing.
import { byId, h, put } from "./dom.js";
import { fileOf, get } from "./api.js";

export class Reports {
  constructor(events) {
    events.addEventListener("connected", () => this.look());
    events.addEventListener("bench", (event) => ["done", "interrupted"].includes(event.detail.value.state) && this.look());
    setInterval(() => document.hidden || this.look(), 60000);
  }

  async look() {
    try {
      const { reports, folder } = await get("/reports");
      put(byId("reports"), reports.length
        ? h("table", { class: "figures list" }, reports.map((one) => h("tr", {}, h("td", {}, one.written.slice(0, 16).replace("T", " ")), h("td", {}, h("a", { class: "report-link", href: fileOf(`/reports/${encodeURIComponent(one.name)}`), target: "_blank", rel: "noopener" }, one.title), " ", h("span", { class: "quiet" }, one.name)))))
        : h("p", { class: "quiet" }, `None yet. Those of bench calibrations come here, and pages that lie in ${folder}.`));
    } catch {
      // told by what was asked before
    }
  }
}

"""The operator page in chromium, of a simulated pair: its bytes, first paint, frames, their age, STOP.

.venv/bin/python -m tools.benchmarks.page [--seconds 10] [--rate 30]
.venv/bin/python -m tools.benchmarks.page --link 50 0.4     50 kB/s and 0.4 s, each way: what it says of age
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
import yaml
from playwright.sync_api import Page, sync_playwright

from mastctl.client import Client
from tools.browser import chromium
from tools.command import end, options
from tools.living_daemon import simulated, started, vitals, written
from tools.throttle import throttled

PAIR = ("navcam_left", "navcam_right")
STOPS = 10
SAID = """seconds => new Promise(done => {
  const shown = [], newest = {}, said = [];
  const hear = ({ detail: one }) => {
    newest[one.camera] = one.mid_exposure_s;
    const age = document.querySelector(`[data-camera=${one.camera}] .age`).textContent;
    const reduced = /reduced to (\\d+)/.exec(age);
    shown.push([one.camera, one.mid_exposure_s, one.shown_ms, Number(reduced?.[1] ?? one.size_px[0])]);
  };
  const look = () => {
    for (const eye of document.querySelectorAll(".eye")) {
      const mid = newest[eye.dataset.camera];
      const old = parseFloat(eye.querySelector(".age").textContent);
      if (mid) said.push([mid, performance.timeOrigin + performance.now(), old, "stale" in eye.dataset]);
    }
  };
  document.addEventListener("image-shown", hear);
  const looking = setInterval(look, 50);
  setTimeout(() => {
    document.removeEventListener("image-shown", hear);
    clearInterval(looking);
    done([shown, said]);
  }, 1000 * seconds);
})"""
SHOWN = """seconds => new Promise(done => {
  const shown = [];
  const hear = event => shown.push([event.detail.camera, event.detail.mid_exposure_s, event.detail.shown_ms]);
  document.addEventListener("image-shown", hear);
  setTimeout(() => { document.removeEventListener("image-shown", hear); done(shown); }, 1000 * seconds);
})"""
CAME = """() => [...performance.getEntriesByType("navigation"), ...performance.getEntriesByType("resource")]
  .filter(one => one.entryType === "navigation" || one.name.includes("/page/"))
  .reduce((sum, one) => sum + one.transferSize, 0)"""
PRESSED = """() => new Promise(done => {
  const button = document.getElementById("stop");
  const began = performance.now();
  const told = new MutationObserver(() => {
    if (button.dataset.pressed !== "confirmed") return;
    told.disconnect();
    done(performance.now() - began);
  });
  told.observe(button, { attributes: true });
  button.dispatchEvent(new PointerEvent("pointerdown", { button: 0, bubbles: true, cancelable: true }));
})"""


def main() -> int:
    """Print a line for each."""
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=30.0, help="of the cameras, Hz")
    parser.add_argument(
        "--link", type=float, nargs=2, metavar=("KB_PER_S", "DELAY_S"), help="of a slow link, each way"
    )
    asked = parser.parse_args()
    path = chromium()
    if path is None:
        parser.error("there is no chromium; python -m tools.browser installs it")
    with tempfile.TemporaryDirectory() as folder:
        config = simulated(Path(folder), "memory", PAIR)
        document = yaml.safe_load(config.read_text())
        document["simulation"]["cameras"] = {"rate_hz": asked.rate}
        written(Path(folder), document)
        with started(config) as (daemon, port), sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 1500, "height": 1000})
            url = f"http://127.0.0.1:{port}"
            if asked.link:
                with throttled(port, 1e3 * asked.link[0], asked.link[1]) as far:
                    slow(page, f"http://127.0.0.1:{far}", asked.seconds)
                browser.close()
                return 0
            page.goto(url)
            for name in PAIR:
                page.wait_for_selector(f".eye[data-camera={name}]:not([data-stale])")
            came = [page.evaluate(CAME)]
            page.goto(url)
            page.wait_for_selector("#state[data-word=ready]")
            came.append(page.evaluate(CAME))
            print(
                f"the page's files: {came[0] / 1e3:.1f} kB at first, {came[1] / 1e3:.1f} kB the second time"
            )
            paint = "performance.getEntriesByName('first-contentful-paint')[0].startTime"
            print(f"first paint {page.evaluate(paint):.0f} ms")
            images(page, daemon.pid, asked.seconds)
            stops(page, url)
            browser.close()
    return 0


def images(page: Page, pid: int, seconds: float) -> None:
    """Frames a second of each camera, from exposure to screen, and the daemon's processor time."""
    before, began_s = vitals(pid).cpu_s, time.monotonic()
    shown = page.evaluate(SHOWN, seconds)
    took_s = time.monotonic() - began_s
    used = (vitals(pid).cpu_s - before) / took_s
    ahead_s = time.time() - time.monotonic()
    for name in PAIR:
        ages = [shown_ms - 1e3 * (mid_s + ahead_s) for camera, mid_s, shown_ms in shown if camera == name]
        print(
            f"{name}: {len(ages) / seconds:.1f} frames/s, glass to page median {np.median(ages):.0f} ms, "
            f"95 % {np.percentile(ages, 95):.0f} ms"
        )
    print(f"daemon: {100 * used:.0f} % of a core")


def slow(page: Page, url: str, seconds: float) -> None:
    """How often images come over a slow link, how old they are, and how old the page says they are."""
    began_s = time.monotonic()
    page.goto(url, wait_until="commit")
    for name in PAIR:
        page.wait_for_selector(f".eye[data-camera={name}]:not([data-stale])", timeout=120_000)
    print(f"first images after {time.monotonic() - began_s:.1f} s")
    shown, said = page.evaluate(SAID, seconds)
    ahead_s = time.time() - time.monotonic()
    for name in PAIR:
        mine = [(mid_s, shown_ms, width) for camera, mid_s, shown_ms, width in shown if camera == name]
        apart_s = np.diff([1e-3 * shown_ms for _, shown_ms, _ in mine])
        ages_s = [1e-3 * shown_ms - mid_s - ahead_s for mid_s, shown_ms, _ in mine]
        print(
            f"{name}: {len(mine)} images in {seconds:g} s, at most {max(apart_s, default=np.inf):.2f} s "
            f"apart, {np.median(ages_s):.2f} s old when they come, {max(ages_s):.2f} s at most, "
            f"{np.median([width for *_, width in mine]):.0f} px wide"
        )
    wrong_s = [old - (1e-3 * at_ms - mid_s - ahead_s) for mid_s, at_ms, old, _ in said]
    hatched = np.mean([stale for *_, stale in said])
    print(
        f"the age that is told less the true one: {np.mean(wrong_s):+.3f} s on average, "
        f"{min(wrong_s):+.3f} to {max(wrong_s):+.3f} s in {len(said)} looks, "
        f"{100 * np.mean(np.abs(wrong_s) > 0.2):.1f} % of them more than 0.2 s; "
        f"hatched in {100 * hatched:.0f} %"
    )


def stops(page: Page, url: str) -> None:
    """From the press during a motion until the head has confirmed."""
    took_ms = []
    with Client(url, name="benchmark") as client:
        for k in range(STOPS):
            moving = client.point(pan_rad=2.0 if k % 2 else -2.0, tilt_rad=-0.2)
            page.wait_for_selector("#state[data-word=moving]")
            took_ms.append(page.evaluate(PRESSED))
            client.wait(moving)
            page.wait_for_selector("#stop:not([data-pressed=confirmed])")
    print(f"STOP: confirmed after {np.median(took_ms):.0f} ms, worst of {STOPS}: {max(took_ms):.0f} ms")


if __name__ == "__main__":
    end(main)

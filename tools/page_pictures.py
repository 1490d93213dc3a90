"""Takes the screenshots of the operator page that README and docs show, of the simulated rover.

.venv/bin/python -m tools.page_pictures [--out docs/img]
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from playwright.sync_api import Browser, Page, sync_playwright

from mastctl.client import Client
from mastctl.packaged import config_folder
from tools.browser import chromium
from tools.command import end, options
from tools.living_daemon import simulated, started, written

CAMERAS = ("pancam_left", "pancam_right", "navcam_left", "navcam_right", "hazcam_left", "hazcam_right")
DESK = {"width": 1500, "height": 1000}
TABLET = {"width": 820, "height": 1180}
TALL = {"width": 1500, "height": 1240}
STONE = (0.5, 0.62)  # beside the larger rock, as the head looks then
PATIENCE_MS = 600_000.0  # a step of a bench takes minutes on a machine with much else to do
STEPS_M = (0.3, 0.6, 0.9, 1.2, 1.5)
FRESH = ".eye[data-camera=navcam_left]:not([data-stale])", ".eye[data-camera=navcam_right]:not([data-stale])"
ROCK = (
    0.857,
    0.88,
)  # of the image's width and height: its middle, since at its rim the ground behind matches too


def main() -> int:
    """Take them all."""
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("--out", type=Path, default=Path("docs/img"))
    parser.add_argument("--only", choices=("rover", "bench"), help="those of one of both")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    path = chromium()
    if path is None:
        parser.error("there is no chromium; python -m tools.browser installs it")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        if args.only != "bench":
            rover(browser, Path(folder), args.out)
        if args.only != "rover":
            bench(browser, Path(folder), args.out)
        browser.close()
    return 0


def rover(browser: Browser, folder: Path, out: Path) -> None:
    """Pointing, and what goes wrong."""
    with started(simulated(folder, "memory", CAMERAS)) as (_, port):
        url = f"http://127.0.0.1:{port}"
        with Client(url, name="pictures") as client:
            client.wait(client.point(pan_rad=0.03, tilt_rad=-0.17))
            dark = browser.new_context(viewport=DESK, color_scheme="dark").new_page()
            pointed(dark, url, out)
            dark.close()
            desk = browser.new_context(viewport=TALL, color_scheme="light").new_page()
            followed(desk, url, client, out)
            desk.close()
            light = browser.new_context(viewport=TABLET, color_scheme="light", has_touch=True).new_page()
            on_a_tablet(light, url, client, out)
            light.close()


def opened(page: Page, url: str) -> None:
    page.goto(url)
    for each in FRESH:
        page.wait_for_selector(each)


def pointed(page: Page, url: str, out: Path) -> None:
    """A click before anything moves, and the residual after it."""
    opened(page, url)
    frame = page.locator(".eye[data-camera=navcam_left] .frame")
    box: Any = frame.bounding_box()
    at = box["x"] + ROCK[0] * box["width"], box["y"] + ROCK[1] * box["height"]
    page.mouse.click(*at)
    page.wait_for_selector("#target[data-state=preview]")
    kept(page, out / "page_click.jpg")
    page.keyboard.press("p")
    page.wait_for_selector("#inset svg .vector", timeout=90_000)
    for each in FRESH:
        page.wait_for_selector(each)
    page.mouse.move(10, 990)
    page.wait_for_timeout(1500)
    kept(page, out / "page.jpg")


def followed(page: Page, url: str, client: Client, out: Path) -> None:
    """A target that is followed while the rover drives up to it."""
    client.pose(**client.true_pose())
    client.wait(client.point(pan_rad=0.03, tilt_rad=-0.17))
    opened(page, url)
    box: Any = page.locator(".eye[data-camera=navcam_left] .frame").bounding_box()
    x, y = box["x"] + STONE[0] * box["width"], box["y"] + STONE[1] * box["height"]
    page.mouse.move(x - 20, y - 20)
    page.mouse.down()
    page.mouse.move(x + 20, y + 20, steps=4)
    page.mouse.up()
    page.get_by_role("button", name="Follow it").click()
    page.wait_for_selector("#track .word.tracking", timeout=90_000)
    for ahead_m in STEPS_M:
        client.stand(ahead_m, 0.0, 0.0)
        client.wait_track(client.pose(**client.true_pose(), sigma=(0.01, 0.009))["operation"])
    page.wait_for_selector("#track .errors[aria-label*=truly]")
    page.locator("#simulation").evaluate(  # those below it name a folder for a minute
        "panel => { while (panel = panel.nextElementSibling) panel.hidden = true; }"
    )
    page.mouse.move(10, TALL["height"] - 10)
    page.wait_for_timeout(1500)
    kept(page, out / "page_track.jpg")
    page.get_by_role("button", name="End the track").click()
    page.wait_for_selector("#track .word.stopped")
    client.stand(0.0, 0.0, 0.0)
    client.pose(**client.true_pose())


def on_a_tablet(page: Page, url: str, client: Client, out: Path) -> None:
    """A camera that has stopped, with its fault; then an emergency stop."""
    opened(page, url)
    client.set_fault("navcam_left", "off")
    page.wait_for_selector(".eye[data-camera=navcam_left][data-stale]")
    page.wait_for_selector("#faults li")
    kept(page, out / "page_fault.jpg")
    client.clear_faults()
    client.estop(name="Ana", reason="a cable chain caught on the deck")
    page.wait_for_selector("#estop:not([hidden])")
    for each in FRESH:
        page.wait_for_selector(each)
    kept(page, out / "page_stopped.jpg")
    client.reset(name="Ana", reason="the chain is free")


def bench(browser: Browser, folder: Path, out: Path) -> None:
    """A bench calibration that asks for its second placement."""
    page = browser.new_context(viewport=DESK, color_scheme="light").new_page()
    page.set_default_timeout(PATIENCE_MS)
    with started(bench_config(folder)) as (_, port):
        url = f"http://127.0.0.1:{port}"
        opened(page, url)
        with Client(url, name="pictures") as client:
            client.begin_bench("charuco_a2", by_hand=True)
            page.wait_for_selector(".stands:visible")
            client.board_stands()
        page.wait_for_selector(".bench-words:has-text('p2: put')", timeout=900_000)
        page.locator(".panel.bench").evaluate("panel => panel.scrollIntoView({block: 'end'})")
        page.wait_for_timeout(1500)
        kept(page, out / "page_bench.jpg")


def bench_config(folder: Path) -> Path:
    """The packaged bench with a mast file, and a state, of its own."""
    packaged = config_folder()
    document = yaml.safe_load((packaged / "bench.yaml").read_text())
    (folder / "mast.yaml").write_bytes((packaged / document["mast_file"]).read_bytes())
    simulation = {**document["simulation"], "rover": str(packaged / document["simulation"]["rover"])}
    simulation |= {"samples": 1, "cameras": {"rate_hz": 2.0}, "speed": 3.0}
    own = {"mast_file": "mast.yaml", "listen": {"port": 0}, "state": {"folder": str(folder / "state")}}
    return written(folder, {**document, **own, "simulation": simulation})


def kept(page: Page, path: Path) -> None:
    """Write a screenshot as a small JPEG."""
    image = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 74])
    print(path)


if __name__ == "__main__":
    end(main)

"""Takes the screenshots of the operator page that README and docs show, of the simulated rover.

.venv/bin/python -m tools.page_pictures [--out docs/img]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from playwright.sync_api import Page, sync_playwright

from mastctl.client import Client
from tools.arguments import end
from tools.browser import chromium
from tools.living_daemon import simulated, started

CAMERAS = ("pancam_left", "pancam_right", "navcam_left", "navcam_right", "hazcam_left", "hazcam_right")
DESK = {"width": 1500, "height": 1000}
TABLET = {"width": 820, "height": 1180}
FRESH = ".eye[data-camera=navcam_left]:not([data-stale])", ".eye[data-camera=navcam_right]:not([data-stale])"
ROCK = (0.857, 0.862)  # of the image's width and height


def main() -> int:
    """Take them all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/img"))
    out = parser.parse_args().out
    path = chromium()
    if path is None:
        parser.error("there is no chromium; python -m tools.browser installs it")
    with (
        tempfile.TemporaryDirectory() as folder,
        started(simulated(Path(folder), "memory", CAMERAS)) as (_, port),
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        url = f"http://127.0.0.1:{port}"
        with Client(url, name="pictures") as client:
            client.wait(client.point(pan_rad=0.03, tilt_rad=-0.17))
            dark = browser.new_context(viewport=DESK, color_scheme="dark").new_page()
            pointed(dark, url, out)
            dark.close()
            light = browser.new_context(viewport=TABLET, color_scheme="light", has_touch=True).new_page()
            on_a_tablet(light, url, client, out)
            light.close()
        browser.close()
    return 0


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


def on_a_tablet(page: Page, url: str, client: Client, out: Path) -> None:
    """A camera that has stopped, with its fault; then an emergency stop."""
    opened(page, url)
    client.set_fault("navcam_left", "off")
    page.wait_for_selector(".eye[data-camera=navcam_left][data-stale]")
    page.wait_for_selector("#faults li")
    kept(page, out / "page_fault.jpg")
    client.clear_faults()


def kept(page: Page, path: Path) -> None:
    """Write a screenshot as a small JPEG."""
    image = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 74])
    print(path)


if __name__ == "__main__":
    end(main)

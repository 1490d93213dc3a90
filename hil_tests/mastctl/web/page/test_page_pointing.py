"""The operator page in a real browser on the simulated rover: from a click to the measured residual."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from hil_tests.mastctl.web.page.conftest import Visit
from hil_tests.support.living_daemon import simulated, written
from hil_tests.waiting import NET_S, until
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon
from mastctl.panorama.folder import Folder

Visits = Callable[..., Visit]


@pytest.fixture(scope="module")
def rover(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    """A rover whose clock stands while it draws: on a busy machine no deadline runs out."""
    folder = tmp_path_factory.mktemp("rover")
    config = simulated(folder, "memory", ("navcam_left", "navcam_right"))
    document = yaml.safe_load(config.read_text())
    document["simulation"]["speed"] = 3.0
    with RunningDaemon(load_config(written(folder, document))) as daemon:
        yield daemon


def test_a_rock_is_clicked_pointed_at_and_its_residual_read(rover: RunningDaemon, visit: Visits) -> None:
    before = len(rover.service.operations.all())
    one = visit(rover.url)
    one.frame("navcam_right")
    assert one.page.locator("#hardware").inner_text() == "SIMULATED"
    words = one.choose(part=(0.45, 0.82))
    assert re.search(r"\d\.\d{3} ± 0\.\d{3} m", words), words
    assert len(rover.service.operations.all()) == before, "nothing was asked to move"
    one.page.keyboard.press("p")
    words = one.target("ended")
    figures = re.findall(r"[xy] ([+−]?\d+\.\d{3}) ± (\d\.\d{3}) px", words)
    assert len(figures) == 2, words
    record: Any = rover.service.operations.all()[0].as_json()
    for (told, sigma), value, expected in zip(
        figures, record["residual_px"], record["residual_sigma_px"], strict=True
    ):
        assert float(told.replace("−", "-")) == pytest.approx(value, abs=6e-4)
        assert float(sigma) == pytest.approx(expected, abs=6e-4)
    one.page.wait_for_selector("#inset svg .vector")
    truly = re.findall(r"[+−]?\d\.\d{3}", one.page.locator("#truly").inner_text())
    asked = record["request"]["pixel"]
    with Client(rover.url) as client:
        place = client.truth(asked["frame_id"], pixel=(asked["x_px"], asked["y_px"]))["position_in_site_m"]
        assert place is not None
        assert_truly(truly, client, place, record)
        one.page.wait_for_selector(".eye[data-camera=navcam_left] .over .aim")
        one.page.locator("#again").click()
        until(lambda: len(rover.service.operations.all()) == before + 2, "a second pointing was begun")
        one.target("ended")
        again = rover.service.operations.all()[0].as_json()
        assert again["state"] == "done"
        assert again["request"]["pixel"] == asked, "the target is what was clicked first"
        one.page.wait_for_selector("#truly")
        truly = re.findall(r"[+−]?\d\.\d{3}", one.page.locator("#truly").inner_text())
        assert_truly(truly, client, place, again)


def assert_truly(truly: list[str], client: Client, place: list[float], record: Any) -> None:
    """What is told as true is where a point of the site lies in the last image, less the aim."""
    last = record["pointings"][-1]
    there = client.truth(last["frame_id"], position_in_site_m=place)["pixel_px"]
    assert there is not None
    for told, value, aim in zip(truly, there, last["aim_px"], strict=True):
        assert float(told.replace("−", "-")) == pytest.approx(value - aim, abs=6e-4)


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """A panorama's views after the first are kept only once this is set."""
    whole, opened = Folder.keep, threading.Event()

    def keep(folder: Folder, number: int, *rest: Any) -> Any:
        assert number == 0 or opened.wait(NET_S)
        return whole(folder, number, *rest)

    monkeypatch.setattr(Folder, "keep", keep)
    return opened


def click(one: Visit, x: float, y: float) -> str:
    """Click a part of the panorama; what the target's panel says of it."""
    frame = one.page.locator(".pano-frame")
    box = frame.bounding_box()
    frame.click(position={"x": x * box["width"], "y": y * box["height"]})
    return one.target("preview", "refused")


def shown_px(one: Visit) -> list[float]:
    """The part of the mosaic that is shown: x, y, width, height."""
    return [float(part) for part in one.page.locator(".pano-frame svg").get_attribute("viewBox").split()]


def test_a_panorama_grows_is_clicked_and_its_targets_are_kept(
    rover: RunningDaemon, visit: Visits, gate: threading.Event
) -> None:
    one = visit(rover.url)
    one.word("ready")
    for at, value in enumerate(("-30", "30", "-32", "-10")):
        one.page.fill(f"#pano-{at}", value)
    one.page.get_by_role("button", name="Take a panorama").click()
    one.page.wait_for_selector(".pano-frame image[href$='picture?views=1']")
    one.page.wait_for_selector("#pano-state:has-text('Taking: 1 of')")
    one.page.keyboard.press("Escape")
    gate.set()
    one.page.wait_for_selector("#pano-state:has-text('Ended early')")
    one.page.get_by_role("button", name="Go on").click()
    one.page.wait_for_selector("#seams:has-text('px rms in x and y')")
    one.page.wait_for_selector(".pano-frame image[href*='preview.jpg']")
    one.page.wait_for_selector(".pano-frame .head-view")

    assert re.search(r"\d\.\d{3} ± 0\.\d{3} m", click(one, 0.4, 0.75))
    (name,) = {json.loads(body)["panorama"]["id"] for body in one.posts("/point/preview")}
    assert not one.posts("/point")
    one.page.wait_for_selector(".pano-frame .click")
    one.page.fill("#keep-target input", "rock")
    one.page.click("#keep-target button")
    one.page.wait_for_selector("#kept-targets:has-text('rock')")
    one.page.wait_for_selector(".pano-frame text:has-text('rock')")
    one.page.locator(".pano-frame").press("p")
    assert "Residual in the new image" in one.target("ended")
    record: Any = rover.service.operations.all()[0].as_json()
    assert record["request"]["panorama"]["id"] == name
    one.page.wait_for_selector(".eye[data-camera=navcam_left] .over .kept")

    one.page.locator(".pano-frame").focus()
    whole = shown_px(one)
    one.page.keyboard.press("+")
    one.page.keyboard.press("+")
    one.page.keyboard.press("Shift+ArrowRight")
    assert shown_px(one)[2] < 0.7 * whole[2]
    one.page.keyboard.press("Enter")
    one.target("preview")
    one.page.keyboard.press("Home")
    assert shown_px(one) == whole
    one.page.locator(".pano-frame").hover()
    one.page.mouse.wheel(0.0, -300.0)
    until(lambda: shown_px(one)[2] < 0.7 * whole[2], "the wheel zooms")

    for scheme in ("dark", "light"):
        one.page.emulate_media(color_scheme=scheme)
        assert not one.serious(".panorama"), scheme
    one.page.set_viewport_size({"width": 390, "height": 844})
    assert one.page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
    click(one, 0.5, 0.5)
    one.page.locator("#point").wait_for(state="visible")

    with one.page.expect_download() as table:
        one.page.get_by_role("link", name="CSV").click()
    assert (
        Path(table.value.path()).read_text().startswith('name,frame,x_m,y_m,z_m,covariance_m2\n"rock",site,')
    )
    with one.page.expect_download() as document:
        one.page.get_by_role("link", name="JSON").click()
    (feature,) = json.loads(Path(document.value.path()).read_text())["features"]
    assert len(feature["properties"]["covariance_m2"]) == 3
    one.page.get_by_role("button", name="Point at rock").click()
    assert "a position has no picture" in one.target("ended")
    assert json.loads(one.posts("/point")[-1])["position_m"] == feature["geometry"]["coordinates"]
    one.page.get_by_role("button", name="Forget rock").click()
    one.page.wait_for_selector("#kept-targets:not(:has-text('rock'))", state="attached")

    with Client(rover.url) as client:
        try:
            client.stand(3.0, 2.0, 1.0)
            click(one, 0.4, 0.75)
            one.page.locator("#point").click()
            assert "has changed since the panorama" in one.target("ended")
            one.page.get_by_role("button", name="Point by direction alone").click()
            one.page.wait_for_selector("#target:has-text('no residual')")
        finally:
            client.stand(0.0, 0.0, 0.0)

"""The operator page in a real browser on the simulated rover: from a click to the measured residual."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

import pytest

from hil_tests.mastctl.service_fakes import eventually
from hil_tests.mastctl.web.page.conftest import Visit
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon
from tools.living_daemon import simulated

Visits = Callable[..., Visit]


@pytest.fixture(scope="module")
def rover(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    config = simulated(tmp_path_factory.mktemp("rover"), "memory", ("navcam_left", "navcam_right"))
    with RunningDaemon(load_config(config)) as daemon:
        yield daemon


def test_a_rock_is_clicked_pointed_at_and_its_residual_read(rover: RunningDaemon, visit: Visits) -> None:
    one = visit(rover.url)
    one.frame("navcam_right")
    assert one.page.locator("#hardware").inner_text() == "SIMULATED"
    words = one.choose(part=(0.45, 0.82))
    assert re.search(r"\d\.\d{3} ± 0\.\d{3} m", words), words
    assert not rover.service.operations.all(), "nothing was asked to move"
    one.page.keyboard.press("p")
    words = one.target("ended")
    figures = re.findall(r"[xy] ([+−]?\d+\.\d{3}) ± (\d\.\d{3}) px", words)
    assert len(figures) == 2, words
    record = rover.service.operations.all()[0].told()
    for (told, sigma), value, expected in zip(
        figures, record["residual_px"], record["residual_sigma_px"], strict=True
    ):
        assert float(told.replace("−", "-")) == pytest.approx(value, abs=6e-4)
        assert float(sigma) == pytest.approx(expected, abs=6e-4)
    one.page.wait_for_selector("#inset svg .vector")
    one.page.wait_for_selector(".eye[data-camera=navcam_left] .over .aim")
    one.page.locator("#again").click()
    eventually(lambda: len(rover.service.operations.all()) == 2, "a second pointing was begun")
    one.target("ended")
    assert rover.service.operations.all()[0].told()["state"] == "done"


def test_a_box_round_a_rock_begins_a_track_that_is_drawn_in_both_eyes(
    rover: RunningDaemon, visit: Visits
) -> None:
    one = visit(rover.url)
    one.frame("navcam_right")
    frame = one.frame()
    box = frame.bounding_box()
    x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.62 * box["height"]
    one.page.mouse.move(x - 20, y - 20)
    one.page.mouse.down()
    one.page.mouse.move(x + 20, y + 20, steps=4)
    one.page.mouse.up()
    one.page.wait_for_selector("#track .word.tracking, #track .word.lost, #track .bad")
    assert "tracking" in one.page.locator("#track").inner_text(), one.page.locator("#track").inner_text()
    for camera in ("navcam_left", "navcam_right"):
        one.page.wait_for_selector(f".eye[data-camera={camera}] .over .track")
    one.page.get_by_role("button", name="Look again").click()
    one.page.wait_for_selector("#track .approach.errors .newest", state="attached")
    assert "mm at" in one.page.locator("#track .approach.errors").get_attribute("aria-label")
    one.page.get_by_role("button", name="End the track").click()
    eventually(lambda: rover.service.tracker.status.state == "stopped", "the track has ended")


def test_a_fault_from_the_drawer_is_set_told_and_cleared(rover: RunningDaemon, visit: Visits) -> None:
    one = visit(rover.url)
    one.frame()
    one.page.get_by_label("Device").select_option("navcam_left")
    one.page.get_by_label("Fault", exact=True).select_option("off")
    one.page.get_by_role("button", name="Set", exact=True).click()
    one.page.wait_for_selector(".eye[data-camera=navcam_left][data-stale]")
    one.page.wait_for_selector("#faults li")
    one.page.get_by_role("button", name="Clear all").click()
    one.frame()

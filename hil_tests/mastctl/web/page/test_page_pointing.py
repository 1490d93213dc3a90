"""The operator page in a real browser on the simulated rover: from a click to the measured residual."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from hil_tests.mastctl.web.page.conftest import Visit
from hil_tests.waiting import until
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon
from mastctl.devices import cameras
from tools.living_daemon import simulated, written

Visits = Callable[..., Visit]


@contextmanager
def at_speed(folder: Path, speed: float) -> Iterator[RunningDaemon]:
    """A rover whose clock stands while it draws: on a busy machine no deadline runs out."""
    config = simulated(folder, "memory", ("navcam_left", "navcam_right"))
    document = yaml.safe_load(config.read_text())
    document["simulation"]["speed"] = speed
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(cameras, "GLANCES_SHARE", 0.5)  # the page's pictures matter here
        with RunningDaemon(load_config(written(folder, document))) as daemon:
            yield daemon


@pytest.fixture(scope="module")
def rover(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    with at_speed(tmp_path_factory.mktemp("rover"), 3.0) as daemon:
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
    truly = re.findall(r"[+−]?\d\.\d{3}", one.page.locator("#truly").inner_text())
    asked = record["request"]["pixel"]
    with Client(rover.url) as client:
        place = client.truth(asked["frame_id"], pixel=(asked["x_px"], asked["y_px"]))["position_in_site_m"]
        assert place is not None
        assert_truly(truly, client, place, record)
        one.page.wait_for_selector(".eye[data-camera=navcam_left] .over .aim")
        one.page.locator("#again").click()
        until(lambda: len(rover.service.operations.all()) == 2, "a second pointing was begun")
        one.target("ended")
        again = rover.service.operations.all()[0].told()
        assert again["state"] == "done"
        assert again["request"]["pixel"] == asked, "the target is what was clicked first"
        one.page.wait_for_selector("#truly")
        truly = re.findall(r"[+−]?\d\.\d{3}", one.page.locator("#truly").inner_text())
        assert_truly(truly, client, place, again)


def assert_truly(truly: list[str], client: Client, place: list[float], record: dict[str, Any]) -> None:
    """What is told as true is where a point of the site lies in the last image, less the aim."""
    last = record["pointings"][-1]
    there = client.truth(last["frame_id"], position_in_site_m=place)["pixel_px"]
    assert there is not None
    for told, value, aim in zip(truly, there, last["aim_px"], strict=True):
        assert float(told.replace("−", "-")) == pytest.approx(value - aim, abs=6e-4)


def pan_rad(client: Client) -> float:
    joints = client.status()["joints"]
    assert joints is not None
    return float(joints["pan_rad"])


def test_stop_during_a_motion_ends_it_where_the_head_is(tmp_path: Path, visit: Visits) -> None:
    with (
        at_speed(tmp_path, 0.1) as slow,
        Client(slow.url) as client,
    ):
        one = visit(slow.url)  # its head takes half a minute for a way of some seconds
        one.word("ready")
        began_rad = pan_rad(client)
        operation = client.point(pan_rad=-2.4, tilt_rad=0.0)
        one.word("moving")
        one.page.wait_for_selector(".range .wanted", state="attached")
        until(lambda: pan_rad(client) < began_rad, "it is on its way")
        one.page.keyboard.press("Escape")
        one.page.wait_for_selector("#stop[data-pressed=confirmed]")
        assert client.wait(operation)["state"] == "stopped"
        one.page.wait_for_selector("#state:not([data-word=moving])")
        assert -2.4 < pan_rad(client) < began_rad, "it stands on its way"
        one.page.wait_for_selector(".operation .word.stopped")
        one.page.wait_for_selector(".range .wanted", state="detached")


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
    one.page.get_by_role("button", name="Follow it").click()
    one.page.wait_for_selector("#track .word.tracking, #track .word.lost, #track .bad")
    assert "tracking" in one.page.locator("#track").inner_text(), one.page.locator("#track").inner_text()
    for camera in ("navcam_left", "navcam_right"):
        one.page.wait_for_selector(f".eye[data-camera={camera}] .over .track")
    one.page.get_by_role("button", name="Look again").click()
    plot = one.page.locator("#track .approach.errors")
    one.page.wait_for_selector("#track .approach.errors[aria-label*='truly']")
    words = re.search(r"truly ([\d.]+) mm off, one sigma ([\d.]+) mm at", plot.get_attribute("aria-label"))
    assert words is not None, plot.get_attribute("aria-label")
    truly_mm, sigma_mm = map(float, words.groups())
    assert 0.0 < truly_mm < 6 * sigma_mm
    one.page.locator("#track summary").click()
    row = one.page.locator("#track tr", has_text="navcam").last.inner_text().split()
    assert row[:2] == ["0", "navcam"] and len(row) == 6
    assert "navcam" in one.page.locator("#track .strip").get_attribute("aria-label")
    one.page.get_by_role("button", name="Ahead 0.25 m").click()  # no pose was known when the track began
    one.page.wait_for_selector("#drive-said >> text=/The track has ended: .* is not known/")
    one.page.wait_for_selector("#track .word.stopped")
    assert one.page.locator("#track .figures:not(.list) th", has_text="Truly off").count() == 0
    one.page.wait_for_selector(".over .track", state="detached")
    one.page.get_by_role("button", name="Back 0.25 m").click()
    one.page.wait_for_selector("#simulated >> text=stands at 0.00, 0.00 m")
    frame.focus()
    frame.hover(position={"x": 0.5 * box["width"], "y": 0.5 * box["height"]})  # where the head looks
    for _ in range(2):  # an image from before the drive
        shown = "() => new Promise((go) => document.addEventListener('image-shown', go, {once: true}))"
        frame.evaluate(shown)
    one.page.keyboard.press("t")
    one.page.wait_for_selector("#track .word.tracking, #track .word.idle, #track .bad:not(:empty)")
    assert "tracking" in one.page.locator("#track").inner_text(), one.page.locator("#track").inner_text()
    one.page.get_by_role("button", name="End the track").click()
    until(lambda: rover.service.tracker.status.state == "stopped", "the track has ended")


def test_a_fault_from_the_drawer_is_set_told_and_cleared(rover: RunningDaemon, visit: Visits) -> None:
    one = visit(rover.url, turned=True)
    one.frame()
    one.page.get_by_label("Device").select_option("navcam_left")
    one.page.get_by_label("Fault", exact=True).select_option("slow")
    assert "fraction of what it was" in one.page.locator("#fault-does").inner_text()
    one.page.get_by_label("factor").fill("fast")
    one.page.locator("#simulated").get_by_role("button", name="Set").click()
    one.page.wait_for_selector("#simulated .bad >> text=factor: 'fast' where a number is expected")
    one.page.get_by_label("factor").fill("7")
    one.page.locator("#simulated").get_by_role("button", name="Set").click()
    one.page.wait_for_selector("#simulated .bad >> text=/factor is 7 where .* is expected/")
    one.page.get_by_label("factor").fill("0,5")
    one.page.locator("#simulated").get_by_role("button", name="Set").click()
    one.page.wait_for_selector("#simulated .set >> text=navcam left slow: factor 0.5")
    one.page.get_by_label("Device").select_option("pan_tilt")
    one.page.get_by_label("Fault", exact=True).select_option("wrong")
    one.page.get_by_label("offset").fill("1")
    one.page.get_by_label("axis").select_option("tilt")
    one.page.locator("#simulated").get_by_role("button", name="Set").click()
    one.page.wait_for_selector("#simulated .set >> text=pan tilt wrong: offset 1°, axis tilt")
    with Client(rover.url) as client:
        wrong = next(fault for fault in client.faults() if fault["word"] == "wrong")
    assert wrong["parameters"]["offset_rad"] == pytest.approx(0.0174533, abs=1e-6)
    assert wrong["parameters"]["axis"] == 1
    one.page.get_by_label("Device").select_option("navcam_left")
    one.page.get_by_label("Fault", exact=True).select_option("off")
    one.page.locator("#simulated").get_by_role("button", name="Set").click()
    one.page.wait_for_selector("#faults li")
    told = one.page.locator("#faults").inner_text()
    assert not re.search(r"after \d+\.\d+ s", told), f"no clock's reading: {told}"
    one.wait_long()
    one.page.wait_for_selector(".eye[data-camera=navcam_left][data-stale]")
    one.page.get_by_role("button", name="Clear all").click()
    one.frame()

"""The operator page in a real browser on the simulated rover: from a click to the measured residual."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import yaml

from hil_tests.mastctl.web.page.conftest import Visit
from hil_tests.support.living_daemon import simulated, written
from hil_tests.waiting import until
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon
from mastctl.devices import cameras

Visits = Callable[..., Visit]


@pytest.fixture(scope="module")
def rover(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    """A rover whose clock stands while it draws: on a busy machine no deadline runs out."""
    folder = tmp_path_factory.mktemp("rover")
    config = simulated(folder, "memory", ("navcam_left", "navcam_right"))
    document = yaml.safe_load(config.read_text())
    document["simulation"]["speed"] = 3.0
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(cameras, "WATCHED_SHARE", 0.5)  # the page's pictures matter here
        with RunningDaemon(load_config(written(folder, document))) as daemon:
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
        until(lambda: len(rover.service.operations.all()) == 2, "a second pointing was begun")
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

"""The packaged rover on its worst day: what a program that trusts too much gets, and what is reached."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hil_tests.waiting import present, until
from mastctl.config import Listen, load_config
from mastctl.motion.requests import PixelTarget, PointRequest
from mastctl.packaged import config_folder
from mastctl.service.service import Service

AIM_PX = (511.5, 383.5)
CLICKS = ((300.0, 420.0), (700.0, 500.0), (450.0, 600.0))


@contextmanager
def worst_day(**head: Any) -> Iterator[Service]:
    """The service on the rover's own clock, with some of the head's options changed."""
    config = load_config(config_folder() / "worst_day.yaml")
    asked = config.hardware.simulation
    simulation = {**asked, "speed": "max", "samples": 1, "head": {**asked["head"], **head}}
    hardware = replace(config.hardware, simulation=simulation)
    service = Service.open(replace(config, hardware=hardware, listen=Listen(port=0)))
    try:
        yield service
    finally:
        service.close()


def pointed(service: Service, pixel_px: tuple[float, float]) -> tuple[Any, np.ndarray[Any, Any]]:
    """A click, pointed at: the operation, and where the clicked thing is in a picture of later, px off."""
    frame = service.snapshot("navcam_left", fresh=True)
    rover = service.hardware.simulation
    assert rover is not None
    point_m = present(rover.true_point("navcam_left", frame.sequence, pixel_px))
    name = service.steering.point(
        PointRequest(pixel=PixelTarget("navcam_left", frame.frame_id, *pixel_px), pointings=2)
    ).id
    until(lambda: service.operations.get(name).ended_s is not None, f"the end of operation {name}")
    outcome = service.operations.get(name).as_json()
    service.clock.sleep(30.0)  # until nothing rings any more
    later = service.snapshot("navcam_left", fresh=True)
    return outcome, np.asarray(rover.true_pixel("navcam_left", later.sequence, point_m)) - AIM_PX


@pytest.mark.long(1, "the worst day is rendered with all its lenses and light")
def test_on_the_worst_day_the_second_pointing_lands_and_tells_the_truth() -> None:
    with worst_day() as service:
        for pixel_px in CLICKS:
            outcome, truly_px = pointed(service, pixel_px)
            assert outcome["state"] == "done", outcome["error"]
            assert np.abs(truly_px).max() < 0.4
            off_px = np.abs(truly_px - outcome["residual_px"])
            assert (off_px < 3.0 * np.array(outcome["residual_sigma_px"])).all()


@pytest.mark.long(1, "the worst day is rendered with all its lenses and light")
def test_a_mast_that_does_not_settle_yields_no_residual() -> None:
    with worst_day(settle_s=0.0) as service:
        for pixel_px in CLICKS:
            outcome, _ = pointed(service, pixel_px)
            assert outcome["state"] == "failed" and outcome["error"]["code"] == "not_repeated", outcome

"""A head with one camera, as it is packaged: pointed by the daemon, held against the simulator's truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mastctl.client import Client
from mastctl.config import Listen, load_config
from mastctl.daemon import RunningDaemon
from mastctl.devices.frames import camera_and_sequence
from mastctl.packaged import config_folder

CLICK = 330.0, 520.0


@pytest.fixture(scope="module")
def daemon() -> Iterator[RunningDaemon]:
    config = load_config(config_folder() / "one_camera.yaml")
    simulation = {**config.hardware.simulation, "speed": "max"}
    hardware = replace(config.hardware, simulation=simulation)
    with RunningDaemon(replace(config, listen=Listen(port=0), hardware=hardware)) as running:
        yield running


def off_px(daemon: RunningDaemon, clicked_id: str, row: dict[str, Any]) -> np.ndarray:
    """The true residual of a pointing."""
    rover = daemon.hardware.simulation
    assert rover is not None
    point = rover.true_point(*camera_and_sequence(clicked_id), CLICK)
    assert point is not None
    return np.asarray(rover.true_pixel(*camera_and_sequence(str(row["frame_id"])), point) - row["aim_px"])


@pytest.mark.parametrize("given", [{"plane": {"point_m": [0.0, 0.0, 0.0]}}, {}])
def test_a_pixel_is_pointed_at_and_the_second_time_well(
    daemon: RunningDaemon, given: dict[str, object]
) -> None:
    with Client(daemon.url) as client:
        client.wait(client.point(pan_rad=0.1, tilt_rad=-0.2))
        shot = client.snapshot("navcam")
        record: Any = client.wait(
            client.point(pixel=("navcam", shot.frame_id, *CLICK), pointings=2, **given)  # type: ignore[arg-type]
        )
    assert record["state"] == "done", record["error"]
    first, second = (off_px(daemon, shot.frame_id, row) for row in record["pointings"])
    for row, off in zip(record["pointings"], (first, second), strict=True):
        assert np.abs(np.array(row["residual_px"]) - off).max() < 0.2
        away = off + row["aim_px"] - row["predicted_px"]
        assert away @ np.linalg.solve(row["predicted_covariance_px2"], away) < 9.2
    assert np.abs(second).max() < 0.5
    assert record["range_from"] == ("plane" if given else "parallax")
    assert record["range_interval_m"][0] <= record["range_m"]
    kinds = [step["name"] for step in record["steps"]]
    assert kinds.count("range") == 2 and "stereo" not in kinds

"""A head alone, as on the bench before anything is mounted; and a rig of which one eye is configured."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from calib.files.mast_file import save_rig
from hil_tests.mastctl.service_fakes import HTTP, FakeHardware, rig
from hil_tests.waiting import until
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon

BARE_MAST = """
schema: mastctl/mast/1
name: bare_head
mast: {translation_m: [0, 0, 0], rotation_rad: [0, 0, 0]}
cameras: {}
"""

CONFIG = """
schema: mastctl/config/1
mast_file: little.yaml
listen: {port: 0}
pan_tilt: {driver: fake}
limits: {pan_rad: [-2.0, 2.0], tilt_rad: [-1.0, 1.0], speed_rad_per_s: 0.5}
"""

ANGLES: dict[str, object] = {"pan_rad": 0.3, "tilt_rad": -0.2}


def started(monkeypatch: pytest.MonkeyPatch, folder: Path, mast: str) -> RunningDaemon:
    """A daemon on fakes whose configuration has no cameras."""
    hardware = FakeHardware(())
    if mast:
        (folder / "little.yaml").write_text(mast)
    else:
        save_rig(rig(), folder / "little.yaml")
    (folder / "daemon.yaml").write_text(CONFIG)
    monkeypatch.setattr("mastctl.devices.opening.open_hardware", lambda settings, clock: hardware)
    return RunningDaemon(load_config(folder / "daemon.yaml"))


@pytest.fixture(scope="module", params=["", "bare"])
def bare(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Iterator[RunningDaemon]:
    """A head alone: none is configured, or the mast file has no cameras either."""
    folder, mast = tmp_path_factory.mktemp("bare"), BARE_MAST if request.param == "bare" else ""
    with pytest.MonkeyPatch.context() as patch, started(patch, folder, mast) as daemon:
        yield daemon


def outcome(daemon: RunningDaemon, command: str, body: dict[str, object]) -> dict[str, Any]:
    """The error object of a request or of its operation; empty where it was done."""
    answer = HTTP.post(f"{daemon.url}/api/v1/{command}", json=body)
    if answer.status_code != 202:
        error = answer.json()["error"]
        assert 400 <= answer.status_code < 500, answer.text
    else:
        place = f"{daemon.url}/api/v1/operations/{answer.json()['id']}"
        until(lambda: HTTP.get(place).json()["state"] not in ("queued", "running"), "the end")
        error = HTTP.get(place).json()["error"] or {}
    assert isinstance(error, dict)
    return error


def test_a_head_without_cameras_is_moved_by_angles(bare: RunningDaemon) -> None:
    status = HTTP.get(f"{bare.url}/api/v1/status").json()
    assert status["state"] == "ready" and not status["cameras"] and status["faults"] == []
    assert outcome(bare, "point", ANGLES) == {}
    assert HTTP.get(f"{bare.url}/api/v1/status").json()["joints"]["pan_rad"] == 0.3


PIXEL = {"pixel": {"camera": "navcam_left", "frame_id": "navcam_left-000001-0-0", "x_px": 3, "y_px": 4}}
PLACE = {"position_m": [6.0, 1.0, 0.0], "frame": "rover"}
AIMED = {"position_m": [6.0, 1.0, 0.0], "aim": {"camera": "navcam_left", "x_px": 3, "y_px": 4}}


@pytest.mark.parametrize(
    ("command", "body"),
    [("point", PIXEL), ("point", PLACE), ("point", AIMED), ("track", PIXEL), ("track", PLACE)],
)
def test_what_needs_a_picture_is_refused_in_a_sentence(
    bare: RunningDaemon, body: dict[str, object], command: str
) -> None:
    calls = bare.hardware.head.calls  # type: ignore[attr-defined]
    before = list(calls)
    error = outcome(bare, command, body)
    assert "mast file has no" not in error["message"], "the mast file is not what lacks it"
    assert re.search("configured|no longer kept|not kept|unknown", error["message"]), error
    assert "move" not in {call[0] for call in calls[len(before) :]}

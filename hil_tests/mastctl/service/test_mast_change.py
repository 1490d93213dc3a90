"""Another mast file while the daemon runs, and back: what is refused, what old frames are worth."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.covariance import stored_covariance
from calib.geometry.rig import Mast, RigCamera
from calib.geometry.sensor_mode import SensorMode
from drivers.errors import NoReply
from hil_tests.mastctl.service_fakes import PLAIN, FakeHardware, ScriptedLoop, rig
from hil_tests.waiting import NET_S, until
from mastctl.daemon import RunningDaemon
from mastctl.errors import Stopped
from mastctl.motion.jog import Beat
from mastctl.service import steering as steering_module
from mastctl.service.masts import configured


@pytest.fixture
def daemon(pair: tuple[RunningDaemon, FakeHardware]) -> RunningDaemon:
    return pair[0]


@pytest.fixture
def folder(daemon: RunningDaemon) -> Path:
    """The folder of the mast file, with a second one in it."""
    return with_another(daemon)


def with_another(daemon: RunningDaemon) -> Path:
    where = daemon.service.config.mast_file.parent
    moved = replace(rig(), name="better", mast=Mast(np.array([0.31, 0.0, -1.41]), np.zeros(3)))
    save_rig(moved, where / "better.yaml")
    return where


@pytest.fixture
def web(daemon: RunningDaemon) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=f"{daemon.url}/api/v1", **PLAIN) as client:
        yield client


@pytest.fixture
def quiet(standing: tuple[RunningDaemon, FakeHardware]) -> Iterator[httpx.Client]:
    """A client of the standing daemon; afterwards its mast file is the one that it was."""
    with_another(standing[0])
    with httpx.Client(base_url=f"{standing[0].url}/api/v1", **PLAIN) as client:
        before = in_use(client)
        yield client
        assert in_use(client) == before


def refusal(answer: httpx.Response, status: int, code: str) -> str:
    assert answer.status_code == status, answer.text
    assert answer.json()["error"]["code"] == code
    return str(answer.json()["error"]["message"])


def in_use(web: httpx.Client) -> str:
    return str(web.get("/status").json()["mast"]["digest"])


def test_another_mast_file_is_used_from_now_on(web: httpx.Client, folder: Path) -> None:
    wanted = load_rig(folder / "better.yaml")
    before = in_use(web)
    answer = web.post("/mast", json={"file": "better.yaml"})
    assert answer.status_code == 200, answer.text
    assert answer.json()["mast"] == {"file": "better.yaml", "name": "better", "digest": wanted.digest}
    assert answer.json()["former_mast"]["digest"] == before
    assert in_use(web) == wanted.digest
    mast = web.get("/mast")
    assert mast.content == (folder / "better.yaml").read_bytes()
    assert mast.headers["X-Mastctl-Mast-Digest"] == wanted.digest
    shot = web.get("/snapshot/navcam_left")
    assert shot.headers["X-Mastctl-Mast-Digest"] == wanted.digest


@pytest.mark.parametrize("way", ["back", "previous"])
def test_the_former_comes_back_as_it_was_though_its_file_changed(
    web: httpx.Client, daemon: RunningDaemon, folder: Path, way: str
) -> None:
    before, content = in_use(web), web.get("/mast").content
    assert web.post("/mast", json={"file": "better.yaml"}).status_code == 200
    daemon.service.config.mast_file.write_text("schema: nothing\n")
    answer = web.post("/mast/back") if way == "back" else web.post("/mast", json={"previous": True})
    assert answer.status_code == 200, answer.text
    assert in_use(web) == before
    assert web.get("/mast").content == content
    assert answer.json()["former_mast"]["file"] == "better.yaml"


def test_there_is_nothing_to_go_back_to_at_first(web: httpx.Client) -> None:
    refusal(web.post("/mast/back"), 409, "no_former_mast")


def test_frames_of_the_other_mast_file_are_refused_by_name(web: httpx.Client, folder: Path) -> None:
    frame = web.get("/snapshot/navcam_left").headers["X-Mastctl-Frame-Id"]
    pixel = {"camera": "navcam_left", "frame_id": frame, "x_px": 10.0, "y_px": 10.0}
    web.post("/mast", json={"file": "better.yaml"})
    refusal(web.post("/point", json={"pixel": pixel}), 409, "other_mast_file")
    web.post("/mast/back")
    assert web.post("/point", json={"pixel": pixel}).status_code == 404, "frames of before do not come back"


def test_the_loop_points_by_the_new_mast_file(
    web: httpx.Client, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rigs: list[str] = []

    class Loop(ScriptedLoop):
        def __init__(self, used: Any, *rest: Any, **more: Any) -> None:
            rigs.append(used.name)
            super().__init__(used, *rest, **more)

    monkeypatch.setattr(steering_module, "PointingLoop", Loop)
    web.post("/mast", json={"file": "better.yaml"})
    assert rigs == ["better"]


def test_nothing_changes_while_the_head_moves(
    web: httpx.Client, pair: tuple[RunningDaemon, FakeHardware], folder: Path
) -> None:
    before = in_use(web)
    pair[1].head.moving = True
    refusal(web.post("/mast", json={"file": "better.yaml"}), 409, "moving")
    assert in_use(web) == before


def test_no_jog_begins_between_the_check_that_the_head_rests_and_the_other_mast_file(
    pair: tuple[RunningDaemon, FakeHardware],
) -> None:
    service = pair[0].service
    with ThreadPoolExecutor(1) as pool:
        with service.masts.resting():
            jog = pool.submit(service.jogs.beat, Beat((0.1, 0.0)))
            with pytest.raises(TimeoutError):
                jog.result(0.2)
            assert service.operations.running is None
        assert jog.result(60.0)["taken"]


def test_nothing_changes_while_the_head_is_silent(
    web: httpx.Client, pair: tuple[RunningDaemon, FakeHardware], folder: Path
) -> None:
    before = in_use(web)

    def silent(name: str) -> None:
        if name == "read":
            raise NoReply("no answer", device="pan_tilt")

    pair[1].head.hook = silent
    assert web.post("/mast", json={"file": "better.yaml"}).status_code == 504
    assert in_use(web) == before


def test_nothing_changes_while_an_operation_runs(
    web: httpx.Client, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def until_stopped(request: Any, record: Any, cancelled: threading.Event, devices: Any) -> None:
        assert cancelled.wait(NET_S)
        raise Stopped("stopped by the test")

    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(until_stopped))
    started = web.post("/point", json={"pan_rad": 0.1, "tilt_rad": -0.1}).json()["id"]
    refusal(web.post("/mast", json={"file": "better.yaml"}), 409, "busy")
    web.post("/stop")
    until(lambda: web.get(f"/operations/{started}").json()["state"] == "stopped", "the end")
    assert web.post("/mast", json={"file": "better.yaml"}).status_code == 200


@pytest.mark.parametrize(
    "name", ["../better.yaml", "/etc/passwd", "missing.yaml", ".hidden", "sub/better.yaml", "..", "a\0b"]
)
def test_only_files_beside_the_configured_one_are_taken(quiet: httpx.Client, name: str) -> None:
    refusal(quiet.post("/mast", json={"file": name}), 422, "bad_mast_file")


def test_bad_files_are_refused_with_the_reason(
    web: httpx.Client, folder: Path, daemon: RunningDaemon
) -> None:
    before = in_use(web)
    (folder / "broken.yaml").write_text("schema: mastctl/mast/1\nname: broken\nmast: 3\ncameras: {}\n")
    assert "mast" in refusal(web.post("/mast", json={"file": "broken.yaml"}), 422, "bad_mast_file")
    little = rig()
    left = little.cameras["navcam_left"]
    others = {
        "lacking": {k: c for k, c in little.cameras.items() if k != "hazcam_left"},
        "on": {**little.cameras, "navcam_left": RigCamera("rover", left.model)},
        "size": {**little.cameras, "navcam_left": rig((32, 24)).cameras["navcam_left"]},
    }
    daemon.service.devices.sensor_modes["navcam_left"] = SensorMode((64, 48))  # type: ignore[index]
    flipped = replace(left, sensor_mode=SensorMode((64, 48), flip=(True, False)))
    others["mode"] = {**little.cameras, "navcam_left": flipped}
    words = {
        "lacking": "no camera hazcam_left",
        "on": "on the rover",
        "size": "32x24",
        "mode": "--flip horizontal",
    }
    for name, cameras in others.items():
        save_rig(replace(little, cameras=cameras), folder / f"{name}.yaml")
        told = refusal(web.post("/mast", json={"file": f"{name}.yaml"}), 422, "bad_mast_file")
        assert words[name] in told
    assert in_use(web) == before
    # A camera that joins in another mode after two files were in use: neither comes back unasked.
    daemon.service.devices.sensor_modes.pop("navcam_left")  # type: ignore[attr-defined]
    assert web.post("/mast", json={"file": "mode.yaml"}).status_code == 200
    save_rig(little, folder / "plain.yaml")
    assert web.post("/mast", json={"file": "plain.yaml"}).status_code == 200
    daemon.service.devices.sensor_modes["navcam_left"] = SensorMode((64, 48))  # type: ignore[index]
    assert "--flip horizontal" in refusal(web.post("/mast/back"), 422, "bad_mast_file")


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_a_file_that_cannot_be_read_is_refused(web: httpx.Client, folder: Path) -> None:
    (folder / "better.yaml").chmod(0)
    refusal(web.post("/mast", json={"file": "better.yaml"}), 422, "bad_mast_file")


@pytest.mark.parametrize(
    "body", [{}, {"file": "a", "previous": True}, {"file": 3}, {"name": "x"}, {"file": ""}]
)
def test_bodies_that_make_no_sense_are_refused(quiet: httpx.Client, body: dict[str, Any]) -> None:
    refusal(quiet.post("/mast", json=body), 422, "bad_request")


def test_a_daemon_with_fewer_cameras_keeps_the_covariance_of_those_it_has() -> None:
    names = ["mast.rotation_rad.x", "cameras.navcam_left.C.x", "cameras.hazcam_left.C.x"]
    fit = {"parameters": names, "covariance": np.diag([1e-6, 4e-6, 9e-6]).tolist(), "rms_px": 0.1}
    part = configured(replace(rig(), fit=fit), ["navcam_left", "navcam_right"])
    known = stored_covariance(part)
    assert known is not None
    assert known.names == tuple(names[:2])
    assert np.diag(known.covariance).tolist() == [1e-6, 4e-6]
    assert part.fit["rms_px"] == 0.1
    spoilt = configured(replace(rig(), fit={**fit, "covariance": [[1.0]]}), ["navcam_left"])
    assert stored_covariance(spoilt) is None

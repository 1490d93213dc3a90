"""Another mast file while the daemon runs, and back: what is refused, what old frames are worth."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.mode import SensorMode
from calib.geometry.rig import Mast, RigCamera
from drivers.errors import NoReply
from hil_tests.mastctl.service_fakes import PLAIN, FakeHardware, ScriptedLoop, rig
from hil_tests.waiting import until
from mastctl.daemon import RunningDaemon
from mastctl.motion.jog import JogBeat
from mastctl.service import steering as steering_module


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
    assert mast.headers["Mastctl-Mast-Digest"] == wanted.digest
    shot = web.get("/snapshot/navcam_left")
    assert shot.headers["Mastctl-Mast-Digest"] == wanted.digest


def test_the_former_comes_back_as_it_was_though_its_file_changed(
    web: httpx.Client, daemon: RunningDaemon, folder: Path
) -> None:
    before, content = in_use(web), web.get("/mast").content
    assert web.post("/mast", json={"file": "better.yaml"}).status_code == 200
    daemon.service.config.mast_file.write_text("schema: nothing\n")
    answer = web.post("/mast/back")
    assert answer.status_code == 200, answer.text
    assert in_use(web) == before
    assert web.get("/mast").content == content
    assert answer.json()["former_mast"]["file"] == "better.yaml"


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
    web.post("/point", json={"pan_rad": 0.1, "tilt_rad": 0.1})
    until(lambda: rigs == ["better"], "a pointing by the new file")


def test_nothing_changes_while_the_head_moves(
    web: httpx.Client, pair: tuple[RunningDaemon, FakeHardware], folder: Path
) -> None:
    before = in_use(web)
    pair[1].head.moving = True
    refusal(web.post("/mast", json={"file": "better.yaml"}), 409, "moving")
    assert in_use(web) == before


def test_no_jog_begins_while_a_mast_file_is_changed(
    pair: tuple[RunningDaemon, FakeHardware],
) -> None:
    service = pair[0].service
    with ThreadPoolExecutor(1) as pool:
        with service.masts.unchanged():
            jog = pool.submit(service.jogs.beat, JogBeat(pan_rad_per_s=0.1, tilt_rad_per_s=0.0, sequence=1))
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


@pytest.mark.parametrize("name", ["../better.yaml", "missing.yaml", "sub/better.yaml", "/", "a\0b"])
def test_only_files_beside_the_configured_one_are_taken(
    quiet: httpx.Client, standing: tuple[RunningDaemon, FakeHardware], name: str
) -> None:
    where = standing[0].service.config.mast_file.parent
    (where / "sub").mkdir(exist_ok=True)
    for elsewhere in (where / "sub", where.parent):
        (elsewhere / "better.yaml").write_bytes((where / "better.yaml").read_bytes())
    file = f"{where}/sub/better.yaml" if name == "/" else name
    refusal(quiet.post("/mast", json={"file": file}), 422, "bad_mast_file")


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
    sentence = {
        "lacking": "no camera hazcam_left",
        "on": "on the rover",
        "size": "32x24",
        "mode": "--flip horizontal",
    }
    for name, cameras in others.items():
        save_rig(replace(little, cameras=cameras), folder / f"{name}.yaml")
        outcome = refusal(web.post("/mast", json={"file": f"{name}.yaml"}), 422, "bad_mast_file")
        assert sentence[name] in outcome
    assert in_use(web) == before
    # A camera that joins in another mode after two files were in use: neither comes back unasked.
    daemon.service.devices.sensor_modes.pop("navcam_left")  # type: ignore[attr-defined]
    assert web.post("/mast", json={"file": "mode.yaml"}).status_code == 200
    save_rig(little, folder / "plain.yaml")
    assert web.post("/mast", json={"file": "plain.yaml"}).status_code == 200
    daemon.service.devices.sensor_modes["navcam_left"] = SensorMode((64, 48))  # type: ignore[index]
    assert "--flip horizontal" in refusal(web.post("/mast/back"), 422, "bad_mast_file")

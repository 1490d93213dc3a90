"""What cameras are set to: changed between operations, told with every frame, refused in a sentence."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import BadReply, Refused
from drivers.interfaces import CameraSetting
from hil_tests.mastctl.service_fakes import HTTP, FakeCamera, FakeHardware, ScriptedLoop, fake_daemon
from hil_tests.waiting import NET_S, until
from mastctl.client import Client, ClientError
from mastctl.daemon import RunningDaemon

Pair = tuple[RunningDaemon, FakeHardware]


class SetCamera(FakeCamera):
    """A camera with a gain and a focus; ``refuses`` is raised by a change, ``steps`` it clamps to."""

    def __init__(self, name: str, seed: int = 0) -> None:
        super().__init__(name, seed)
        self.values = {"exposure_s": 0.01, "gain": 8.0, "focus": 30.0}
        self.sets: list[Mapping[str, float]] = []
        self.refuses: Exception | None = None
        self.change = lambda frame: replace(frame, settings=dict(self.values))
        self.told: Any = None

    def settings(self) -> Sequence[CameraSetting]:
        if self.told is not None:
            return [self.told]
        return [
            CameraSetting("exposure_s", self.values["exposure_s"], 0.001, 0.04, 0.0001),
            CameraSetting("gain", self.values["gain"], 0.0, 100.0, 4.0),
            CameraSetting("focus", self.values["focus"], 0.0, 250.0, 5.0),
            CameraSetting("white_balance_k", None, 2000.0, 6500.0, 1.0, True, "is set by something else"),
        ]

    def adjust(self, wanted: Mapping[str, float]) -> Sequence[str]:
        if self.refuses is not None:
            raise self.refuses
        self.sets.append(dict(wanted))
        self.values |= wanted
        if wanted.get("gain", 0.0) % 4.0:
            self.values["gain"] = 4.0 * (wanted["gain"] // 4.0)
            return [f"{self.name}: gain is {self.values['gain']:g} where {wanted['gain']:g} was asked for"]
        return []


@pytest.fixture
def left() -> SetCamera:
    return SetCamera("navcam_left")


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, left: SetCamera) -> Iterator[Pair]:
    """A daemon whose left camera can be set."""
    hardware = FakeHardware()
    hardware.fake_cameras["navcam_left"] = left
    with fake_daemon(monkeypatch, tmp_path, hardware=hardware) as made:
        yield made


@pytest.fixture
def client(pair: Pair) -> Iterator[Client]:
    with Client(pair[0].url, name="bench") as made:
        yield made


def refused(code: str, act: Any) -> str:
    with pytest.raises(ClientError) as refusal:
        act()
    assert refusal.value.code == code, refusal.value
    return str(refusal.value)


def test_each_setting_is_told_with_value_bounds_and_unit(client: Client, left: SetCamera) -> None:
    told = client.camera_settings("navcam_left")
    assert told["camera"] == "navcam_left" and not told["fixed"] and not told["notes"]
    assert told["settings"][0] == {
        "name": "exposure_s", "value": 0.01, "minimum": 0.001, "maximum": 0.04, "step": 0.0001, "unit": "s",
        "automatic": False, "refusal": None,
    }  # fmt: skip
    balance = told["settings"][3]
    assert balance["automatic"] and balance["value"] is None
    assert (balance["unit"], balance["refusal"]) == ("K", "is set by something else")
    assert client.camera_settings("navcam_right")["settings"] == [], "that one cannot be set"


def test_a_changed_setting_is_in_the_facts_of_later_images_only(client: Client, left: SetCamera) -> None:
    before = client.snapshot("navcam_left")
    told = client.set_camera("navcam_left", gain=20, exposure_s=0.004)
    assert [one["value"] for one in told["settings"][:2]] == [0.004, 20.0]
    after = client.snapshot("navcam_left")
    kept = client.snapshot("navcam_left", frame_id=before.frame_id)
    assert before.settings == kept.settings == {"exposure_s": 0.01, "gain": 8.0, "focus": 30.0}
    assert after.settings == {"exposure_s": 0.004, "gain": 20.0, "focus": 30.0}
    frames: Iterator[Any] = (event["value"] for event in client.events("frame", keys=["navcam_left"]))
    assert next(frames)["settings"] == after.settings


WRONG: tuple[tuple[dict[str, Any], str], ...] = (
    ({"gain": 101}, "navcam_left: gain is to be 101, 0 to 100 is expected"),
    ({"exposure_s": 0.05}, "exposure_s is to be 0.05 s, 0.001 to 0.04 s is expected"),
    ({"white_balance_k": 3000}, "navcam_left: white_balance_k is set by something else"),
    ({}, "one of exposure_s, gain, white_balance_k, focus at least is expected"),
)


def test_what_cannot_be_set_is_refused_and_nothing_has_changed(left: SetCamera, pair: Pair) -> None:
    for body, words in WRONG:
        answer = HTTP.patch(f"{pair[0].url}/api/v1/cameras/navcam_left/settings", json=body)
        error = answer.json()["error"]
        assert answer.status_code == 422 and error["code"] in ("bad_setting", "bad_request")
        assert words in error["message"]
    assert not left.sets


def test_a_camera_that_refuses_says_so_and_is_no_fault(client: Client, left: SetCamera) -> None:
    left.refuses = Refused("the sensor is asleep", device="navcam_left")
    assert "asleep" in refused("refused_by_device", lambda: client.set_camera("navcam_left", gain=4))
    assert not client.status()["faults"]


ODD: tuple[tuple[Any, ...], ...] = (
    (1.0, 0.0, float("inf")),
    (float("nan"), 0.0, 2.0),
    (1.0, 3.0, 2.0),
    (1.0, 0.0, 2.0, -1.0),
)


def test_a_driver_with_impossible_settings_is_refused(client: Client, left: SetCamera) -> None:
    left.told = CameraSetting("iris", 1.0, 0.0, 2.0)
    assert "'iris' where one of exposure_s" in refused(
        BadReply.code, lambda: client.camera_settings("navcam_left")
    )
    for odd in ODD:
        left.told = CameraSetting("gain", *odd)
        for act in (client.camera_settings, lambda name: client.set_camera(name, gain=1)):
            words = refused(BadReply.code, lambda act=act: act("navcam_left"))  # type: ignore[misc]
            assert words.startswith("navcam_left: settings returned gain with "), words
    assert not left.sets


def test_an_operation_finds_them_held(client: Client, left: SetCamera, monkeypatch: Any) -> None:
    looks, over = threading.Event(), threading.Event()

    def script(request: Any, record: Any, cancelled: Any, devices: Any) -> Any:
        devices.frames(["navcam_left"], 0.0, NET_S)
        looks.set()
        assert over.wait(NET_S)
        return ScriptedLoop.good(request, record, cancelled, devices)

    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(script))
    operation = client.point(pan_rad=0.1, tilt_rad=0.1)
    assert looks.wait(NET_S)
    assert client.camera_settings("navcam_left")["fixed"]
    assert f"operation {operation} is running" in refused(
        "busy", lambda: client.set_camera("navcam_left", gain=4)
    )
    over.set()
    client.wait(operation)
    until(lambda: not client.camera_settings("navcam_left")["fixed"], "the release")
    client.set_camera("navcam_left", gain=4)
    assert left.sets == [{"gain": 4.0}]


def test_another_focus_than_before_is_noted_with_the_one_before(client: Client, left: SetCamera) -> None:
    answer = client.set_camera("navcam_left", focus=35)
    assert answer["notes"] == ["navcam_left: its focus was 30; a mast file is of one focus alone"]
    assert not client.set_camera("navcam_left", focus=35, gain=4)["notes"]

"""What cameras are set to: changed between operations, told with every frame, refused in a sentence."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.errors import BadReply, BadSetting, Refused
from drivers.interfaces import CameraSetting
from hil_tests.mastctl.service_fakes import HTTP, FakeCamera, FakeHardware, ScriptedLoop
from hil_tests.waiting import NET_S, until
from mastctl.cli.main import main
from mastctl.client import Client, ClientError
from mastctl.daemon import RunningDaemon
from mastctl.devices import camera_settings
from mastctl.devices.camera_settings import check_wanted

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
def left(pair: Pair) -> Iterator[SetCamera]:
    """The daemon's left camera, which can be set."""
    service = pair[0].service
    made = SetCamera("navcam_left")
    service.devices._cameras._cameras["navcam_left"] = made
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
    assert told["camera"] == "navcam_left" and not told["held"] and not told["notes"]
    assert told["settings"][0] == {
        "name": "exposure_s", "value": 0.01, "minimum": 0.001, "maximum": 0.04, "step": 0.0001, "unit": "s",
        "automatic": False, "refusal": None,
    }  # fmt: skip
    balance = told["settings"][3]
    assert balance["automatic"] and balance["value"] is None
    assert (balance["unit"], balance["refusal"]) == ("K", "is set by something else")
    assert client.camera_settings("navcam_right")["settings"] == [], "that one cannot be set"


def test_what_is_changed_stands_in_the_facts_of_pictures_after_it_and_of_none_before(
    client: Client, left: SetCamera
) -> None:
    before = client.snapshot("navcam_left")
    told = client.set_camera("navcam_left", gain=20, exposure_s=0.004)
    assert [one["value"] for one in told["settings"][:2]] == [0.004, 20.0]
    after = client.snapshot("navcam_left")
    kept = client.snapshot("navcam_left", frame_id=before.frame_id)
    assert before.settings == kept.settings == {"exposure_s": 0.01, "gain": 8.0, "focus": 30.0}
    assert after.settings == {"exposure_s": 0.004, "gain": 20.0, "focus": 30.0}
    frames = (event["value"] for event in client.events("frame", keys=["navcam_left"]))
    assert next(frames)["settings"] == after.settings


def test_a_camera_that_makes_another_value_of_it_is_told(client: Client, left: SetCamera) -> None:
    told = client.set_camera("navcam_left", gain=21)
    assert told["notes"] == ["navcam_left: gain is 20 where 21 was asked for"]
    assert told["settings"][1]["value"] == 20.0


WRONG: tuple[tuple[dict[str, Any], str], ...] = (
    ({"gain": 101}, "navcam_left: gain is to be 101, 0 to 100 is expected"),
    ({"exposure_s": 0.05}, "exposure_s is to be 0.05 s, 0.001 to 0.04 s is expected"),
    ({"white_balance_k": 3000}, "navcam_left: white_balance_k is set by something else"),
    ({"gain": 4, "exposure_s": 1}, "exposure_s is to be 1 s"),
    ({}, "one of exposure_s, gain, white_balance_k, focus at least is expected"),
    ({"gian": 3}, "gian: unknown key; the nearest known is 'gain'"),
    ({"gain": "much"}, 'gain: "much" where a valid number is expected'),
)


def test_what_cannot_be_set_is_refused_and_nothing_has_changed(left: SetCamera, pair: Pair) -> None:
    for body, words in WRONG:
        answer = HTTP.patch(f"{pair[0].url}/api/v1/cameras/navcam_left/settings", json=body)
        error = answer.json()["error"]
        assert answer.status_code == 422 and error["code"] in ("bad_setting", "bad_request")
        assert words in error["message"]
    assert not left.sets


def test_a_camera_without_settings_and_one_that_is_not_there_are_refused(
    client: Client, left: SetCamera
) -> None:
    words = refused("bad_setting", lambda: client.set_camera("navcam_right", gain=3))
    assert words == "navcam_right: it has no gain; nothing of it can be changed while it runs"
    refused("unknown_camera", lambda: client.set_camera("pancam", gain=3))
    refused("unknown_camera", lambda: client.camera_settings("pancam"))


def test_a_camera_that_refuses_says_so_and_is_no_fault(client: Client, left: SetCamera) -> None:
    left.refuses = Refused("the sensor is asleep", device="navcam_left")
    assert "asleep" in refused("refused_by_device", lambda: client.set_camera("navcam_left", gain=4))
    assert not client.status()["faults"]


ODD: tuple[tuple[Any, ...], ...] = (
    (1.0, 0.0, float("inf")),
    (float("nan"), 0.0, 2.0),
    ("1", 0.0, 2.0),
    (1.0, 0.0, None),
    (1.0, 3.0, 2.0),
    (1.0, 0.0, 2.0, -1.0),
    (1.0, 0.0, 2.0, 0.0, None),
    (1.0, 0.0, 2.0, 0.0, False, None),
)


def test_a_driver_that_tells_what_cannot_be_is_told_and_nothing_has_changed(
    client: Client, left: SetCamera
) -> None:
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


def test_numbers_of_numpy_are_numbers(client: Client, left: SetCamera) -> None:
    left.told = CameraSetting("gain", np.float32(1.5), np.int64(1), np.float64(2.0))  # type: ignore[arg-type]
    (gain,) = client.set_camera("navcam_left", gain=1)["settings"]
    assert (gain["value"], gain["minimum"], gain["maximum"]) == (1.5, 1.0, 2.0)


def test_who_does_not_hold_the_lease_changes_nothing(client: Client, pair: Pair, left: SetCamera) -> None:
    with Client(pair[0].url, name="other") as other:
        with client.lease(for_s=60):
            refused("leased", lambda: other.set_camera("navcam_left", gain=4))
            client.set_camera("navcam_left", gain=8)
        other.set_camera("navcam_left", gain=12)
    assert [one["gain"] for one in left.sets] == [8, 12]
    told = (event["value"] for event in client.events("command"))
    done = next(one for one in told if one["command"] == "camera.settings" and one["result"] == "ok")
    assert done["request"] == {"camera": "navcam_left", "gain": 8.0} and done["who"] == "bench"


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
    assert client.camera_settings("navcam_left")["held"]
    assert f"operation {operation} is running" in refused(
        "busy", lambda: client.set_camera("navcam_left", gain=4)
    )
    over.set()
    client.wait(operation)
    until(lambda: not client.camera_settings("navcam_left")["held"], "the release")
    client.set_camera("navcam_left", gain=4)
    assert left.sets == [{"gain": 4.0}]


def test_a_change_that_an_operation_overtakes_is_refused_in_the_cameras_own_thread(
    pair: Pair, left: SetCamera
) -> None:
    devices = pair[0].service.devices
    with devices.exposure_held(), pytest.raises(Exception, match="an operation compares its pictures"):
        devices.set_camera("navcam_left", {"gain": 4.0})
    assert devices.set_camera("navcam_left", {"gain": 4.0}) == [] and left.sets == [{"gain": 4.0}]


def test_an_emergency_stop_forbids_no_change(client: Client, left: SetCamera) -> None:
    client.estop(reason="test", name="bench")
    client.set_camera("navcam_left", gain=4)
    client.reset(reason="test", name="bench")
    assert left.sets == [{"gain": 4.0}]


def test_another_focus_than_the_calibrated_one_is_a_fault_until_it_is_back(
    client: Client, left: SetCamera, pair: Pair
) -> None:
    client.set_camera("navcam_left", focus=35)
    client.set_camera("navcam_left", focus=40)
    (fault,) = client.status()["faults"]
    assert (fault["device"], fault["code"]) == ("navcam_left", "refocused")
    assert fault["message"].startswith("navcam_left: its focus is 40 and was 30 when the mast file came into")
    assert fault["until"] == "its focus is 30 again, or another mast file is in use"
    client.set_camera("navcam_left", focus=30)
    assert not client.status()["faults"]
    client.set_camera("navcam_left", focus=35)
    pair[0].service.masts.load("little.yaml")
    assert not client.status()["faults"], "the mast file that is loaded now is of this focus"


def test_what_a_camera_refused_is_told_though_it_then_does_not_say_its_focus(
    client: Client, left: SetCamera
) -> None:
    asked = iter([left.settings()])
    left.settings = lambda: next(asked)  # type: ignore[method-assign]
    left.refuses = BadSetting("its motor is stuck", device="navcam_left")
    assert "its motor is stuck" in refused("bad_setting", lambda: client.set_camera("navcam_left", focus=35))


def test_a_camera_that_hangs_keeps_nobody_waiting(
    client: Client, left: SetCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(camera_settings, "SET_TIMEOUT_S", 0.05)
    go = threading.Event()
    monkeypatch.setattr(left, "settings", lambda: go.wait(2 * NET_S) and [])
    refused("no_reply", lambda: client.camera_settings("navcam_left"))
    go.set()


def test_bounds_belong_to_the_settings() -> None:
    known = [CameraSetting("gain", 1.0, 1.0, 4.0)]
    for value in (1.0, 4.0):
        check_wanted(known, {"gain": value}, "eye")
    for value in (0.999, 4.001, float("nan"), float("inf")):
        with pytest.raises(BadSetting, match="1 to 4 is expected"):
            check_wanted(known, {"gain": value}, "eye")


def test_a_bound_as_it_is_shown_is_the_bound() -> None:
    """Six digits are shown: 3 counts of 1e-4 s are above 0.0003 by a bit, 1/60 s is below 0.0166667."""
    known = [CameraSetting("exposure_s", 0.01, 3 * 1e-4, 1 / 60, 1e-4)]
    for value, bound in ((0.0003, 3 * 1e-4), (0.0166667, 1 / 60), (0.01, 0.01)):
        assert check_wanted(known, {"exposure_s": value}, "eye") == {"exposure_s": bound}
    for value in (0.00029999, 0.0166668):
        with pytest.raises(BadSetting, match=r"0\.0003 to 0\.0166667 s is expected"):
            check_wanted(known, {"exposure_s": value}, "eye")


def test_the_command_shows_settings_with_their_bounds_and_changes_them(
    pair: Pair, left: SetCamera, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")

    def said(*words: str) -> tuple[list[list[str]], str]:
        capsys.readouterr()
        assert main(["camera", "settings", *words, "--url", pair[0].url]) == 0
        out, log = capsys.readouterr()
        return [line.replace("│", " ").split() for line in out.splitlines()], log

    left.told = CameraSetting("gain", 8.0, 0.0, 100.0, 0.0)
    assert ["gain", "8", "0", "to", "100"] in said("navcam_left")[0], "any number: no step"
    left.told = None
    shown, _ = said("navcam_left")
    assert ["exposure_s", "0.01", "0.001", "to", "0.04,", "step", "0.0001", "s"] in shown
    assert ["gain", "8", "0", "to", "100,", "step", "4"] in shown
    white = "white_balance_k automatic 2000 to 6500, step 1 K is set by something else"
    assert white.split() in shown
    changed, log = said("navcam_left", "gain=21", "exposure_s=0.004")
    assert left.sets == [{"gain": 21.0, "exposure_s": 0.004}]
    assert ["gain", "20", "0", "to", "100,", "step", "4"] in changed and "where 21 was asked for" in log
    (nothing,), _ = said("navcam_right")
    assert " ".join(nothing) == "nothing of navcam_right can be changed while it runs"
    assert main(["camera", "settings", "navcam_left", "zoom=2", "--url", pair[0].url]) == 2
    assert "'zoom=2' where NAME=VALUE is expected, with the name one of" in capsys.readouterr().err

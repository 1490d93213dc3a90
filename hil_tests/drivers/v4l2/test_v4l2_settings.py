"""Exposure, gain and focus of a V4L2 camera changed while it streams: what each frame is told to have."""

from __future__ import annotations

import pytest

from calib.geometry.mode import SensorMode
from drivers.errors import BadSetting, StreamFailed
from drivers.v4l2 import abi, settings, stream
from drivers.v4l2.controls import CameraControl, ControlProblem
from drivers.values_set import SETTLE_FRAMES
from hil_tests.drivers.v4l2.test_v4l2_never_old import bench
from hil_tests.drivers.v4l2.v4l2_sensor import AUTO, EXPOSURE, Sensor, SensorNode, use
from hil_tests.waiting import until

GAIN = CameraControl(abi.CID_GAIN, "gain", "integer", 0, 255, 1, 100, True, {})
AUTOGAIN = CameraControl(abi.CID_AUTOGAIN, "gain_automatic", "boolean", 0, 1, 1, 1, True, {})
FOCUS = CameraControl(abi.CID_FOCUS_ABSOLUTE, "focus", "integer", 0, 250, 5, 0, True, {})
HFLIP = CameraControl(abi.CID_HFLIP, "horizontal_flip", "boolean", 0, 1, 1, 0, True, {})
VFLIP = CameraControl(abi.CID_VFLIP, "vertical_flip", "boolean", 0, 1, 1, 0, True, {})
ALL = (AUTO, EXPOSURE, AUTOGAIN, GAIN, FOCUS)
VALUES = {AUTOGAIN.id: 1, GAIN.id: 16, FOCUS.id: 30}
PERIOD_S = 0.04


def test_a_frame_has_a_changed_setting_once_it_surely_shows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sensor = Sensor("uvc", readout_s=0.030, late_s=0.0, seed=6)
    with bench(monkeypatch, "uvc", controls=ALL, values=VALUES, exposure_s=0.036, gain=16) as seen:
        camera = seen.camera

        def told(exposure_s: float = 0.036) -> dict[str, float | None]:
            seen.arrive(sensor.shoot(PERIOD_S, exposure_s))
            newest = camera.newest
            return {} if newest is None else dict(newest.settings)

        for _ in range(SETTLE_FRAMES + 1):
            told()
        assert told() == {"exposure_s": pytest.approx(0.036), "gain": 16.0, "focus": 30.0}
        stamped_before = sensor.shoot(PERIOD_S, 0.036)
        seen.clock.time_s = stamped_before.received_s + 0.001
        assert camera.adjust({"gain": 200.0}) == []
        seen.arrive(stamped_before)  # it had been stamped before the change and comes after it
        assert camera.next_frame(0.0, 0.0).settings["gain"] == 16.0
        gains = [told()["gain"] for _ in range(SETTLE_FRAMES + 1)]
        assert gains == [None] * SETTLE_FRAMES + [200.0]
        assert told()["exposure_s"] == pytest.approx(0.036), "of the others nothing became unknown"
        with camera.exposure_held():
            assert told()["gain"] == 200.0


CROP, BOUNDS, NATIVE, COMPOSE = (
    abi.SEL_TGT_CROP, abi.SEL_TGT_CROP_BOUNDS, abi.SEL_TGT_NATIVE_SIZE, abi.SEL_TGT_COMPOSE,
)  # fmt: skip


@pytest.mark.parametrize(
    ("told", "crop_px", "sensor_px"),
    [
        ({}, None, None),
        ({CROP: (16, 8, 32, 16)}, None, None),
        ({CROP: (16, 8, 32, 16), BOUNDS: (8, 4, 64, 32)}, (8, 4, 32, 16), (64, 32)),
        ({CROP: (16, 8, 32, 16), BOUNDS: (8, 4, 64, 32), NATIVE: (0, 0, 72, 40)}, (16, 8, 32, 16), (72, 40)),
        ({CROP: (0, 0, 32, 16), BOUNDS: (0, 0, 64, 32), COMPOSE: (0, 0, 16, 8)}, (0, 0, 32, 16), (64, 32)),
        ({CROP: (0, 0, 32, 16), BOUNDS: (0, 0, 64, 32), COMPOSE: (4, 0, 12, 8)}, None, None),
        ({CROP: (60, 0, 32, 16), BOUNDS: (0, 0, 64, 32)}, None, None),
    ],
)
def test_the_sensors_mode_is_as_far_as_the_driver_tells_it(
    monkeypatch: pytest.MonkeyPatch,
    told: dict[int, tuple[int, int, int, int]],
    crop_px: tuple[int, int, int, int] | None,
    sensor_px: tuple[int, int] | None,
) -> None:
    """Crops count from the corner of the native size, else of the bounds; not told of composed pictures."""
    node = SensorNode("start", controls=(HFLIP, VFLIP))
    node.selections, node.values[HFLIP.id], node.values[VFLIP.id] = told, 0, 1
    use(monkeypatch, node)
    found = stream.sensor_mode_of(node, (16, 8))  # type: ignore[arg-type]
    assert found == SensorMode((16, 8), crop_px, sensor_px, (False, True))


def test_bounds_are_the_cameras_and_the_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    with bench(monkeypatch, "uvc", controls=ALL, values=VALUES, focus=30) as seen:
        exposure, gain, focus = seen.camera.settings()
        assert (exposure.minimum, exposure.maximum, exposure.step) == pytest.approx((1e-4, 0.04, 1e-4))
        assert exposure.automatic and exposure.value is None
        assert gain.automatic and (gain.minimum, gain.maximum) == (0.0, 255.0)
        assert not focus.automatic and focus.value == 30.0 and not focus.refusal
    with bench(monkeypatch, "uvc", told_hz=60.0, rate_hz=60.0, controls=ALL, values=VALUES) as seen:
        highest_s = seen.camera.settings()[0].maximum
        assert highest_s == pytest.approx(0.0166), "whole steps, and no longer than a frame"


def test_an_uncalibrated_focus_and_a_groups_exposure_stay_fixed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    options = {"exposure_s": 0.01, "auto_exposure": True}
    with bench(monkeypatch, "uvc", controls=ALL, values=VALUES, **options) as seen:
        refusals = {one.name: one.refusal for one in seen.camera.settings()}
        assert refusals["exposure_s"] == "is set by 'auto_exposure' of the camera's options"
        assert refusals["focus"].endswith("so no restart could come back to the calibrated one")
        assert refusals["gain"] == ""


def test_what_was_changed_is_set_again_at_the_next_opening(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with bench(monkeypatch, "uvc", controls=ALL, values=VALUES, exposure_s=0.036, focus=30) as seen:
        seen.camera.adjust({"gain": 200.0, "exposure_s": 0.02, "focus": 35.0})
        before = len(seen.node.sets)
        seen.node.fail(StreamFailed("it gave no frame"))
        until(lambda: seen.camera.counters.reopened == 1, "it is opened again")
        assert {(GAIN.id, 200), (EXPOSURE.id, 200), (FOCUS.id, 35)} <= set(seen.node.sets[before:])


def test_a_value_the_camera_changed_or_refused_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with bench(monkeypatch, "uvc", controls=ALL, values=VALUES, focus=30) as seen:
        real = settings.set_value  # type: ignore[attr-defined]

        def clamps(node: object, control: CameraControl, value: int) -> ControlProblem | None:
            if control.id == GAIN.id:
                value = min(value, 64)
                real(node, control, value)  # type: ignore[arg-type]
                return ControlProblem("gain", "gain is 64 where 200 was set", 64)
            return real(node, control, value)  # type: ignore[arg-type]

        monkeypatch.setattr(settings, "set_value", clamps)
        (note,) = seen.camera.adjust({"gain": 200.0})
        assert "gain is 64 where 200 was requested" in note
        assert {one.name: one.value for one in seen.camera.settings()}["gain"] == 64
        seen.node.refused = (FOCUS.id,)
        with pytest.raises(BadSetting, match="focus was not changed: focus does not take 40"):
            seen.camera.adjust({"gain": 10.0, "focus": 40.0})
        assert {one.name: one.value for one in seen.camera.settings()}["focus"] == 30


def test_a_refused_value_leaves_the_automatic_on(monkeypatch: pytest.MonkeyPatch) -> None:
    with bench(monkeypatch, "uvc", controls=ALL, values=VALUES) as seen:
        seen.node.refused = (GAIN.id,)
        with pytest.raises(BadSetting, match="gain was not changed: gain does not take 200"):
            seen.camera.adjust({"gain": 200.0})
        gain = next(one for one in seen.camera.settings() if one.name == "gain")
        assert gain.automatic and gain.value is None
        real = settings.set_value  # type: ignore[attr-defined]

        def keeps_off(node: object, control: CameraControl, value: int) -> ControlProblem | None:
            if (control.id, value) == (AUTOGAIN.id, 1):
                return ControlProblem("gain_automatic", "busy")
            return real(node, control, value)  # type: ignore[arg-type]

        monkeypatch.setattr(settings, "set_value", keeps_off)
        with pytest.raises(BadSetting, match=r"gain was not changed: .*; gain_automatic stays 0$"):
            seen.camera.adjust({"gain": 200.0})

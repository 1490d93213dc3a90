"""``offset_s`` of a configuration corrects the stamps of any driver's camera, at the one door."""

from __future__ import annotations

import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass

import numpy as np
import pytest

from drivers.frame_times import corrected
from drivers.hardware import DeviceSettings, HardwareSettings
from drivers.interfaces import Camera, CameraInfo, Frame, FrameTime, Reading
from drivers.open_hardware import open_hardware

IMAGE = np.full((4, 6), 90, np.uint8)


@dataclass(frozen=True, eq=False)
class SpanFrame(Frame):
    """A frame whose ``exposure_s`` is a span in which the exposure lay."""

    mid_uncertainty_s: float = 0.0


class Eye(Camera):
    """Exposes for 10 ms each 0.1 s, from 100.0 s on; its stamps are what they are."""

    uncertainty_s = 0.0

    def __init__(self) -> None:
        self.asked: list[float] = []
        self.closed = 0

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        self.asked.append(exposed_after_s)
        sequence = int(np.floor((exposed_after_s - 100.0) / 0.1 + 1e-9)) + 1
        if self.uncertainty_s:
            span_s = 0.010 + 2 * self.uncertainty_s
            return SpanFrame(IMAGE, sequence, 100.005 + 0.1 * sequence, span_s, self.uncertainty_s)
        return Frame(IMAGE, sequence, 100.005 + 0.1 * sequence, 0.010)

    def close(self) -> None:
        self.closed += 1


class AbleEye(Eye):
    @property
    def info(self) -> CameraInfo:
        return CameraInfo(simulated=True, size_px=(6, 4), period_s=0.1, trigger="wire")

    @contextmanager
    def exposure_held(self) -> Iterator[None]:
        yield

    def recent_times(self) -> list[FrameTime]:
        return [FrameTime(n, 100.0 + 0.1 * n - self.uncertainty_s) for n in range(3)]


class Head:
    def read(self) -> Reading:
        return Reading(0.0, 0.0, False, 0.0)

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None: ...

    def stop(self) -> None: ...

    def close(self) -> None: ...


@pytest.mark.parametrize("offset_s", [0.012, -0.03, 0.3])
def test_frames_are_later_by_the_offset_and_never_older_than_asked(offset_s: float) -> None:
    camera = corrected(Eye(), offset_s)
    for asked_s in (100.0, 100.07, 100.1, 101.234):
        frame = camera.next_frame(asked_s, 1.0)
        assert frame.exposure_began_s > asked_s
        assert frame.exposure_began_s == pytest.approx(100.0 + 0.1 * frame.sequence + offset_s)
        assert frame.exposure_began_s <= asked_s + 0.1 + 1e-9, "nor younger than need be"
        assert frame.image is IMAGE and frame.exposure_s == pytest.approx(0.010)


@pytest.mark.parametrize("offset_s", [0.012, -0.012])
def test_a_span_stays_in_the_drivers_own(offset_s: float) -> None:
    eye = Eye()
    eye.uncertainty_s = 0.020
    told, frame = eye.next_frame(100.0, 1.0), corrected(eye, offset_s).next_frame(99.97, 1.0)
    assert isinstance(frame, SpanFrame)
    assert frame.mid_exposure_s == pytest.approx(100.005 + 0.1 * frame.sequence + offset_s)
    later_s = 0.1 * (frame.sequence - told.sequence)
    assert frame.exposure_began_s >= told.exposure_began_s + later_s - 1e-9
    ended_s = frame.mid_exposure_s + frame.exposure_s / 2
    assert ended_s <= told.mid_exposure_s + told.exposure_s / 2 + later_s + 1e-9
    assert frame.mid_uncertainty_s == pytest.approx(0.008)
    assert frame.exposure_s == pytest.approx(0.010 + 2 * 0.008)


def test_whatever_else_it_is_asked_goes_to_the_camera() -> None:
    eye = AbleEye()
    able = corrected(eye, 0.1)
    assert able.info == eye.info
    assert not isinstance(able.exposure_held(), nullcontext)
    able.close()
    assert eye.closed == 1


@pytest.mark.parametrize("uncertainty_s", [0.0, 0.02])
def test_the_last_frames_times_are_those_of_the_frames(uncertainty_s: float) -> None:
    eye = AbleEye()
    eye.uncertainty_s = uncertainty_s
    camera = corrected(eye, 0.015)
    given = {frame.sequence: frame for frame in (camera.next_frame(99.9 + 0.1 * n, 1.0) for n in range(3))}
    for sequence, began_s in camera.recent_times():
        if sequence in given:
            assert began_s == pytest.approx(given[sequence].exposure_began_s)


def test_the_one_door_corrects_a_camera_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    module = types.ModuleType("stamped_elsewhere")
    module.Head, module.Eye = Head, Eye  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "stamped_elsewhere", module)
    cameras = {
        "left": DeviceSettings("stamped_elsewhere:Eye", {}, 0.040),
        "right": DeviceSettings("stamped_elsewhere:Eye"),
    }
    with open_hardware(HardwareSettings(DeviceSettings("stamped_elsewhere:Head"), cameras)) as hardware:
        began_s = {
            name: camera.next_frame(100.05, 1.0).exposure_began_s for name, camera in hardware.cameras.items()
        }
    assert began_s == {"left": pytest.approx(100.14), "right": pytest.approx(100.1)}

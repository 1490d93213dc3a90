"""A camera that is not there when the service starts, and factories that block."""

from __future__ import annotations

import logging
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import save_rig
from drivers import open_hardware as door
from drivers.errors import BadFrame, BadOptions, DriverError, LineLost, NoReply
from drivers.interfaces import CameraInfo, Frame
from hil_tests.mastctl.service_fakes import FakeCamera, FakeHead, Hang, rig
from hil_tests.waiting import until
from mastctl.config import load_config
from mastctl.motion.requests import PointRequest
from mastctl.service.service import Service

CAMERAS = ("navcam_left", "navcam_right", "hazcam_left")
PATIENCE_S = 0.3
"""What an opening is waited for here."""


class Eye(FakeCamera):
    """A fake camera that notes that it was closed."""

    closed = False

    def close(self) -> None:
        self.closed = True


class SmallEye(Eye):
    """Its pictures have not the mast file's size, and it may say so or not."""

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Any:
        frame = super().next_frame(exposed_after_s, timeout_s)
        return Frame(np.full((12, 16), 99, np.uint8), frame.sequence, frame.mid_exposure_s, frame.exposure_s)


class SmallEyeThatSaysSo(SmallEye):
    @property
    def info(self) -> CameraInfo:
        return CameraInfo(size_px=(16, 12))


@dataclass
class Bench:
    """The outside package of these tests: what its factories do is set by a test."""

    heads: list[FakeHead] = field(default_factory=list)
    eyes: dict[str, Eye] = field(default_factory=dict)
    before_head: Callable[[], Any] = lambda: None
    before_eye: dict[str, Callable[[], Any]] = field(default_factory=dict)
    kind: type[Eye] = Eye
    calls: list[tuple[str, int]] = field(default_factory=list)

    def head(self, **options: Any) -> FakeHead:
        self.before_head()
        self.heads.append(FakeHead())
        return self.heads[-1]

    def eye(self, name: str) -> Eye:
        self.calls.append((name, threading.get_ident()))
        self.before_eye.get(name, lambda: None)()
        self.eyes[name] = self.kind(name, CAMERAS.index(name))
        return self.eyes[name]


class Away:
    """Something to raise in a factory until ``come``."""

    def __init__(self, error: Exception) -> None:
        self._error: Exception | None = error

    def __call__(self) -> None:
        if self._error is not None:
            raise self._error

    def come(self) -> None:
        self._error = None


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    made = Bench()
    module = types.ModuleType("bench_of_test")
    module.head, module.eye = made.head, made.eye  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "bench_of_test", module)
    return made


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(door, "OPENING_PATIENCE_S", PATIENCE_S)
    monkeypatch.setattr(door, "HEAD_OPENING_S", 3 * PATIENCE_S)


def configuration(folder: Path, cameras: tuple[str, ...] = CAMERAS) -> Path:
    save_rig(rig(), folder / "little.yaml")
    eyes = "".join(
        f"\n  {name}: {{driver: 'bench_of_test:eye', options: {{name: {name}}}}}" for name in cameras
    )
    (folder / "daemon.yaml").write_text(
        "schema: mastctl/config/1\nmast_file: little.yaml\nlisten: {port: 0}\n"
        f"pan_tilt: {{driver: 'bench_of_test:head'}}\ncameras:{eyes or ' {}'}\n"
        "limits: {pan_rad: [-2.0, 2.0], tilt_rad: [-1.0, 1.0], speed_rad_per_s: 0.5}\n"
    )
    return folder / "daemon.yaml"


@contextmanager
def serving(folder: Path, cameras: tuple[str, ...] = CAMERAS) -> Iterator[Service]:
    service = Service.open(load_config(configuration(folder, cameras)))
    try:
        yield service
    finally:
        service.close()


def faults_of(service: Service, camera: str) -> list[str]:
    """The faults of a camera as the status has them."""
    return [fault["message"] for fault in service.status()["faults"] if fault["device"] == camera]


def test_the_service_starts_with_a_camera_absent_and_the_others_serve(bench: Bench, tmp_path: Path) -> None:
    bench.before_eye["navcam_left"] = Away(LineLost("nothing at /dev/video7", device="usb camera"))
    with serving(tmp_path) as service:
        until(lambda: faults_of(service, "navcam_left"), "a fault, although no frame was requested")
        (sentence,) = faults_of(service, "navcam_left")
        assert "nothing at /dev/video7" in sentence and "joins by itself" in sentence
        (fault,) = (one for one in service.status()["faults"] if one["device"] == "navcam_left")
        assert fault["until"] == "the line is back", "the driver called it a lost line"
        with pytest.raises(DriverError, match="nothing at /dev/video7"):
            service.snapshot("navcam_left", fresh=True)
        assert len(faults_of(service, "navcam_left")) == 1, "one thing wrong is one fault"
        assert service.snapshot("navcam_right", fresh=True).camera == "navcam_right"
        done = service.steering.point(PointRequest(pan_rad=0.1, tilt_rad=0.0))
        until(lambda: service.operations.get(done.id).state != "running", "the pointing's end")
        assert service.operations.get(done.id).state == "done"


def test_an_absent_camera_joins_by_itself_and_its_fault_goes(bench: Bench, tmp_path: Path) -> None:
    away = bench.before_eye["navcam_left"] = Away(NoReply("no answer"))
    with serving(tmp_path) as service:
        until(lambda: faults_of(service, "navcam_left"), "a fault")
        with pytest.raises(DriverError):
            service.snapshot("navcam_left", fresh=True)
        away.come()
        until(lambda: not faults_of(service, "navcam_left"), "the fault's end, without a request")
        assert service.snapshot("navcam_left", fresh=True).camera == "navcam_left"
        opened = len([name for name, _ in bench.calls if name == "navcam_left"])
        time.sleep(0.5)
        assert len([name for name, _ in bench.calls if name == "navcam_left"]) == opened, "opened again"
    assert all(eye.closed for eye in bench.eyes.values())


@pytest.mark.parametrize("kind", [SmallEye, SmallEyeThatSaysSo])
def test_a_camera_that_joins_with_another_size_is_a_fault_and_not_served(
    bench: Bench, tmp_path: Path, kind: type[Eye]
) -> None:
    away = bench.before_eye["navcam_left"] = Away(NoReply("no answer"))
    with serving(tmp_path) as service:
        bench.kind = kind
        away.come()
        until(lambda: "navcam_left" in bench.eyes, "the opening")
        if kind is SmallEye:  # its size shows in its first picture
            until(lambda: not faults_of(service, "navcam_left"), "joined")
        for _ in range(2):
            with pytest.raises(DriverError, match=r"16x12 px where the mast file has 64x48|no answer"):
                service.snapshot("navcam_left", fresh=True)
        until(lambda: "16x12 px" in "".join(faults_of(service, "navcam_left")), "the fault")
        with pytest.raises(BadFrame):
            service.snapshot("navcam_left", fresh=True)


def test_what_cannot_become_right_by_itself_still_refuses_the_start(bench: Bench, tmp_path: Path) -> None:
    bench.before_eye["navcam_left"] = Away(BadOptions("baud is 7", device="usb camera"))
    with pytest.raises(BadOptions, match="baud is 7"):
        Service.open(load_config(configuration(tmp_path)))
    assert bench.heads[-1].calls[-1] == ("close",)
    bench.before_eye.clear()
    bench.kind = SmallEyeThatSaysSo
    with pytest.raises(BadFrame, match="16x12 px where the mast file has 64x48 px"):
        Service.open(load_config(configuration(tmp_path)))
    assert all(eye.closed for eye in bench.eyes.values())


def test_a_head_that_is_absent_refuses_the_start(bench: Bench, tmp_path: Path) -> None:
    bench.before_head = Away(LineLost("port /dev/mast is gone", device="bench"))
    with pytest.raises(LineLost, match="port /dev/mast is gone"):
        Service.open(load_config(configuration(tmp_path)))
    assert bench.calls == [], "no camera is touched before the head is there"


def test_a_factory_that_blocks_is_named_and_the_service_starts_without_it(
    bench: Bench, tmp_path: Path, hasty: None, caplog: pytest.LogCaptureFixture
) -> None:
    hang = bench.before_eye["navcam_left"] = Hang()
    with caplog.at_level(logging.WARNING), serving(tmp_path) as service:
        assert "navcam_left: driver 'bench_of_test:eye' is still opening it" in caplog.text
        until(lambda: faults_of(service, "navcam_left"), "a fault")
        (sentence,) = faults_of(service, "navcam_left")
        assert "driver 'bench_of_test:eye' has been opening it for" in sentence and "joins" in sentence
        (fault,) = (one for one in service.status()["faults"] if one["device"] == "navcam_left")
        assert fault["until"] == "it is there, or a picture comes"
        with pytest.raises(DriverError, match="has been opening it for"):
            service.snapshot("navcam_left", fresh=True)  # does not wait for the factory, which still hangs
        assert service.snapshot("navcam_right", fresh=True).camera == "navcam_right"
        assert [name for name, _ in bench.calls].count("navcam_left") == 1, "called again beside itself"
        hang.let_go()
        until(lambda: not faults_of(service, "navcam_left"), "joined")
        assert service.snapshot("navcam_left", fresh=True).camera == "navcam_left"

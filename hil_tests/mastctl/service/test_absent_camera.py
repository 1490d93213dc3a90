"""A camera that is not there when the service starts, and factories that block."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
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
from drivers.absent import FIRST_WAIT_S, LONGEST_WAIT_S
from drivers.errors import BadFrame, BadOptions, DriverError, LineLost, NoReply
from drivers.interfaces import Frame
from hil_tests import forks
from hil_tests.mastctl.service_fakes import FakeCamera, FakeHead, Hang, rig
from hil_tests.waiting import NET_S, until
from mastctl.cli.main import main
from mastctl.config import load_config
from mastctl.motion.requests import AnglesTarget, PixelTarget, PointRequest
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
    size_px = (16, 12)


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


def told(service: Service, camera: str) -> list[str]:
    """The faults of a camera as the status has them."""
    return [fault.message for fault in service.state().faults if fault.device == camera]


def test_the_service_starts_with_a_camera_absent_and_the_others_serve(bench: Bench, tmp_path: Path) -> None:
    bench.before_eye["navcam_left"] = Away(LineLost("nothing at /dev/video7", device="usb camera"))
    with serving(tmp_path) as service:
        until(lambda: told(service, "navcam_left"), "a fault, although nobody asked for a frame")
        (words,) = told(service, "navcam_left")
        assert "nothing at /dev/video7" in words and "joins by itself" in words
        (fault,) = (fault for fault in service.state().faults if fault.device == "navcam_left")
        assert fault.until == "the line is back", "the driver called it a lost line"
        with pytest.raises(DriverError, match="nothing at /dev/video7"):
            service.snapshot("navcam_left", fresh=True)
        assert len(told(service, "navcam_left")) == 1, "one thing wrong is told once"
        assert service.snapshot("navcam_right", fresh=True).camera == "navcam_right"
        done = service.steering.point(PointRequest(AnglesTarget(0.1, 0.0)), {})
        until(lambda: service.operations.get(done.id).state != "running", "the pointing's end")
        assert service.operations.get(done.id).state == "done"


def test_an_absent_camera_joins_by_itself_and_its_fault_goes(bench: Bench, tmp_path: Path) -> None:
    away = bench.before_eye["navcam_left"] = Away(NoReply("no answer"))
    with serving(tmp_path) as service:
        until(lambda: told(service, "navcam_left"), "a fault")
        with pytest.raises(DriverError):
            service.snapshot("navcam_left", fresh=True)
        away.come()
        until(lambda: not told(service, "navcam_left"), "the fault's end, although nobody asked")
        assert service.snapshot("navcam_left", fresh=True).camera == "navcam_left"
        opened = len([name for name, _ in bench.calls if name == "navcam_left"])
        time.sleep(0.5)
        assert len([name for name, _ in bench.calls if name == "navcam_left"]) == opened, "opened again"
    assert all(eye.closed for eye in bench.eyes.values())


def test_requests_for_an_absent_camera_do_not_hasten_its_openings(bench: Bench, tmp_path: Path) -> None:
    bench.before_eye["hazcam_left"] = Away(NoReply("no answer"))
    began_s = time.monotonic()
    with serving(tmp_path) as service:
        for _ in range(100):
            with pytest.raises(DriverError, match="no answer"):
                service.snapshot("hazcam_left", fresh=True)
        tries = len([name for name, _ in bench.calls if name == "hazcam_left"])
        least_s = sum(min(FIRST_WAIT_S * 2**number, LONGEST_WAIT_S) for number in range(tries - 1))
        assert least_s < time.monotonic() - began_s, f"{tries} openings"
        main = threading.get_ident()
        assert main not in {thread for _, thread in bench.calls}


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
            until(lambda: not told(service, "navcam_left"), "joined")
        for _ in range(2):
            with pytest.raises(DriverError, match=r"16x12 px where the mast file has 64x48|no answer"):
                service.snapshot("navcam_left", fresh=True)
        until(lambda: "16x12 px" in "".join(told(service, "navcam_left")), "the fault")
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


def test_a_pixel_is_refused_while_the_other_eye_is_absent(bench: Bench, tmp_path: Path) -> None:
    bench.before_eye["navcam_right"] = Away(LineLost("nothing at /dev/video7"))
    with serving(tmp_path) as service:
        frame = service.snapshot("navcam_left", fresh=True)
        moves = [call for call in bench.heads[0].calls if call[0] == "move"]
        done = service.steering.point(
            PointRequest(PixelTarget("navcam_left", frame.frame_id, 30.0, 20.0)), {}
        )
        until(lambda: service.operations.get(done.id).state != "running", "the pointing's end")
        record = service.operations.get(done.id)
        assert record.state == "failed"
        assert "nothing at /dev/video7" in str(record.error)
        assert [call for call in bench.heads[0].calls if call[0] == "move"] == moves


def test_a_factory_that_blocks_is_named_and_the_service_starts_without_it(
    bench: Bench, tmp_path: Path, hasty: None, caplog: pytest.LogCaptureFixture
) -> None:
    hang = bench.before_eye["navcam_left"] = Hang()
    with caplog.at_level(logging.WARNING), serving(tmp_path) as service:
        assert "navcam_left: driver 'bench_of_test:eye' is still opening it" in caplog.text
        until(lambda: told(service, "navcam_left"), "a fault")
        (words,) = told(service, "navcam_left")
        assert "driver 'bench_of_test:eye' has been opening it for" in words and "joins" in words
        (fault,) = (fault for fault in service.state().faults if fault.device == "navcam_left")
        assert fault.until == "it is there, or a picture comes"
        with pytest.raises(DriverError, match="has been opening it for"):
            service.snapshot("navcam_left", fresh=True)  # does not wait for the factory, which still hangs
        assert service.snapshot("navcam_right", fresh=True).camera == "navcam_right"
        assert [name for name, _ in bench.calls].count("navcam_left") == 1, "called again beside itself"
        hang.let_go()
        until(lambda: not told(service, "navcam_left"), "joined")
        assert service.snapshot("navcam_left", fresh=True).camera == "navcam_left"


def test_a_camera_that_is_opened_after_the_end_is_closed_again(
    bench: Bench, tmp_path: Path, hasty: None
) -> None:
    hang = bench.before_eye["navcam_left"] = Hang()
    with serving(tmp_path):
        pass
    hang.let_go()
    until(lambda: "navcam_left" in bench.eyes and bench.eyes["navcam_left"].closed, "closed")


def test_a_head_whose_factory_blocks_refuses_the_start_in_a_sentence(
    bench: Bench, tmp_path: Path, hasty: None, caplog: pytest.LogCaptureFixture
) -> None:
    hang = bench.before_head = Hang()
    with (
        caplog.at_level(logging.WARNING),
        pytest.raises(NoReply, match="pan_tilt: driver 'bench_of_test:head' did not open it within") as seen,
    ):
        Service.open(load_config(configuration(tmp_path)))
    assert "\n" not in str(seen.value)
    assert "pan_tilt: driver 'bench_of_test:head' is still opening it" in caplog.text
    hang.let_go()
    until(lambda: bench.heads and bench.heads[0].calls == [("close",)], "what came late is closed")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_every_ending_signal_ends_a_start_that_hangs_in_a_factory(tmp_path: Path, number: int) -> None:
    (tmp_path / "hanging.py").write_text(
        "import sys, time\n\n\ndef head():\n    print('in the factory', file=sys.stderr, flush=True)\n"
        "    time.sleep(60)\n"
    )
    text = configuration(tmp_path).read_text().replace("bench_of_test:head", "hanging:head")
    (tmp_path / "daemon.yaml").write_text(text)
    run = forks.Popen(
        [*forks.MASTCTL, "run", "--config", str(tmp_path / "daemon.yaml")],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert run.stderr is not None
        while "in the factory" not in (line := run.stderr.readline()):
            assert line, "it ended before"
        run.send_signal(number)
        rest = run.communicate(timeout=NET_S)[1]
    finally:
        run.kill()
        run.wait()
    assert run.returncode == 0, rest
    assert "Traceback" not in rest


def test_a_command_that_wants_one_picture_does_not_promise_to_wait(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.before_eye["navcam_left"] = Away(LineLost("nothing at /dev/video7"))
    config, out = str(configuration(tmp_path)), str(tmp_path / "picture.png")
    assert main(["camera", "grab", "navcam_left", "--config", config, "--out", out]) == 1
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert told == "mastctl: navcam_left: nothing at /dev/video7"


def test_another_mast_file_is_taken_while_a_camera_is_absent_or_has_another_size(
    bench: Bench, tmp_path: Path
) -> None:
    away = bench.before_eye["navcam_left"] = Away(NoReply("no answer"))
    with serving(tmp_path) as service:
        save_rig(rig(), tmp_path / "other.yaml")
        service.masts.load("other.yaml")
        bench.kind = SmallEyeThatSaysSo
        away.come()
        until(lambda: "16x12 px" in "".join(told(service, "navcam_left")), "the fault")
        service.masts.load("little.yaml")
        assert "16x12 px" in "".join(told(service, "navcam_left"))
        assert service.snapshot("navcam_right", fresh=True).camera == "navcam_right"


def test_a_stop_is_not_kept_by_a_camera_that_is_absent_or_blocks(
    bench: Bench, tmp_path: Path, hasty: None
) -> None:
    bench.before_eye["navcam_left"] = Away(NoReply("no answer"))
    hang = bench.before_eye["navcam_right"] = Hang()
    with serving(tmp_path) as service:
        calls = bench.heads[0].calls
        before = calls.count(("stop",))
        service.stopping.stop()
        assert calls.count(("stop",)) > before
        hang.let_go()

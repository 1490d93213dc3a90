"""Small devices for the service's tests: they do, or fail to do, what a test tells them."""

from __future__ import annotations

import functools
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pytest

from calib.files.mast_file import save_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Mast, Rig, RigCamera
from drivers.clock import Clock, SystemClock
from drivers.interfaces import Camera, Frame, PanTilt, Reading
from hil_tests.waiting import NET_S
from mastctl.answers import Step
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.control.publisher import Publisher, Topic
from mastctl.drift.journal import JournalThread

if TYPE_CHECKING:
    from mastctl.daemon import RunningDaemon

SIZE_PX = (64, 48)

PLAIN: dict[str, Any] = {"trust_env": False, "verify": False, "timeout": NET_S}
"""How a test's client asks a daemon: with the net, and without the machine's certificates, 17 ms to read."""
HTTP = httpx.Client(**PLAIN, limits=httpx.Limits(max_keepalive_connections=0))
"""For single questions; no connection outlives one."""


def rig(size_px: tuple[int, int] = SIZE_PX) -> Rig:
    """A mast with a stereo pair on the head and one camera on the body."""
    model = CameraModel(
        "CAHV",
        size_px,
        C=np.zeros(3),
        A=np.array([1.0, 0, 0]),
        H=np.array([32.0, 60, 0]),
        V=np.array([24.0, 0, 60]),
    )
    return Rig(
        name="little",
        mast=Mast(np.array([0.3, 0.0, -1.4]), np.zeros(3)),
        cameras={
            "navcam_left": RigCamera("head", model),
            "navcam_right": RigCamera("head", model),
            "hazcam_left": RigCamera("rover", model),
        },
        stereo={"navcam": ("navcam_left", "navcam_right")},
    )


@functools.cache
def little_mast_file() -> bytes:
    """The rig as a mast file."""
    with tempfile.TemporaryDirectory() as folder:
        save_rig(rig(), Path(folder) / "little.yaml")
        return (Path(folder) / "little.yaml").read_bytes()


@dataclass
class FakeHead(PanTilt):
    """A head that is where it was sent at once; ``hook(name)`` runs first in every call and may raise."""

    pan_rad: float = 0.0
    tilt_rad: float = 0.0
    moving: bool = False
    faults: tuple[str, ...] = ()
    hook: Callable[[str], Any] = lambda name: None
    answer: Any = None
    calls: list[tuple[Any, ...]] = field(default_factory=list)
    threads: set[int] = field(default_factory=set)
    clock: Clock = field(default_factory=SystemClock)

    def read(self) -> Any:
        self.threads.add(threading.get_ident())
        self.hook("read")
        if self.answer is not None:
            return self.answer(self) if callable(self.answer) else self.answer
        return Reading(self.pan_rad, self.tilt_rad, self.moving, self.clock.now_s(), self.faults)

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        self.threads.add(threading.get_ident())
        self.hook("move")
        self.calls.append(("move", pan_rad, tilt_rad, speed_rad_per_s))
        self.pan_rad, self.tilt_rad = pan_rad, tilt_rad

    def stop(self) -> None:
        self.hook("stop")
        self.calls.append(("stop",))

    def close(self) -> None:
        self.hook("close")
        self.calls.append(("close",))


class FakeCamera(Camera):
    """A camera that takes a picture whenever it is asked; ``change(frame)`` may make something else of it."""

    def __init__(self, name: str, seed: int = 0, clock: Clock | None = None) -> None:
        self.name = name
        self._clock = clock or SystemClock()
        self.sequence = 0
        self.hook: Callable[[], Any] = lambda: None
        self.change: Callable[[Frame], Any] = lambda frame: frame
        self.asked: list[tuple[float, float]] = []
        self._random = np.random.default_rng(seed)

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Any:
        self.asked.append((exposed_after_s, timeout_s))
        self.hook()
        exposure_s = 0.002
        begin_s = max(self._clock.now_s(), exposed_after_s) + 0.001
        self._clock.sleep(begin_s + exposure_s - self._clock.now_s())
        self.sequence += 1
        width, height = SIZE_PX
        image = self._random.integers(0, 255, (height, width), dtype=np.uint8)
        return self.change(Frame(image, self.sequence, begin_s + exposure_s / 2, exposure_s))

    def close(self) -> None:
        self.hook()


class FakeHardware:
    """What open_hardware gives, made of fakes."""

    def __init__(
        self,
        cameras: tuple[str, ...] = ("navcam_left", "navcam_right", "hazcam_left"),
        clock: Clock | None = None,
    ) -> None:
        self.head = FakeHead(clock=clock or SystemClock())
        self.fake_cameras = {name: FakeCamera(name, seed, clock) for seed, name in enumerate(cameras)}
        self.kind = "real"
        self.simulation: Any = None
        self.closed = 0

    @property
    def pan_tilt(self) -> PanTilt:
        return self.head

    @property
    def cameras(self) -> MappingProxyType[str, Camera]:
        return MappingProxyType(dict(self.fake_cameras))

    def close(self) -> None:
        self.closed += 1


class Hang:
    """Something to hang in: ``hook`` blocks until ``let_go``; ``entered`` says that somebody hangs.

    It hangs longer than any net: what was answered before ``let_go`` was answered while it hung.
    """

    def __init__(self) -> None:
        self.entered = threading.Event()
        self._go = threading.Event()

    def __call__(self, *ignored: Any) -> None:
        self.entered.set()
        self._go.wait(2.0 * NET_S)

    def let_go(self) -> None:
        self._go.set()


def newest(publisher: Publisher, topic: Topic, key: str) -> Any:
    """The newest value of a key, None before the first."""
    with publisher.subscribe(topic) as heard:
        return next((one.value for one in heard.wait(0.0) if one.key == key), None)


def on_disk(thread: JournalThread) -> None:
    """Wait until all that was put into a thread for files is done."""
    done = threading.Event()
    thread.put(done.set)
    assert done.wait(NET_S)


def fake_step(name: str, **detail: Any) -> Step:
    """A step that is done."""
    return Step(name=name, state="done", started_s=time.monotonic(), duration_s=0.01, detail=detail)


def fake_result(position_m: Any, range_m: float, *residuals_px: Any, frame_id: str = "") -> dict[str, Any]:
    """What an operation ends with: a pointing for each residual, of one sigma each."""
    angles = ("commanded", "measured", "true")
    rest = ("aim_px", "predicted_px", "target_px", "predicted_sigma_px", "predicted_covariance_px2")
    common = {f"{one}_pan_rad": 0.1 for one in angles} | {f"{one}_tilt_rad": -0.1 for one in angles}
    common |= dict.fromkeys(rest) | {
        "camera": "navcam_left",
        "frame_id": frame_id,
        "note": "",
        "motion_evidence": {},
    }
    measured = [common | {"residual_px": one, "residual_sigma_px": [0.1, 0.2]} for one in residuals_px]
    return {"position_m": position_m, "range_m": range_m, "pointings": measured}


class ScriptedLoop:
    """Stands for the pointing loop: ``script(request, record, cancelled, devices)`` is set by a test."""

    script: Callable[..., Any]

    def __init__(self, rig: Rig, devices: Any, *others: Any, repeat_after_s: float) -> None:
        self._devices = devices
        *_, self._record, self._cancelled = others

    def run(self, request: Any, view_rad: Any = None) -> Any:
        return type(self).script(request, self._record, self._cancelled, self._devices)

    @staticmethod
    def good(request: Any, record: Callable[[Any], None], cancelled: threading.Event, devices: Any) -> Any:
        """Two steps and a residual."""
        record(fake_step("look", frame_ids=["a", "b"]))
        devices.move(0.1, -0.1)
        devices.read()  # the head has arrived, as after a real loop: the next picture is of a head at rest
        record(fake_step("measure", not_a_number=float("nan")))
        residual_px = np.array([0.25, -0.5])
        return fake_result(np.array([6.0, 0.0, 0.1]), 6.0, residual_px, frame_id="navcam_left-000001-x-y")


@contextmanager
def fake_daemon(
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    listen: str = "{port: 0}",
    config: str | None = None,
    loop: type[ScriptedLoop] = ScriptedLoop,
    hardware: FakeHardware | None = None,
) -> Iterator[tuple[RunningDaemon, FakeHardware]]:
    """A daemon on fakes: a real server on loopback, fake devices, a scripted loop.

    Its deadlines for the head are nets: a process that gets no processor for a second is no head that fails.
    A test of such a deadline sets it inside the block.
    """
    from mastctl.daemon import RunningDaemon  # slow to load, and most of these fakes need no daemon
    from mastctl.devices import devices as devices_module
    from mastctl.service import steering as steering_module
    from mastctl.web import commands as commands_module

    for name in ("READ_TIMEOUT_S", "MOVE_TIMEOUT_S", "STOP_TIMEOUT_S"):
        monkeypatch.setattr(devices_module, name, NET_S)
    monkeypatch.setattr(commands_module, "STOP_ANSWER_S", 2.0 * NET_S)
    hardware = hardware or FakeHardware()
    (folder / "little.yaml").write_bytes(little_mast_file())
    (folder / "daemon.yaml").write_text((config or CONFIG).format(listen=listen))
    monkeypatch.setattr("mastctl.devices.opening.open_hardware", lambda settings, clock: hardware)
    monkeypatch.setattr(steering_module, "PointingLoop", loop)
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(ScriptedLoop.good), raising=False)
    with RunningDaemon(load_config(folder / "daemon.yaml")) as daemon:
        yield daemon, hardware


CONFIG = """
schema: mastctl/config/1
mast_file: little.yaml
listen: {listen}
pan_tilt: {{driver: fake}}
cameras: {{navcam_left: {{driver: fake}}, navcam_right: {{driver: fake}}, hazcam_left: {{driver: fake}}}}
limits: {{pan_rad: [-2.0, 2.0], tilt_rad: [-1.0, 1.0], speed_rad_per_s: 0.5}}
"""


def asked_plainly(client: Client, method: str, path: str, **options: Any) -> dict[str, Any]:
    """What a client is answered where it has no method that asks so."""
    return client.daemon.json(dict[str, Any], method, path, **options)

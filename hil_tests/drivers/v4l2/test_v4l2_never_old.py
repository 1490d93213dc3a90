"""No frame is given as exposed after a moment when its exposure began before it, whatever the camera does.

Judged by a made-up sensor that knows its own true times. "Asked for after its true beginning" is the sharpest
question that a frame must not answer.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import pytest

from drivers.errors import NoFreshFrame, UnsupportedFormat
from drivers.v4l2 import camera as camera_module
from drivers.v4l2 import exposure
from drivers.v4l2.camera import V4l2Camera
from drivers.v4l2.controls import CameraControl
from drivers.v4l2.settings import parse_options
from hil_tests.drivers.v4l2.v4l2_sensor import AUTO, EXPOSURE, Sensor, SensorNode, Shot, TurnedClock, use
from hil_tests.waiting import NET_S, until

PERIOD_S = 0.040
MARGIN_S = 0.002
KINDS = ("start", "uvc", "end")


@dataclass
class Wanted:
    """Stands for the group's exposure control: a test says which exposure time it wants."""

    exposure_s: float
    is_fixed: bool = False

    def see(self, camera: str, image: object, exposure_s: float) -> float:
        return self.exposure_s

    def hold(self) -> None:
        self.is_fixed = True

    def release(self) -> None:
        self.is_fixed = False


@dataclass
class Bench:
    """A camera over a made-up sensor, and what it gave."""

    camera: V4l2Camera
    node: SensorNode
    clock: TurnedClock
    taken_at_s: float = 0.0  # nothing is dequeued before: frames wait in the kernel
    given: int = 0
    asked: int = 0

    def arrive(self, shot: Shot, wrong: bool = False) -> None:
        """Let a frame come, then ask for one exposed after its true beginning, and for one well before."""
        self.clock.time_s = max(shot.received_s, self.taken_at_s)
        through = self.node.through
        self.node.put(shot, wrong)
        until(lambda: self.node.through > through, "it is taken")
        if wrong:
            return
        self.clock.time_s = shot.stamp_s  # so that no frame is refused for its age instead
        with contextlib.suppress(NoFreshFrame):
            frame = self.camera.next_frame(shot.began_s, 0.0)
            raise AssertionError(
                f"frame {frame.driver_sequence} began at {shot.began_s:.4f} s and was given as exposed after "
                f"that: its window begins {1e3 * (frame.exposure_began_s - shot.began_s):.1f} ms late"
            )
        self.asked += 1
        with contextlib.suppress(NoFreshFrame):
            frame = self.camera.next_frame(shot.began_s - 10.0, 0.0)
            if frame.driver_sequence != shot.sequence:
                return
            self.given += 1
            assert frame.exposure_began_s <= shot.began_s + 1e-9
            middle_s = (shot.began_s + shot.ended_s) / 2
            assert abs(frame.mid_exposure_s - middle_s) <= frame.mid_uncertainty_s + self.slack_s + 1e-9

    slack_s = MARGIN_S  # a stamp that came late moves the middle by so much at most


@contextlib.contextmanager
def bench(
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    told_hz: float | None = 25.0,
    controls: tuple[CameraControl, ...] = (),
    values: Mapping[int, int] = MappingProxyType({}),
    **options: object,
) -> Iterator[Bench]:
    node = SensorNode(kind, told_hz, controls)
    node.values |= values
    use(monkeypatch, node)
    clock = TurnedClock()
    chosen = {"card": "Made up", "format": "GREY", "size_px": [16, 8], "rate_hz": 25.0, "margin_s": MARGIN_S}
    camera = V4l2Camera(parse_options({**chosen, **options}, "eye"), "eye", clock)
    try:
        yield Bench(camera, node, clock)
    finally:
        camera.close()
        os.close(node.ready)


@pytest.mark.parametrize("kind", KINDS)
def test_a_frame_stretched_in_the_dark_is_not_given_as_fresh(
    monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """25 frames/s by day; then it gets dark and each exposure lasts as long as its frame, 100 ms and more."""
    sensor = Sensor(kind, readout_s=0.030, late_s=MARGIN_S, seed=1)
    with bench(monkeypatch, kind) as seen:
        for apart_s in [PERIOD_S] * 6 + [0.105, 0.138, 0.138, 0.138, PERIOD_S, PERIOD_S, 0.138, PERIOD_S]:
            seen.arrive(sensor.shoot(apart_s, apart_s))
    assert seen.given >= seen.asked - 2, "frames after the first two are to be had"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(2))
def test_no_old_frame_of_an_unsteady_camera_is_given_as_fresh(
    monkeypatch: pytest.MonkeyPatch, kind: str, seed: int
) -> None:
    sensor = Sensor(kind, readout_s=0.030, late_s=MARGIN_S, seed=seed)
    random = sensor.random
    with bench(monkeypatch, kind) as seen:
        for _ in range(200):
            stretched = random.random() < 0.3
            apart_s = PERIOD_S * (1 + 3 * random.random() if stretched else 1 + 0.01 * random.random())
            shot = sensor.shoot(apart_s, apart_s * (1.0 if random.random() < 0.5 else random.random()))
            fate = random.random()
            if fate > 0.2:
                seen.arrive(shot, wrong=fate < 0.3)
    assert seen.given > 0.9 * seen.asked, (
        f"only {seen.given} of {seen.asked} were to be had at all (seed {seed})"
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("promised_hz", [60.0, 5.0, None])
def test_nor_of_one_that_keeps_another_rate_than_it_promised(
    monkeypatch: pytest.MonkeyPatch, kind: str, promised_hz: float | None
) -> None:
    """Also when it drops every second frame from the first on, so that no two neighbours ever come."""
    for drops in (1, 2, 3):
        sensor = Sensor(kind, readout_s=0.030, late_s=MARGIN_S, seed=drops)
        with bench(monkeypatch, kind, promised_hz, rate_hz=promised_hz) as seen:
            for number in range(40):
                shot = sensor.shoot(PERIOD_S, PERIOD_S)
                if number % drops == 0:
                    seen.arrive(shot)
        assert seen.given >= seen.asked - 3


@pytest.mark.parametrize("kind", KINDS)
def test_frames_of_before_a_change_have_the_exposure_of_their_time(
    monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """The exposure goes from 36 to 2 ms, twelve older frames still wait, and it shows three frames later."""
    sensor = Sensor(kind, readout_s=0.030, late_s=MARGIN_S, seed=3)
    options: dict[str, Any] = {"exposure_s": 0.036, "auto_exposure": {"longest_s": 0.04}}
    wanted = Wanted(0.036)
    monkeypatch.setattr(exposure.GROUPS, "join", lambda *ignored: wanted)
    with bench(monkeypatch, kind, controls=(AUTO, EXPOSURE), **options) as seen:
        for _ in range(6):
            seen.arrive(sensor.shoot(PERIOD_S, 0.036))
        changed_at_s = sensor.read_out_s + 12.6 * PERIOD_S
        seen.taken_at_s = changed_at_s
        wanted.exposure_s = 0.002
        for _ in range(12 + 3):
            seen.arrive(sensor.shoot(PERIOD_S, 0.036))
        assert (EXPOSURE.id, 20) in seen.node.sets
        for _ in range(6):
            seen.arrive(sensor.shoot(PERIOD_S, 0.002))
        frame = seen.camera.next_frame(0.0, 0.0)
        assert frame.set_exposure_s == pytest.approx(0.002), "the new one is known once it must show"
    assert seen.given >= seen.asked - 2


@pytest.mark.parametrize("kind", ["uvc", "end"])
def test_an_exposure_that_stays_automatic_is_not_known(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    sensor = Sensor(kind, readout_s=0.030, late_s=MARGIN_S, seed=4)
    monkeypatch.setattr(SensorNode, "refused", (AUTO.id,))
    with bench(monkeypatch, kind, controls=(AUTO, EXPOSURE), exposure_s=0.004) as seen:
        for _ in range(8):
            seen.arrive(sensor.shoot(PERIOD_S, PERIOD_S))
        assert seen.camera.next_frame(0.0, 0.0).set_exposure_s is None


@pytest.mark.parametrize("kind", KINDS)
def test_a_stamp_ahead_of_the_clock_is_bounded_by_the_clock(
    monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    sensor = Sensor(kind, readout_s=0.001, late_s=0.0, seed=5)
    with bench(monkeypatch, kind, margin_s=0.0) as seen:
        for _ in range(5):
            shot = sensor.shoot(PERIOD_S, 0.010)
            ahead = Shot(shot.sequence, shot.began_s, shot.ended_s, shot.received_s + 0.004, shot.received_s)
            seen.arrive(ahead if kind != "start" else shot)


def test_an_exposure_longer_than_the_cameras_own_frame_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words = r"'exposure_s' is 0.1 s, longer than a frame at the camera's 25 Hz \(0.04 s\)"
    with (
        pytest.raises(UnsupportedFormat, match=words),
        bench(monkeypatch, "uvc", 25.0, (AUTO, EXPOSURE), rate_hz=None, exposure_s=0.1),
    ):
        pass


def test_a_hold_lets_a_pending_change_show_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """The other camera of the group decided on another exposure just before a measurement began."""
    sensor = Sensor("uvc", readout_s=0.030, late_s=0.0, seed=6)
    wanted = Wanted(0.036)
    monkeypatch.setattr(exposure.GROUPS, "join", lambda *ignored: wanted)
    options: dict[str, Any] = {"exposure_s": 0.036, "auto_exposure": {"longest_s": 0.04}}
    with bench(monkeypatch, "uvc", controls=(AUTO, EXPOSURE), **options) as seen:
        monkeypatch.setattr(camera_module, "HOLD_MOST_S", NET_S)
        monkeypatch.setattr(camera_module, "HOLD_PERIODS", 1e6)
        for _ in range(6):
            seen.arrive(sensor.shoot(PERIOD_S, 0.036))
        wanted.exposure_s = 0.002
        held, over = threading.Event(), threading.Event()

        def measure() -> None:
            with seen.camera.exposure_held():
                held.set()
                assert over.wait(NET_S)

        thread = threading.Thread(target=measure)
        thread.start()
        until(lambda: wanted.is_fixed, "the hold")
        came = 0
        while not held.is_set():
            seen.arrive(sensor.shoot(PERIOD_S, 0.036 if came < 4 else 0.002))
            came += 1
            assert came < 20
            time.sleep(0.01)
        assert 4 < came < 20, "the block began when the new one shows"
        sets = len(seen.node.sets)
        wanted.exposure_s = 0.010  # whoever decides now
        for _ in range(8):
            seen.arrive(sensor.shoot(PERIOD_S, 0.002))
            assert seen.camera.next_frame(0.0, 0.0).set_exposure_s == pytest.approx(0.002)
        assert len(seen.node.sets) == sets, "nothing was set while it was held"
        over.set()
        thread.join(NET_S)
        seen.arrive(sensor.shoot(PERIOD_S, 0.002))
        assert seen.node.sets[-1] == (EXPOSURE.id, 100), "afterwards it is"

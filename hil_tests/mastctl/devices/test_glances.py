"""Who only watches is never in the way of who needs a frame, and never makes a simulation's clock turn."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from drivers.clock import ManualClock, SystemClock
from drivers.interfaces import Frame, Reading
from drivers.simulation_clock import SimulationClock
from hil_tests.mastctl.service_fakes import SIZE_PX, FakeHardware, Hang, rig
from hil_tests.waiting import until
from mastctl.devices.cameras import GLANCES_SHARE
from mastctl.devices.devices import Devices
from mastctl.devices.limits import Limits
from mastctl.web import pictures
from mastctl.web.pictures import WatchedCameras

LIMITS = Limits((-2.0, 2.0), (-1.0, 1.0), 0.5)
LEFT, RIGHT = "navcam_left", "navcam_right"
OLD_S, PATIENCE_S = 1e-3, 60.0
DRAWING_S = 0.02  # of real time, for each picture of the simulated cameras below


class Drawn:
    """A camera on the simulation's clock: each picture takes real time, in which that clock stands."""

    def __init__(self, clock: SimulationClock, people: ManualClock) -> None:
        self._clock, self._people = clock, people
        self.drawn_s: list[float] = []
        self.name = ""

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        self._clock.sleep(exposed_after_s + 0.03 - self._clock.now_s())
        self.drawn_s.append(self._people.now_s())
        self._people.advance(DRAWING_S)
        grey = np.random.default_rng(len(self.drawn_s)).integers(0, 255, SIZE_PX[::-1], dtype=np.uint8)
        mid_s = self._clock.now_s() - 0.01
        return Frame(grey, round(1e4 * mid_s), mid_s, 0.002)

    def close(self) -> None:
        pass


@contextmanager
def at_full_speed() -> Iterator[tuple[Devices, SimulationClock, ManualClock, list[Drawn]]]:
    """Devices on a clock that waits for nothing, and the real time of those who watch, turned by hand."""
    clock, people, hardware = SimulationClock(start_s=10.0), ManualClock(), FakeHardware()
    drawn = [Drawn(clock, people) for _ in hardware.fake_cameras]
    hardware.fake_cameras = dict(zip(hardware.fake_cameras, drawn, strict=True))  # type: ignore[arg-type]
    hardware.head.answer = lambda head: Reading(head.pan_rad, head.tilt_rad, False, clock.now_s())
    with clock.at_work():
        devices = Devices(hardware, LIMITS, "0" * 64, clock, rig())
    devices._cameras._people = people  # type: ignore[assignment]
    try:
        yield devices, clock, people, drawn
    finally:
        devices.close()


def moves(clock: SimulationClock, seconds: float) -> None:
    """What an operation does while the head turns: it waits, again and again."""

    def turn() -> None:
        for _ in range(round(100 * seconds)):
            clock.sleep(0.01)

    moving = clock.thread(turn, "turn")
    moving.start()
    moving.join(PATIENCE_S)
    assert not moving.is_alive()


def test_whoever_watches_draws_one_picture_and_no_more_while_the_head_turns_at_full_speed() -> None:
    with at_full_speed() as (devices, clock, _, drawn):
        watched = WatchedCameras(devices, clock)
        watchers: list[Any] = []
        for _ in range(2):
            watcher = watched.watch((LEFT, RIGHT), lambda: [shown(one) for one in watchers])
            watchers.append(watcher)
        until(lambda: sum(len(one.drawn_s) for one in drawn) > 0, "a first picture")
        moves(clock, 30.0)
        assert sum(len(one.drawn_s) for one in drawn) == 1
        watched.close()


def shown(watcher: Any) -> None:
    for picture in watcher.take():
        watcher.shown(picture.frame.camera)


def test_glances_take_no_more_than_their_share_of_real_time() -> None:
    with at_full_speed() as (devices, clock, people, drawn):
        for _ in range(3):
            with ticking(people):
                devices.glance(LEFT, clock.now_s(), 1.0, 1.0)
        began_s = drawn[0].drawn_s
        assert len(began_s) == 3
        assert min(np.diff(began_s)) >= DRAWING_S / GLANCES_SHARE


@contextmanager
def ticking(people: ManualClock) -> Iterator[None]:
    """Real time goes on by itself inside the block."""
    over = threading.Event()

    def tick() -> None:
        while not over.wait(0.001):
            people.advance(0.005)

    ticks = threading.Thread(target=tick)
    ticks.start()
    try:
        yield
    finally:
        over.set()
        ticks.join()


def test_a_picture_that_is_still_of_now_is_shown_again_and_the_clock_stands(monkeypatch: Any) -> None:
    monkeypatch.setattr(pictures, "AGAIN_S", 0.001)
    with at_full_speed() as (devices, clock, _, drawn):
        watched, came = WatchedCameras(devices, clock), []
        there = threading.Event()
        watcher = watched.watch((LEFT,), there.set)
        first_s = None
        while len(came) < 10:
            assert there.wait(PATIENCE_S)
            there.clear()
            for picture in watcher.take():
                first_s = first_s or clock.now_s()
                came.append(picture.frame.frame_id)
                watcher.shown(LEFT)
        assert len(set(came)) == 1 and len(drawn[0].drawn_s) == 1
        assert clock.now_s() == first_s
        watched.close()


def test_a_frame_that_is_needed_serves_those_who_watch_and_none_is_begun_beside_it() -> None:
    hardware = FakeHardware()
    devices = Devices(hardware, LIMITS, "0" * 64, SystemClock(), rig())
    camera, hang, came = hardware.fake_cameras[LEFT], Hang(), dict[str, Any]()
    camera.hook = hang
    try:
        began_s = SystemClock().now_s()
        look = running(
            lambda: came.update(look=devices.frames([LEFT], SystemClock().now_s(), PATIENCE_S)[LEFT])
        )
        until(hang.entered.is_set, "the look is under way")
        glance = running(lambda: came.update(glance=devices.glance(LEFT, began_s, PATIENCE_S, PATIENCE_S)))
        assert devices.glance(RIGHT, began_s, PATIENCE_S, PATIENCE_S).camera == RIGHT, (
            "another camera is free"
        )
        hang.let_go()
        look.join(PATIENCE_S)
        glance.join(PATIENCE_S)
        assert came["glance"] is came["look"] and len(camera.asked) == 1
    finally:
        hang.let_go()
        devices.close()


def test_a_glance_that_waits_its_turn_lets_a_look_go_before_it() -> None:
    hardware = FakeHardware()
    devices = Devices(hardware, LIMITS, "0" * 64, SystemClock(), rig())
    camera, hang = hardware.fake_cameras[LEFT], Hang()
    camera.hook = hang

    def queued() -> int:
        return len(devices._cameras._threads[LEFT]._jobs)

    def glances() -> threading.Thread:
        return running(lambda: devices.glance(LEFT, SystemClock().now_s(), OLD_S, PATIENCE_S))

    try:
        under_way = glances()
        until(hang.entered.is_set, "a glance is under way")
        waits = glances()
        until(lambda: queued() == 1, "another waits")
        after_s = SystemClock().now_s() + 0.01
        look = running(lambda: devices.frames([LEFT], after_s, PATIENCE_S))
        until(lambda: queued() == 2, "and a look")
        hang.let_go()
        for one in (under_way, look, waits):
            one.join(PATIENCE_S)
        assert camera.asked[1][0] == after_s, "the look is the next, though it came last"
    finally:
        hang.let_go()
        devices.close()


def running(target: Any) -> threading.Thread:
    thread = threading.Thread(target=target, daemon=True)
    thread.start()
    return thread

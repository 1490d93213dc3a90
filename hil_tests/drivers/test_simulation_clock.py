"""The simulation's clock: time stands while anybody computes, and jumps when all wait."""

from __future__ import annotations

import itertools
import math
import random
import threading
import time
from collections.abc import Callable
from dataclasses import replace

import pytest

from drivers.clock import ClockLock
from drivers.errors import BadOptions
from drivers.hardware import DeviceSettings, HardwareSettings, clock_for
from drivers.simulation_clock import SimulationClock

LONG_S = 20.0


def started(clock: SimulationClock, *targets: Callable[[], None]) -> list[threading.Thread]:
    threads = [clock.thread(target, f"worker {number}") for number, target in enumerate(targets)]
    with clock.at_work():
        for thread in threads:
            thread.start()
    return threads


def ended(threads: list[threading.Thread]) -> None:
    for thread in threads:
        thread.join(LONG_S)
        assert not thread.is_alive(), f"{thread.name} still waits"


def test_time_stands_still_while_a_thread_computes() -> None:
    clock = SimulationClock()
    seen: list[float] = []

    def computes() -> None:
        seen.append(clock.now_s())
        time.sleep(0.05)
        seen.append(clock.now_s())

    def waits() -> None:
        clock.sleep(0.001)
        seen.append(clock.now_s())

    ended(started(clock, waits, computes))
    assert seen == [0.0, 0.0, 0.001]


def test_between_two_commands_no_time_passes() -> None:
    clock = SimulationClock()
    signal = clock.signal()
    rounds: list[float] = []

    def paces() -> None:
        while len(rounds) < 1000:
            rounds.append(clock.now_s())
            with signal:
                signal.wait(0.05, idle=True)

    started(clock, paces)
    clock.sleep(0.12)
    time.sleep(0.02)
    assert rounds == pytest.approx([0.0, 0.05, 0.1])
    assert clock.now_s() == 0.12


def test_threads_take_turns_in_the_same_order_every_time() -> None:
    def run(seed: int) -> list[tuple[int, float]]:
        clock, jitter = SimulationClock(), random.Random(seed)
        said: list[tuple[int, float]] = []

        def worker(number: int) -> Callable[[], None]:
            def work() -> None:
                for step in range(30):
                    time.sleep(jitter.random() * 2e-4)
                    said.append((number, clock.now_s()))
                    clock.sleep((1 + (number * step) % 3) / 8)

            return work

        ended(started(clock, *(worker(number) for number in range(5))))
        return said

    first = run(1)
    assert len(first) == 150
    assert all(run(seed) == first for seed in (2, 3))


def test_a_deadline_ends_a_wait_and_a_notification_ends_it_before() -> None:
    clock = SimulationClock()
    signal, told = clock.signal(), []

    def waits() -> None:
        with signal:
            told.append((signal.wait(2.0), clock.now_s()))
            told.append((signal.wait(0.5), clock.now_s()))

    def notifies() -> None:
        clock.sleep(1.0)
        with signal:
            signal.notify_all()

    ended(started(clock, waits, notifies))
    assert told == [(True, 1.0), (False, 1.5)]


def test_at_a_finite_speed_time_goes_on_by_itself() -> None:
    clock, speed = SimulationClock(200.0), 200.0
    assert clock.speed == speed
    seen: list[float] = []

    def paces() -> None:
        signal = clock.signal()
        for _ in range(5):
            with signal:
                signal.wait(2.0, idle=True)
            seen.append(clock.now_s())

    began_s = time.monotonic()
    ended(started(clock, paces))
    assert time.monotonic() - began_s >= 10.0 / speed  # never faster
    assert seen[0] >= 2.0
    assert all(later - earlier >= 2.0 for earlier, later in itertools.pairwise(seen))
    before_s = clock.now_s()
    time.sleep(0.01)
    assert clock.now_s() >= before_s + 0.01 * speed


SIMULATED = HardwareSettings(
    DeviceSettings("sim", {}), {"navcam_left": DeviceSettings("sim", {})}, {"rover": "rover.yaml"}
)


@pytest.mark.parametrize(("asked", "speed"), [("max", math.inf), (10, 10.0), (0.5, 0.5)])
def test_a_simulation_lives_on_the_clock_that_it_asks_for(asked: object, speed: float) -> None:
    clock = clock_for(replace(SIMULATED, simulation={"rover": "rover.yaml", "speed": asked}))
    assert isinstance(clock, SimulationClock)
    assert clock.speed == speed


@pytest.mark.parametrize("asked", [0, 1001, "fast", True, math.nan, [10]])
def test_a_speed_that_is_none_is_refused_with_what_would_be_right(asked: object) -> None:
    with pytest.raises(BadOptions, match=r"simulation\.speed is .*expected 1 .* or max"):
        clock_for(replace(SIMULATED, simulation={"rover": "rover.yaml", "speed": asked}))


def test_real_devices_refuse_a_time_of_another_speed() -> None:
    simulation = {"rover": "rover.yaml", "speed": "max"}
    head = HardwareSettings(DeviceSettings("dynamixel"), SIMULATED.cameras, simulation)
    eye = HardwareSettings(SIMULATED.pan_tilt, {"navcam_left": DeviceSettings("v4l2")}, simulation)
    for settings, device in ((head, "pan_tilt"), (eye, "navcam_left")):
        with pytest.raises(BadOptions, match=rf"{device}: .*speed is max, expected 1: .* runs in real time"):
            clock_for(settings)


def test_a_lock_is_kept_while_its_thread_waits_on_the_clock() -> None:
    clock = SimulationClock()
    turn, order = ClockLock(clock), []

    def works(name: str) -> None:
        with turn, turn:
            order.append(f"{name} began")
            clock.sleep(1.0)
            order.append(f"{name} ended")

    def looks() -> None:
        clock.sleep(0.5)
        order.append(f"free {turn.acquire(blocking=False)}")

    ended(started(clock, lambda: works("one"), lambda: works("two"), looks))
    assert order == ["one began", "free False", "one ended", "two began", "two ended"]
    assert clock.now_s() == 2.0
    assert turn.acquire(blocking=False)

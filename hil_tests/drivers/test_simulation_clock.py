"""The simulation's clock: time stands while anybody computes, and jumps when all wait."""

from __future__ import annotations

import gc
import itertools
import math
import random
import threading
import time
from collections.abc import Callable
from dataclasses import replace

import pytest

from drivers import simulation_clock
from drivers.clock import ClockLock, SystemClock
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


def test_a_day_passes_in_no_time_and_to_the_last_bit() -> None:
    clock = SimulationClock()
    began_s = time.monotonic()
    clock.sleep(86400.0)
    assert clock.now_s() == 86400.0
    assert time.monotonic() - began_s < LONG_S


@pytest.mark.parametrize("speed", [math.inf, 1000.0])
def test_a_wait_that_is_interrupted_in_the_moment_of_its_turn_keeps_nobody_waiting(
    speed: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, gone_on = SimulationClock(speed), threading.Event()

    def interrupted(self: threading.Event, timeout: float | None = None) -> bool:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(threading.Event, "wait", interrupted)
        with pytest.raises(KeyboardInterrupt), clock.at_work():
            pass
    thread = clock.thread(gone_on.set, "the next one")
    thread.start()
    assert gone_on.wait(LONG_S)


def test_a_paced_clock_that_nobody_has_any_more_leaves_no_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulation_clock, "STILL_WANTED_S", 0.01)
    before = set(threading.enumerate())
    clock = SimulationClock(1000.0)
    clock.sleep(1.0)
    (pacing,) = set(threading.enumerate()) - before
    del clock
    gc.collect()
    pacing.join(LONG_S)
    assert not pacing.is_alive()


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


def test_who_was_notified_holds_the_time_before_it_goes_on() -> None:
    clock = SimulationClock()
    signal, seen = clock.signal(), []

    def waits() -> None:
        with signal:
            signal.wait()
        seen.append(("woken", clock.now_s()))

    def ticks() -> None:
        with signal:
            signal.notify_all()
        clock.sleep(1.0)
        seen.append(("ticked", clock.now_s()))

    ended(started(clock, waits, ticks))
    assert seen == [("woken", 0.0), ("ticked", 1.0)]


def test_a_thread_that_the_clock_does_not_know_is_let_in_between_two_turns() -> None:
    clock = SimulationClock()
    together: list[str] = []
    gone = threading.Event()

    def works() -> None:
        for _ in range(50):
            together.append("in")
            time.sleep(1e-4)
            together.append("out")
            clock.sleep(0.01)

    threads = started(clock, works)

    def guest() -> None:
        with clock.at_work(), clock.at_work():  # also within itself
            together.append("in")
            time.sleep(1e-3)
            together.append("out")
        gone.set()

    threading.Thread(target=guest, daemon=True).start()
    assert gone.wait(LONG_S)
    ended(threads)
    assert together == ["in", "out"] * 51


def test_a_thread_that_cannot_start_does_not_keep_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimulationClock()
    thread = clock.thread(lambda: None, "never")

    def refuses(self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", refuses)
        with pytest.raises(RuntimeError):
            thread.start()
    clock.sleep(1.0)
    assert clock.now_s() == 1.0


def test_a_thread_that_ends_by_an_error_does_not_keep_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = SimulationClock()
    monkeypatch.setattr(threading, "excepthook", lambda told: None)

    def fails() -> None:
        raise ValueError("no")

    ended(started(clock, fails, lambda: clock.sleep(3.0)))
    assert clock.now_s() == 3.0


def test_at_a_finite_speed_time_goes_on_by_itself_and_never_past_who_waits() -> None:
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


def test_at_a_finite_speed_computing_holds_the_time() -> None:
    clock = SimulationClock(1000.0)
    with clock.at_work():
        before_s = clock.now_s()
        time.sleep(0.02)
        assert clock.now_s() == before_s


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan])
def test_a_speed_that_is_none_is_refused(speed: float) -> None:
    with pytest.raises(ValueError, match="positive"):
        SimulationClock(speed)


SIMULATED = HardwareSettings(
    DeviceSettings("sim", {}), {"navcam_left": DeviceSettings("sim", {})}, {"rover": "rover.yaml"}
)


@pytest.mark.parametrize(("asked", "speed"), [("max", math.inf), (10, 10.0), (0.5, 0.5)])
def test_a_simulation_lives_on_the_clock_that_it_asks_for(asked: object, speed: float) -> None:
    clock = clock_for(replace(SIMULATED, simulation={"rover": "rover.yaml", "speed": asked}))
    assert isinstance(clock, SimulationClock)
    assert clock.speed == speed


def test_as_life_is_the_machines_own_clock() -> None:
    assert isinstance(clock_for(SIMULATED), SystemClock)
    assert isinstance(clock_for(replace(SIMULATED, simulation={"speed": 1})), SystemClock)


@pytest.mark.parametrize("asked", [0, -1, 1001, "fast", True, None, math.nan, [10]])
def test_a_speed_that_is_none_is_refused_with_what_would_be_right(asked: object) -> None:
    with pytest.raises(BadOptions, match=r"simulation\.speed is .*expected 1 .* or max"):
        clock_for(replace(SIMULATED, simulation={"rover": "rover.yaml", "speed": asked}))


@pytest.mark.parametrize("driver", ["dynamixel", "flir_ptu", "v4l2", "package.module:factory"])
def test_real_devices_refuse_a_time_of_another_speed(driver: str) -> None:
    simulation = {"rover": "rover.yaml", "speed": "max"}
    head = HardwareSettings(DeviceSettings(driver, {}), SIMULATED.cameras, simulation)
    eye = HardwareSettings(SIMULATED.pan_tilt, {"navcam_left": DeviceSettings(driver, {})}, simulation)
    for settings, device in ((head, "pan_tilt"), (eye, "navcam_left")):
        with pytest.raises(BadOptions, match=rf"{device}: .*'{driver}' lives in real time"):
            clock_for(settings)


def test_a_simulated_wire_follows_it() -> None:
    simulation = {"rover": "rover.yaml", "speed": 10, "wire": "dynamixel"}
    clock = clock_for(replace(SIMULATED, simulation=simulation))
    assert isinstance(clock, SimulationClock) and clock.speed == 10


def test_a_turn_is_kept_while_its_thread_waits_on_the_clock_and_may_be_taken_twice() -> None:
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


def test_a_signal_of_the_machines_clock_wakes_all_who_wait_and_nobody_twice() -> None:
    signal, told = SystemClock().signal(), []

    def waits() -> None:
        with signal:
            told.append("waits")
            told.append(str(signal.wait(LONG_S)))

    with signal:
        assert not signal.wait(0.001)
        assert not signal.wait(-1.0), "a moment that has passed"
        signal.notify_all()  # nobody waits any more
        assert not signal.wait(0.001), "what was told before is not told again"
    threads = [threading.Thread(target=waits, daemon=True) for _ in range(3)]
    for thread in threads:
        thread.start()
    while True:
        with signal:
            if told.count("waits") == 3:
                signal.notify_all()
                break
    ended(threads)
    assert told == ["waits"] * 3 + ["True"] * 3

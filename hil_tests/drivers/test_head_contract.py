"""What every pan/tilt driver has to do, whatever stands behind it: one suite for all of them.

Without bytes; Dynamixel servos and a PTU over a line in memory: on a turned clock. Over a pseudo terminal and
TCP, on the machine's clock, are only a move, a pulled plug and what closing leaves, which need no deadline.
What is true is known from the simulated motors, never from the driver. The last case is the demo's pointing
loop.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import TypeVar

import numpy as np
import pytest

from calib.geometry.rigid import FloatArray
from drivers.errors import DriverError, LineLost, NoReply
from drivers.interfaces import Reading
from drivers.simulation_clock import MAX
from hil_tests.left_behind import held
from hil_tests.support.servo_rigs import LIMITS_RAD, RIGS, TURNED, HeadRig
from hil_tests.waiting import until
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon
from mastctl.experiment.pointing import run_pointing_experiment
from mastctl.experiment.simulated import simulated_config, simulation_truth
from mastctl.testing.drivers import test_head as suite
from mastctl.testing.drivers.test_head import HeadTrial

REAL = [name for name in RIGS if name != "in_memory"]
WIRES = ["dynamixel", "feetech", "ptu"]
OTHER = pytest.mark.long(2, "its session is that of Dynamixel's, and quick where a line is wanted (feetech)")
LATER = ("feetech", "feetech_echo")
SAME = [pytest.param(name, marks=OTHER) for name in LATER]
QUICK = [name for name in TURNED if name not in LATER]
MADE = {**RIGS, **TURNED}
T = TypeVar("T")


@pytest.fixture(params=[*QUICK, *SAME])
def rig(request: pytest.FixtureRequest) -> Iterator[HeadRig]:
    with MADE[request.param]() as made:
        yield made


@pytest.fixture(params=[*WIRES, pytest.param("feetech_echo", marks=OTHER)])
def wired(request: pytest.FixtureRequest) -> Iterator[HeadRig]:
    with MADE[request.param]() as made:
        yield made


class TrueTrial(HeadTrial):
    """The rig as the acceptance of heads takes one; every reading is compared with the motors."""

    def __init__(self, rig: HeadRig) -> None:
        super().__init__(
            rig.head, LIMITS_RAD, 1.0, limits_rad=LIMITS_RAD,
            count_rad=rig.count_rad, settle_rad=rig.settle_rad, clock=rig.clock,
        )  # fmt: skip
        self.rig = rig

    def read(self) -> Reading:
        began_s = self.clock.now_s()
        reading = super().read()
        assert true_enough(self.rig, reading, began_s, self.clock.now_s())
        return reading

    def angles_at(self, moments_s: FloatArray, readings: list[Reading]) -> FloatArray:
        return np.array([self.rig.true_rad(float(moment_s)) for moment_s in moments_s])


def settled(rig: HeadRig) -> Reading:
    """Read until the head has settled."""
    readings: list[Reading] = []

    def stands() -> bool:
        readings.append(rig.head.read())
        return not readings[-1].moving

    until(stands, "settling", clock=rig.clock)
    return readings[-1]


def works_again(rig: HeadRig) -> Reading:
    """Read until the head answers again."""
    readings: list[Reading] = []

    def answers() -> bool:
        try:
            readings.append(rig.head.read())
        except DriverError:
            return False
        return True

    until(answers, "an answer", clock=rig.clock)
    return readings[-1]


def attempt(call: Callable[[], T]) -> T | None:
    """What a call returns; None for an error, as a starved simulator behind a real line may cause."""
    try:
        return call()
    except DriverError:
        return None


def brought(rig: HeadRig, *goal: float) -> None:
    """Send the head to a goal and see it settle there."""

    def there() -> bool:
        attempt(rig.head.stop)
        attempt(lambda: rig.head.move(*goal))
        while (reading := attempt(rig.head.read)) and reading.moving:
            rig.clock.sleep(0.005)
        found = reading and (reading.pan_rad, reading.tilt_rad)
        return bool(found == pytest.approx(goal, abs=rig.count_rad))

    until(there, f"rest at {goal}", clock=rig.clock)


def true_enough(rig: HeadRig, reading: Reading, began_s: float, ended_s: float) -> bool:
    """Whether the motors were where a reading has them, at some moment of the call."""
    steps = [began_s + (ended_s - began_s) * i / 20 for i in range(21)]
    truths = [rig.true_rad(step) for step in steps]
    for axis, angle in enumerate((reading.pan_rad, reading.tilt_rad)):
        seen = [truth[axis] for truth in truths]
        if not min(seen) - rig.count_rad <= angle <= max(seen) + rig.count_rad:
            return False
    return True


def true_reading(rig: HeadRig) -> Reading:
    """Read, and see that it is true."""
    began_s = rig.clock.now_s()
    reading = rig.head.read()
    ended_s = rig.clock.now_s()
    assert true_enough(rig, reading, began_s, ended_s), (reading, rig.true_rad(ended_s))
    assert began_s <= reading.time_s <= ended_s
    return reading


@pytest.mark.parametrize("promise", [name for name in vars(suite) if name.startswith("test_")])
def test_every_head_keeps_every_promise(rig: HeadRig, promise: str) -> None:
    getattr(suite, promise)(TrueTrial(rig))


@pytest.mark.parametrize("name", REAL)
def test_over_a_real_line_it_moves_and_comes_back_after_a_pulled_plug(name: str) -> None:
    with RIGS[name]() as rig:
        assert rig.line is not None
        brought(rig, 0.2, 0.1)
        held = rig.true_rad(rig.clock.now_s())
        rig.line.hang_up()
        until(lambda: attempt(rig.head.read) is None, "an error")
        rig.line.come_back()
        until(lambda: attempt(rig.head.read), "an answer")
        assert rig.true_rad(rig.clock.now_s()) == pytest.approx(held, abs=rig.count_rad)
        brought(rig, 0.0, 0.0)


@pytest.mark.parametrize("asked", [0.3, 50.0])
def test_no_axis_goes_faster_than_asked_or_than_its_own_bound(rig: HeadRig, asked: float) -> None:
    assert rig.fastest_rad_per_s is not None
    bound = min(asked, rig.fastest_rad_per_s)
    fastest, unsure = TrueTrial(rig).fastest_seen(asked)
    assert fastest <= bound * 1.02 + unsure
    assert fastest >= min(bound, 1.0) * 0.3, "nor much slower"


def test_what_is_measured_is_told_not_what_was_commanded(rig: HeadRig) -> None:
    rig.head.move(0.2, 0.1)
    at = settled(rig)
    rig.panel.set("pan_tilt", "stuck")
    rig.head.move(0.6, -0.2)
    for _ in range(10):
        reading = true_reading(rig)
        rig.clock.sleep(0.01)
    assert (reading.pan_rad, reading.tilt_rad) == pytest.approx((at.pan_rad, at.tilt_rad), abs=1e-9)


def test_an_axis_that_does_not_follow_is_told_in_words(wired: HeadRig) -> None:
    settled(wired)
    wired.panel.set("pan_tilt", "stuck")
    wired.head.move(0.5, -0.3)
    words: list[str] = []

    def told() -> bool:
        try:
            words[:] = wired.head.read().faults
        except DriverError as error:
            words[:] = [str(error)]
        return bool(words)

    until(told, "a fault in words", clock=wired.clock)
    assert all(" " in word and "\n" not in word for word in words)
    assert any("pan" in word or "tilt" in word for word in words), words


def test_a_silent_device_is_an_error_and_comes_back_without_moving(rig: HeadRig) -> None:
    rig.head.move(0.2, 0.1)
    settled(rig)
    held = rig.true_rad(rig.clock.now_s())
    rig.panel.set("pan_tilt", "off")
    for _ in range(2):
        with pytest.raises((NoReply, LineLost)) as caught:
            rig.head.read()
        assert "\n" not in str(caught.value)
    with pytest.raises((NoReply, LineLost)):
        rig.head.move(0.4, 0.2)
    rig.panel.clear()
    works_again(rig)
    reading = settled(rig)
    assert (reading.pan_rad, reading.tilt_rad) == pytest.approx(held, abs=rig.count_rad + rig.settle_rad)
    assert rig.true_rad(rig.clock.now_s()) == pytest.approx(held, abs=rig.count_rad + rig.settle_rad)
    for _ in range(10):  # and goes on as before
        try:
            rig.head.stop()  # deliberate where a watchdog has stopped the head
            rig.head.move(0.0, 0.0)
            break
        except DriverError:
            rig.clock.sleep(0.05)
    assert settled(rig).pan_rad == pytest.approx(0.0, abs=rig.count_rad + rig.settle_rad)


def test_a_pulled_plug_is_an_error_and_the_head_comes_back_by_itself(wired: HeadRig) -> None:
    assert wired.line is not None
    wired.head.move(0.2, 0.1)
    settled(wired)
    held = wired.true_rad(wired.clock.now_s())
    for _ in range(2):
        wired.line.hang_up()

        def fails() -> bool:
            try:
                wired.head.read()
            except (LineLost, NoReply):
                return True
            return False

        until(fails, "an error", clock=wired.clock)
        wired.line.come_back()
        works_again(wired)
    reading = settled(wired)
    assert (reading.pan_rad, reading.tilt_rad) == pytest.approx(held, abs=wired.count_rad)
    assert wired.true_rad(wired.clock.now_s()) == pytest.approx(held, abs=wired.count_rad)


def test_a_late_reply_is_never_taken_for_the_next(wired: HeadRig) -> None:
    settled(wired)
    wired.panel.set("pan_tilt", "delayed", delay_s=0.4)
    for goal in (0.5, -0.5):
        with suppress(DriverError):
            wired.head.move(goal, 0.0)
        for _ in range(2):
            began_s = wired.clock.now_s()
            try:
                reading = wired.head.read()
            except DriverError:
                continue
            assert true_enough(wired, reading, began_s, wired.clock.now_s())
    wired.panel.clear()
    for _ in range(40):
        began_s = wired.clock.now_s()
        try:
            reading = wired.head.read()
        except DriverError:
            continue
        assert true_enough(wired, reading, began_s, wired.clock.now_s())


@pytest.mark.parametrize("name", list(MADE))
def test_close_stops_the_head_and_leaves_no_thread_and_no_descriptor(name: str) -> None:
    before = held()
    with MADE[name]() as rig:
        attempt(lambda: rig.head.move(0.9, 0.3, 0.5))
        until(lambda: (r := attempt(rig.head.read)) and r.pan_rad > 0.05, "motion", clock=rig.clock)
        rig.head.close()
        rig.head.close()
        for call in (rig.head.read, rig.head.stop, lambda: rig.head.move(0.0, 0.0)):
            with pytest.raises(NoReply, match="closed"):
                call()
        until(lambda: _stands(rig), "standing", clock=rig.clock)
        assert rig.true_rad(rig.clock.now_s())[0] < (0.6 if name in TURNED else 0.89)
    until(lambda: held() <= before, "the end of every thread, and no descriptor")


def test_close_of_a_head_that_is_gone_does_not_raise(wired: HeadRig) -> None:
    assert wired.line is not None
    wired.line.hang_up()
    wired.head.close()
    wired.head.close()


def test_close_stops_a_head_whose_line_is_away_as_soon_as_it_is_back(wired: HeadRig) -> None:
    line = wired.line
    assert line is not None
    attempt(lambda: wired.head.move(0.9, 0.3, 0.3))
    until(lambda: (r := attempt(wired.head.read)) and r.pan_rad > 0.05, "motion", clock=wired.clock)
    line.hang_up()
    until(lambda: attempt(wired.head.read) is None, "an error", clock=wired.clock)

    def back() -> None:
        wired.clock.sleep(0.4)
        line.come_back()

    wired.clock.thread(back, "a cable plugged in again").start()
    wired.head.close()
    until(lambda: _stands(wired), "standing", clock=wired.clock)
    assert wired.true_rad(wired.clock.now_s())[0] < 0.8


def _stands(rig: HeadRig) -> bool:
    now_s = rig.clock.now_s()
    return rig.true_rad(now_s) == rig.true_rad(now_s - 0.05)


ANOTHER_HEAD = pytest.mark.long(1, "the loop with another head; one of each maker is in the quick run")


@pytest.mark.parametrize(
    ("wire", "head", "worst_px"),
    [
        pytest.param(None, "ptu_d46_70", 1.5, marks=ANOTHER_HEAD),
        ("flir_ptu", "ptu_d46_70", 1.5),
        ("dynamixel", "dynamixel_x", 6.0),
        pytest.param("dynamixel", "ph42", 1.5, marks=ANOTHER_HEAD),
    ],
)
@pytest.mark.usefixtures("one_scene")
def test_the_demos_pointing_loop_lands_with_every_head(wire: str | None, head: str, worst_px: float) -> None:
    # A count of the X is 2 px and its backlash 5.6 px of the navcam; the PTU's steps are 0.07 px.
    config = simulated_config(load_config(None), head=head, wire=wire, seed=1, speed=MAX)
    simulation = {**config.hardware.simulation, "samples": 1}
    cameras = {n: c for n, c in config.hardware.cameras.items() if n.startswith("navcam")}
    hardware = replace(config.hardware, simulation=simulation, cameras=cameras)
    with RunningDaemon(replace(config, hardware=hardware)) as daemon, Client(daemon.url) as client:
        simulated = daemon.hardware.simulation
        assert simulated is not None
        found = run_pointing_experiment(
            client, targets=1, distances_m=(6.0,), seed=1, truth=simulation_truth(simulated)
        )
    assert [record.error for record in found.records] == [""]
    worst = found.summaries[0].true_second_rms_px
    assert worst is not None and max(worst) < worst_px, worst

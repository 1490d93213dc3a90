"""Read angles become true ones, and true ones readings to send: against the simulated head's own gears."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from calib.geometry.rig import AxisJoint, JointErrors
from drivers.clock import ManualClock, SystemClock
from drivers.interfaces import AxisMotion, Reading
from drivers.sim.heads import head_settings
from drivers.sim.pan_tilt import SimulatedPanTilt
from hil_tests.mastctl.service_fakes import FakeHardware, rig
from mastctl.devices import judge
from mastctl.devices.devices import Devices
from mastctl.devices.joint_history import HeadReading, JointHistory
from mastctl.devices.judge import KeepOutJudge, Limits

HARMONICS = ((0.006, -0.002), (0.0015, 0.001))
BACKLASH_RAD = 0.004
COUNT_RAD = math.tau / 4096
ORDER_RAD = 3e-5
"""The simulator has its play behind the encoder's error, the contract's formula before it: a part of 6e-3 of
half the play, and 4 times that in the second harmonic."""
LIMITS = Limits((-2.5, 2.5), (-1.4, 1.4), 1.0)


def simulated(clock: ManualClock, **more: Any) -> SimulatedPanTilt:
    harmonics = [list(one) for one in HARMONICS]
    gears = {"pan_harmonics_rad": harmonics, "tilt_harmonics_rad": harmonics, "backlash_rad": BACKLASH_RAD}
    settings = head_settings({"preset": "dynamixel_x", "sag_rad": 0.0} | gears | more)
    return SimulatedPanTilt(settings, clock)


TOLD = JointErrors(AxisJoint(HARMONICS, BACKLASH_RAD), AxisJoint(HARMONICS, BACKLASH_RAD))


@dataclass
class Bench:
    """A simulated head, read as the daemon does."""

    options: dict[str, Any] = field(default_factory=dict)
    joints: JointErrors = TOLD
    history: JointHistory = field(init=False)

    def __post_init__(self) -> None:
        self.clock = ManualClock(100.0)
        self.head = simulated(self.clock, **self.options)
        self.history = JointHistory(self.joints)
        self.devices = object.__new__(Devices)  # of it only `goal` is asked: no thread, no camera
        self.devices._joints = self.joints
        self.devices.judge = KeepOutJudge(LIMITS, self.head, self.clock, "head", None, None)
        self.here = self.history.add(self.head.read())

    def go(self, pan_rad: float, tilt_rad: float) -> HeadReading:
        self.head.move(pan_rad, tilt_rad, 1.0)
        while True:
            self.clock.advance(0.02)
            self.here = self.history.add(self.head.read())
            if not self.here.moving:
                return self.here

    def off_rad(self) -> np.ndarray:
        """What the true angles are wrong by."""
        return np.subtract(self.here.true_rad, self.head.true_joints(self.clock.now_s()))


def test_true_angles_are_those_of_the_simulated_gears() -> None:
    bench, rng = Bench(), np.random.default_rng(3)
    bench.go(0.4, -0.3)
    place = np.array([0.4, -0.3])
    for number in range(60):
        reach = 0.8 if number % 3 == 0 else 3.0 * BACKLASH_RAD  # moves within the play too
        place = np.clip(place + rng.uniform(-reach, reach, 2), (-2.0, -1.2), (2.0, 1.2))
        bench.go(*place)
        assert np.abs(bench.off_rad()).max() < ORDER_RAD, f"seed 3, move {number}"
    read = bench.here.pan_rad, bench.here.tilt_rad
    assert np.abs(np.subtract(read, bench.here.true_rad)).max() > 1e-3, "there was something to correct"


@pytest.mark.parametrize("approach_rad", [0.0, 0.02])
def test_goals_bring_the_axes_to_true_angles_within_half_a_count(approach_rad: float) -> None:
    bench, rng = Bench({"approach_rad": approach_rad}), np.random.default_rng(5)
    bench.go(0.2, 0.2)
    place = np.array([0.2, 0.2])
    for number in range(40):
        reach = 0.7 if number % 4 == 0 else 2.0 * BACKLASH_RAD
        place = np.clip(place + rng.uniform(-reach, reach, 2), (-1.5, -1.0), (1.5, 1.0))
        goal = bench.devices.goal((float(place[0]), float(place[1])), bench.here)
        bench.go(*goal)
        off = np.subtract(bench.head.true_joints(bench.clock.now_s()), place)
        assert np.abs(off).max() < 0.51 * COUNT_RAD, f"seed 5, move {number}: {off}"


@pytest.mark.parametrize("turnover_rad", [-0.2, 0.3])
def test_a_goal_near_the_turnover_counts_the_side_of_approach(
    turnover_rad: float,
) -> None:
    bench = Bench()
    hangs = AxisMotion(1.0, rising_below_rad=turnover_rad)
    bench.devices.judge.axes = {"pan": AxisMotion(1.0), "tilt": hangs}
    for past_rad in (-0.007, -0.003, 0.003, 0.007):  # from it, in readings: the true angle is 5 mrad away
        wanted_rad = TOLD.tilt.true_rad(turnover_rad + past_rad)
        assert abs(wanted_rad - turnover_rad - past_rad) > 0.003, "there is something to mistake"
        goal_rad = bench.devices.goal((0.1, wanted_rad), bench.here)[1]
        comes_to_rad = TOLD.tilt.true_rad(goal_rad, hangs.turn_to(goal_rad))
        assert comes_to_rad == pytest.approx(wanted_rad, abs=1e-12), past_rad


def rows(*pans: float, joints: JointErrors) -> JointHistory:
    made = JointHistory(joints)
    for number, pan in enumerate(pans):
        made.add(Reading(pan, 0.0, False, 1.0 + 0.05 * number))
    return made


def approach(*pans: float, joints: JointErrors) -> float:
    newest = rows(*pans, joints=joints).newest
    assert newest is not None
    return newest.approach[0]


def test_the_side_is_not_known_before_the_head_has_gone_through_its_play() -> None:
    wide = JointErrors(AxisJoint((), 0.01))
    assert approach(0.5, joints=wide) == 0.0
    assert approach(0.5, 0.505, joints=wide) == pytest.approx(0.5), "somewhere in the upper half"
    assert approach(0.5, 0.51, joints=wide) == 1.0
    assert approach(0.5, 0.51, 0.505, joints=wide) == pytest.approx(0.0), "within the play"
    assert approach(0.5, 0.51, 0.49, joints=wide) == -1.0


def test_a_head_says_from_which_side_it_comes_by_itself() -> None:
    gravity = AxisMotion(1.0, 0.02, rising_below_rad=0.3)
    assert (gravity.turn_to(0.1), gravity.turn_to(0.4), AxisMotion(1.0).turn_to(0.1)) == (1, -1, 0)
    goals = [AxisJoint((), 0.01).goal_rad(0.5, 0.2, 0.0, turn) for turn in (1, -1, 0)]
    assert goals == pytest.approx([0.505, 0.495, 0.505])


def test_the_sun_is_kept_out_where_the_head_reads_it() -> None:
    joint = AxisJoint(((0.02, 0.0),), 0.01)
    low, high = judge._as_read(joint, (0.1, 0.3))
    assert max(joint.true_rad(low, side) for side in (-1, 0, 1)) == pytest.approx(0.1, abs=1e-12)
    assert min(joint.true_rad(high, side) for side in (-1, 0, 1)) == pytest.approx(0.3, abs=1e-12)


def test_what_the_devices_read_is_true_by_their_rigs_joints() -> None:
    hardware = FakeHardware()
    hardware.head.pan_rad = 0.7
    devices = Devices(
        hardware.pan_tilt, hardware.cameras, LIMITS, "0" * 64, SystemClock(), replace(rig(), joints=TOLD)
    )
    try:
        reading = devices.read()
        assert reading.true_rad == pytest.approx(TOLD.true_rad((0.7, 0.0), reading.approach))
        assert abs(reading.true_rad[0] - 0.7) > 1e-3
    finally:
        devices.close()

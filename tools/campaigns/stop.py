"""How soon a stop brakes one axis of a Dynamixel head while the other's servo fails, on the byte simulator.

    python -m tools.campaigns.stop [--cases N] [--seed S]

Each trial moves both axes, lets one servo fail, waits a random while (the failure is then unnoticed, being
missed, or has already ended the session) and calls stop. For the axis that can be reached it tells when its
servo had the brake, counted from the call, how far it went beyond a perfect brake from there, and how long
the call took. The watchdog is 0.3 s and a reply is waited for 0.05 s, as they come.
"""

from __future__ import annotations

import logging
import random
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from drivers.errors import DriverError
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_servo import VOLTAGE
from tools.campaigns.servo_rigs import ACCELERATION_RAD_PER_S2, HeadRig, dynamixel
from tools.command import end, options, run_cases

AXES = ("pan", "tilt")
LONGEST_S = 20.0
LATEST_S = 0.25
"""How long after the failure the stop comes at most."""


def _line_fault(word: str, **parameters: float) -> Callable[[HeadRig, DynamixelBus, int], None]:
    def begin(rig: HeadRig, bus: DynamixelBus, axis: int) -> None:
        rig.panel.set("pan_tilt", word, sender=axis + 1, replies=1e9, **parameters)

    return begin


FAULTS: dict[str, Callable[[HeadRig, DynamixelBus, int], None]] = {
    "none": lambda rig, bus, axis: None,
    "unpowered": lambda rig, bus, axis: bus.servos[axis].set_power(False, time.monotonic()),
    "mute": _line_fault("mute"),
    "corrupt": _line_fault("corrupt"),
    "noise": _line_fault("noise"),
    "late 0.03 s": _line_fault("late", delay_s=0.03),
    "late 0.15 s": _line_fault("late", delay_s=0.15),
    "alert": lambda rig, bus, axis: bus.servos[axis].raise_error(VOLTAGE),
}


@dataclass
class StopResult:
    """One trial: seconds from the call to the brake and for the call, radians beyond a perfect brake."""

    brake_s: float
    call_s: float
    beyond_rad: float


@dataclass(frozen=True)
class StopTrial:
    """One servo, by its axis, that has failed ``after_s`` seconds ago when the stop comes."""

    fault: str
    axis: int
    number: int
    after_s: float


def trial(one: StopTrial) -> StopResult:
    """Stop a moving head of which one servo has failed; tell of the other axis."""
    logging.disable(logging.CRITICAL)  # each trial gives a line up, and says so
    fault, axis, after_s = one.fault, one.axis, one.after_s
    with dynamixel(watchdog_s=0.3, reply_timeout_s=0.05) as rig:
        assert rig.line is not None and isinstance(rig.line.device, DynamixelBus)
        bus, other = rig.line.device, 1 - axis
        changes: list[tuple[float, int]] = []
        true_receive = bus.receive

        def receive(data: bytes, time_s: float) -> Sequence[object]:
            before = bus.servos[other].table["goal_position"]
            replies = true_receive(data, time_s)
            after = bus.servos[other].table["goal_position"]
            if after != before:
                changes.append((time_s, after))
            return replies

        rig.head.move(-0.95, -0.55)
        _until(lambda: rig.head.read().moving is False)
        bus.receive = receive  # type: ignore[method-assign, assignment]
        rig.head.move(0.95, 0.35)
        _until(lambda: rig.true_rad(time.monotonic())[other] > (-0.75, -0.4)[other])
        FAULTS[fault](rig, bus, axis)
        with bus.held():
            changes.clear()
        until_s = time.monotonic() + after_s
        while time.monotonic() < until_s:
            time.sleep(0.001)
        called_s = time.monotonic()
        with suppress(DriverError):
            rig.head.stop()
        call_s = time.monotonic() - called_s
        _until(lambda: rig.true_rad(time.monotonic()) == rig.true_rad(time.monotonic() - 0.02))
        brake_s = changes[0][0]  # before the call where the session had ended by itself
        way_rad = abs(rig.true_rad(time.monotonic())[other] - rig.true_rad(brake_s)[other])
        step_s = 0.002
        speed = (rig.true_rad(brake_s)[other] - rig.true_rad(brake_s - step_s)[other]) / step_s
        perfect_rad = speed**2 / (2 * ACCELERATION_RAD_PER_S2)
        return StopResult(max(0.0, brake_s - called_s), call_s, way_rad - perfect_rad)


def _until(true: Callable[[], bool]) -> None:
    end_s = time.monotonic() + LONGEST_S
    while not true():
        if time.monotonic() > end_s:
            raise TimeoutError("what must come did not come")
        time.sleep(0.002)


def main() -> int:
    """Run the campaign and print its table."""
    parser = options(__doc__, 5, "trials of a fault and axis")
    parser.set_defaults(workers=1)  # times are measured: two at once would make each other late
    args = parser.parse_args()
    trials = [
        StopTrial(fault, axis, number, _after_s(args.seed, fault, axis, number))
        for fault in FAULTS
        for axis in range(len(AXES))
        for number in range(args.cases)
    ]
    found = run_cases(
        args, "trials", trial, trials, lambda one: f"{one.fault}, {AXES[one.axis]}, trial {one.number}"
    )
    print(
        "fault          failed  brake ms: median  worst   call ms: worst   beyond a perfect brake mrad: worst"
    )
    for fault in FAULTS:
        for axis, name in enumerate(AXES):
            rows = [
                row for one, row in zip(trials, found, strict=True) if (one.fault, one.axis) == (fault, axis)
            ]
            brakes = sorted(1000 * row.brake_s for row in rows)
            print(
                f"{fault:<14} {name:<6} {brakes[len(brakes) // 2]:>16.1f} {brakes[-1]:>7.1f}"
                f" {1000 * max(row.call_s for row in rows):>15.0f}"
                f" {1000 * max(row.beyond_rad for row in rows):>35.1f}",
            )
    return 0


def _after_s(seed: int, fault: str, axis: int, number: int) -> float:
    """How long after the failure the stop comes, by a draw of the trial's own."""
    return random.Random(f"{seed}/{fault}/{axis}/{number}").uniform(0.0, LATEST_S)


if __name__ == "__main__":
    end(main)

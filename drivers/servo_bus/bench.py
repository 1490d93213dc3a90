"""What a person is told of servos on the bench, whatever their family: found, read, tried out."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FoundServo:
    """A servo that answered a scan."""

    baud: int
    servo_id: int
    model_number: int
    model: str
    firmware: int | str
    hardware_errors: tuple[str, ...]


@dataclass(frozen=True)
class Scan:
    """What a scan found; ``garbled`` are the baud rates at which bytes came that were no reply."""

    found: tuple[FoundServo, ...]
    bauds: tuple[int, ...]
    garbled: tuple[int, ...]


@dataclass(frozen=True)
class ServoFacts:
    """Everything a servo says: its registers as they stand, and in words where a number needs them."""

    servo_id: int
    model: str
    firmware: int | str
    values: dict[str, int]
    words: dict[str, str]


@dataclass(frozen=True)
class TrialStep:
    """One short move of a trial: where it should have gone, where it went, and how hard it was."""

    goal_counts: int
    measured_counts: int
    seconds: float
    most_current_A: float | None
    voltage_V: float
    temperature_C: int

    @property
    def left_counts(self) -> int:
        """Measured minus goal."""
        return self.measured_counts - self.goal_counts


@dataclass(frozen=True)
class Trial:
    """A trial's steps, and the servo's model; the unit of its speed where that had to be found out."""

    servo_id: int
    model: str
    count_rad: float
    start_counts: int
    steps: tuple[TrialStep, ...] = ()
    speed_unit_counts: int | None = None

"""Servos of any family on the bench: a scan, another id, a short trial, and the records of these."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from shlex import quote
from typing import TypeVar

from drivers.clock import Clock
from drivers.errors import BadOptions, DriverError, HardwareFault, OutOfRange, WrongDevice
from drivers.servo_bus.course import PROFILE_BIT, ServoSample
from drivers.servo_bus.link import BusLink
from drivers.servo_bus.rest import Rest

HIGHEST_ID = 252
WARM_MARGIN_C = 10  # below the servo's own limit
TRIAL_POLL_S, LONGEST_STEP_S = 0.02, 10.0
STEP_RESTS_S = 0.2  # where the servo has said besides that its move is over
L = TypeVar("L", bound=BusLink)


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


def scanned(
    bauds: Sequence[int], opened: Callable[[int], L], there: Callable[[L], tuple[list[FoundServo], int]]
) -> Scan:
    """Ask at every baud rate who is there.

    Parameters
    ----------
    bauds
        To try, bits per second.
    opened
        Opens the line at one of them.
    there
        Returns who answers on it, and how many bytes came that were no reply.

    Raises
    ------
    LineLost, BadOptions
        If the line cannot be opened at all, or the adapter cannot do a rate.
    """
    found: list[FoundServo] = []
    garbled: list[int] = []
    for baud in bauds:
        link = opened(baud)
        try:
            servos, noise = there(link)
        finally:
            link.close()
        found += servos
        garbled += [baud] if noise else []
    return Scan(tuple(found), tuple(bauds), tuple(garbled))


def check_change(link: BusLink, old: int, new: int, new_baud: int | None, rates: Collection[int]) -> None:
    """Pass a new id and baud rate that a servo can be given. Raises BadOptions."""
    for name, value in (("old", old), ("new", new)):
        if not 0 <= value <= HIGHEST_ID:
            raise BadOptions(f"the {name} id {value} cannot be; an id is 0 to {HIGHEST_ID}")
    if new_baud is not None and new_baud not in rates:
        raise BadOptions(f"{new_baud} baud cannot be; there is {', '.join(map(str, rates))}")
    if old == new and new_baud in (None, link.baud):
        raise BadOptions(f"servo {old} already has this id and baud rate; there is nothing to do")


@dataclass
class Change:
    """A change of a servo's id and rate that is under way.

    Attributes
    ----------
    line
        The command's words for the line.
    ids, bauds
        Those under which the servo may answer now.
    new_baud
        The rate that it is to have in the end, if another.
    """

    line: str
    ids: list[int]
    bauds: list[int]
    new_baud: int | None

    def words(self) -> str:
        """Say what the servo is left with, and how to go on."""
        ids, bauds = " or ".join(map(str, self.ids)), " or ".join(map(str, self.bauds))
        scan = f"'mastctl servo scan {self.line} --baud {bauds.replace(' or', '')}' shows which"
        told = f"the servo is left with the id {ids} at {bauds} baud: {scan}"
        if self.new_baud is None:
            return told
        new, old = self.ids[-1], self.bauds[0]
        command = f"mastctl servo set-id {self.line} {new} {new} --baud {old} --new-baud {self.new_baud}"
        return f"{told}, and '{command}' gives the id {new} its rate"


@contextmanager
def changing(link: BusLink, family: str, old: int, new_baud: int | None) -> Iterator[Change]:
    """Say, if a change is broken off within, what the servo is left with. Raises what broke it off."""
    line = quote(link.name) + ("" if family == "dynamixel" else f" --family {family}")
    change = Change(line, [old], [link.baud], None if new_baud == link.baud else new_baud)
    try:
        yield change
    except BaseException as error:
        if change.ids == [old] and len(change.bauds) == 1:
            raise  # nothing was changed
        words = f"{str(error) or 'interrupted'}; {change.words()}"
        if isinstance(error, DriverError):
            raise type(error)(words, detail=error.detail) from error
        raise WrongDevice(words) from error


def check_trial(name: str, values: Mapping[str, int], limits: tuple[int, int], reach: int) -> None:
    """Refuse a trial that would overheat a servo or leave its limits. Raises HardwareFault, OutOfRange."""
    warm, warmest = values["present_temperature"], values["temperature_limit"]
    if warm > warmest - WARM_MARGIN_C:
        raise HardwareFault(f"{name} is at {warm} C, near its limit of {warmest} C; let it cool")
    voltage, low, high = (
        values[one] for one in ("present_voltage", "min_voltage_limit", "max_voltage_limit")
    )
    if not low <= voltage <= high:
        raise HardwareFault(f"{name} gets {voltage / 10:.1f} V, expected {low / 10:.1f} to {high / 10:.1f} V")
    start = values["present_position"]
    if not limits[0] + reach <= start <= limits[1] - reach:
        raise OutOfRange(
            f"{name} stands at {start} counts; a move of {reach} counts to each side leaves its "
            f"position limits {limits[0]} to {limits[1]}"
        )


@contextmanager
def restored(
    name: str, set_: Callable[[str, int], None], wanted: Sequence[tuple[str, int]]
) -> Iterator[None]:
    """Set registers in this order at the end, each even if another cannot be.

    Raises
    ------
    WrongDevice
        If one does not hold its value, beside whatever went wrong within.
    """
    wrong: BaseException | None = None
    try:
        yield
    except BaseException as error:  # goes on to the caller when the servo is as it was
        wrong = error
    left: dict[str, DriverError] = {}
    todo = list(wanted)
    while todo:
        try:
            set_(*todo[0])
        except DriverError as error:
            left[todo[0][0]] = error
        except KeyboardInterrupt as error:  # Ctrl-C again: it is tried once more, and the rest too
            wrong = wrong or error
            continue
        del todo[0]
    if left:
        limp = "its torque may be on; " if "torque_enable" in left else ""
        words = (
            f"{name} is not left as it was found in {' and '.join(left)}: {limp}{next(iter(left.values()))}"
        )
        raise WrongDevice(
            words if wrong is None else f"{str(wrong) or 'interrupted'}; and {words}"
        ) from wrong
    if wrong is not None:
        raise wrong


def watched_step(
    name: str,
    look: Callable[[], ServoSample],
    clock: Clock,
    began_s: float,
    goal: int,
    fence: tuple[int, int],
    current_unit_A: float | None,
) -> TrialStep:
    """Watch one short move of a servo to its end; ``look`` asks it, and raises for what it reports.

    Raises
    ------
    OutOfRange
        If it left the fence, counts.
    HardwareFault
        If it stands away from its goal.
    """
    most, rest = 0, Rest(STEP_RESTS_S)
    while True:
        sample = look()
        values = sample.values
        most = max(most, abs(values["present_current"]))
        if not fence[0] <= sample.counts <= fence[1]:
            raise OutOfRange(
                f"{name} left the fence of the trial at {sample.counts} counts "
                f"(allowed {fence[0]} to {fence[1]}); it is stopped"
            )
        stands = rest.take(values, sample.sent_s, sample.received_s)
        elapsed_s = clock.now_s() - began_s
        if (stands and not values["moving_status"] & PROFILE_BIT) or elapsed_s > LONGEST_STEP_S:
            break
        clock.sleep(TRIAL_POLL_S)
    left = abs(sample.counts - goal)
    if left > max(abs(fence[1] - fence[0]) / 16, 4):
        raise HardwareFault(
            f"{name} stands {left} counts from its goal: blocked, or too weak with this bound of "
            "its drive; it is stopped"
        )
    current = None if current_unit_A is None else most * current_unit_A
    voltage, temperature = values["present_voltage"] / 10, values["present_temperature"]
    return TrialStep(goal, sample.counts, elapsed_s, current, voltage, temperature)

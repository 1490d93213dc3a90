"""Servos of any family on the bench: a scan, another id, and the records of these."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from shlex import quote
from typing import TypeVar

from drivers.errors import BadOptions, DriverError, WrongDevice
from drivers.servo_bus.exchange import BusLink

HIGHEST_ID = 252
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


def scanned(
    bauds: Sequence[int], opened: Callable[[int], L], there: Callable[[L], tuple[list[FoundServo], int]]
) -> Scan:
    """Return which servos answer, at every baud rate that the adapter has.

    Raises LineLost, BadOptions if the line cannot be opened at all, or the adapter has none of the rates.

    Parameters
    ----------
    bauds
        To try, bits per second.
    there
        Returns who answers on it, and how many bytes came that were no reply.
    """
    found: list[FoundServo] = []
    garbled: list[int] = []
    tried: list[int] = []
    for baud in bauds:
        try:
            link = opened(baud)
        except BadOptions:
            if not tried and baud == bauds[-1]:
                raise
            continue
        tried.append(baud)
        try:
            servos, noise = there(link)
        finally:
            link.close()
        found += servos
        garbled += [baud] if noise else []
    return Scan(tuple(found), tuple(tried), tuple(garbled))


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
    """A change of a servo's id and rate that is under way."""

    line: str
    ids: list[int]
    bauds: list[int]
    new_baud: int | None

    def words(self) -> str:
        """Say what the servo is left with, and how to go on."""
        ids, bauds = " or ".join(map(str, self.ids)), " or ".join(map(str, self.bauds))
        scan = f"'mastctl servo scan {self.line} --baud {bauds.replace(' or', '')}' shows which"
        sentence = f"the servo is left with the id {ids} at {bauds} baud: {scan}"
        if self.new_baud is None:
            return sentence
        new, old = self.ids[-1], self.bauds[0]
        command = f"mastctl servo set-id {self.line} {new} {new} --baud {old} --new-baud {self.new_baud}"
        return f"{sentence}, and '{command}' gives the id {new} its rate"


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

"""Servos of any family on the bench: a scan, a probe, another id, and the records of these."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from shlex import quote
from typing import Any

from drivers.clock import Clock
from drivers.errors import BadOptions, DriverError, WrongDevice
from drivers.registry import Ends, ProbedHead
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.exchange import REPLY_TIMEOUT_S, BusLink
from drivers.servo_bus.settings import CountedModel

HIGHEST_ID = 252
APPROACH_RAD = 0.02
FASTEST_POLL_HZ, USUAL_BAUD = 50.0, 1_000_000


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
    """Everything a servo says: its registers, and what numbers mean that do not say it."""

    servo_id: int
    model: str
    firmware: int | str
    values: dict[str, int]
    meanings: dict[str, str]


def check_change(link: BusLink, old: int, new: int, new_baud: int | None, rates: Collection[int]) -> None:
    """Pass a new id and baud rate that a servo can be given. Raises BadOptions."""
    for name, value in (("old", old), ("new", new)):
        if not 0 <= value <= HIGHEST_ID:
            raise BadOptions(f"the {name} id {value} cannot be; an id is 0 to {HIGHEST_ID}")
    if new_baud is not None and new_baud not in rates:
        raise BadOptions(f"{new_baud} baud cannot be; there is {', '.join(map(str, rates))}")
    if old == new and new_baud in (None, link.baud):
        raise BadOptions(f"servo {old} already has this id and baud rate; there is nothing to do")


@contextmanager
def changing(link: BusLink, family: str, old: int, new: int, new_baud: int | None) -> Iterator[None]:
    """Say, if a change of id and rate is broken off within, how the servo is found; raises what did it."""
    before = link.baud
    try:
        yield
    except BaseException as error:
        ids = f"{old}" if new == old else f"{old} or {new}"
        bauds = f"{before}" if new_baud in (None, before) else f"{before} {new_baud}"
        scan = f"'mastctl rig servo scan {line_arguments(link.name, family)} --baud {bauds}' shows which"
        left = f"the servo is left with the id {ids} at {bauds.replace(' ', ' or ')} baud: {scan}"
        message = f"{str(error) or 'interrupted'}; {left}"
        if isinstance(error, DriverError):
            raise type(error)(message, detail=error.detail) from error
        raise WrongDevice(message) from error


def line_arguments(port: str, family: str) -> str:
    """Return a line as commands name it, with the family of its servos."""
    return f"{quote(port)} --family {family}"


@dataclass(frozen=True)
class ServoBench:
    """What is done with servos of one family on the bench.

    ``present`` returns the servos that answer on a line, and how many bytes came that were no reply. Of the
    rates that of the factory or the likeliest is first. ``models`` are those that the driver turns.
    """

    family: str
    open: Callable[..., BusLink]
    present: Callable[[Any], tuple[list[FoundServo], int]]
    facts: Callable[[Any, int], ServoFacts]
    set_id: Callable[..., None]
    bauds: tuple[int, ...]
    likely_bauds: tuple[int, ...]
    models: Mapping[str, CountedModel]
    usual_model: str
    poll_bytes: int

    def numbering(self, port: str, baud: int) -> str:
        """Return the command that gives a new servo, alone on a line, the second id."""
        return f"mastctl rig servo set-id {line_arguments(port, self.family)} 1 2 --baud {baud}"

    def one_id(self, port: str, baud: int) -> str:
        """Return what to do where one id is all that answers."""
        return (
            f"new servos all have the id 1; connect one at a time, and give the second another id: "
            f"{self.numbering(port, baud)}; then connect both"
        )

    def scan(
        self,
        port: str,
        bauds: Sequence[int],
        reply_timeout_s: float,
        clock: Clock | None = None,
        open_line: OpenLine = SerialLine,
    ) -> Scan:
        """Return which servos answer, at every baud rate that the adapter has.

        Raises LineLost, BadOptions if the line cannot be opened at all, or the adapter has none of the rates.
        """
        found: list[FoundServo] = []
        garbled: list[int] = []
        tried: list[int] = []
        for baud in bauds:
            try:
                link = self.open(port, baud, reply_timeout_s, clock=clock, open_line=open_line)
            except BadOptions:
                if not tried and baud == bauds[-1]:
                    raise
                continue
            tried.append(baud)
            try:
                servos, noise = self.present(link)
            finally:
                link.close()
            found += servos
            garbled += [baud] if noise else []
        return Scan(tuple(found), tuple(tried), tuple(garbled))

    def probe(
        self, port: str, path: str, clock: Clock | None = None, open_line: OpenLine = SerialLine
    ) -> tuple[ServosOnLine | None, str]:
        """Return the servos of a line, as `drivers.registry.Driver.probe`; two servos end the search."""
        found: list[FoundServo] = []
        garbled: list[int] = []
        for baud in self.likely_bauds:
            try:
                result = self.scan(path, (baud,), REPLY_TIMEOUT_S, clock, open_line)
            except BadOptions:
                continue  # a rate that the adapter does not have
            found += result.found
            garbled += result.garbled
            if len(found) > 1:
                break
        if found:
            return ServosOnLine(self, port, tuple(found)), ""
        if garbled:
            return None, f"at {garbled[0]} baud something answers: {self.one_id(port, garbled[0])}"
        return None, ""


class ServosOnLine(ProbedHead):
    """Servos that answered on a line, or are still to be plugged in."""

    speed_rad_per_s = 0.8

    def __init__(self, bench: ServoBench, port: str, found: Sequence[FoundServo] = ()) -> None:
        self.bench, self.driver, self.port = bench, bench.family, port
        self._found = found
        self.driven = {one.servo_id: one for one in found if one.model in bench.models}
        self.usable = bool(self.driven)

    @property
    def bauds(self) -> list[int]:
        """The rates of those that the driver turns, the lowest first."""
        return sorted({one.baud for one in self.driven.values()})

    @property
    def summary(self) -> str:
        """The servos, in one sentence."""
        names = [
            f"{one.model} (id {one.servo_id}, {one.baud} baud)"
            if one.model in self.bench.models
            else f"{one.model}, which mastctl does not drive"
            for one in sorted(self._found, key=lambda one: one.model not in self.bench.models)
        ]
        return f"{self.port}: {', '.join(names)}"

    def configured(self, ends: Ends, ids: Mapping[str, int]) -> tuple[dict[str, Any], Ends]:
        """Return options for servos of these ids, as found or as usual."""
        bench = self.bench
        baud = max(self.bauds, default=USUAL_BAUD)
        poll_hz = min(FASTEST_POLL_HZ, math.floor(baud / (10 * bench.poll_bytes)))
        axes = {}
        for axis, number in ids.items():
            like = self.driven.get(number) or next(iter(self.driven.values()), None)
            model = bench.models[bench.usual_model if like is None else like.model]
            axes[axis] = {
                "id": number,
                "model": model.name,
                "limits_rad": list(ends[axis]),
                "approach": "positive" if axis == "pan" else "gravity",
                "approach_rad": max(
                    APPROACH_RAD, 0.0 if like is None else round(1.5 * (model.backlash_rad or 0.0), 3)
                ),
            }
        slow = {} if poll_hz == FASTEST_POLL_HZ else {"poll_hz": float(poll_hz)}
        return {"baud": baud, **slow, **axes}, ends

"""A unit on the bench: what it says about itself, and homing it. For ``mastctl ptu``, not for the head."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from drivers.clock import Clock, SystemClock
from drivers.errors import DriverError, Refused
from drivers.flir_ptu import protocol as ask
from drivers.flir_ptu.conversation import Conversation
from drivers.flir_ptu.options import DEVICE
from drivers.serial_line import ByteLine, OpenLine, SerialLine

HOMING_S = 60.0
"""How long a reset may take; up to 30 s, the manual says."""


@dataclass(frozen=True)
class AxisFacts:
    """One axis: positions are steps, speeds steps a second. None where the unit does not report it."""

    resolution_arcsec: float
    position: int
    lowest: int | None
    highest: int | None
    speed: int | None
    fastest: int | None
    acceleration: int | None
    step_mode: str


@dataclass(frozen=True)
class Facts:
    """A unit."""

    version: str
    supply: str
    pan: AxisFacts
    tilt: AxisFacts


def facts(port: str, baud: int, clock: Clock | None = None, open_line: OpenLine = SerialLine) -> Facts:
    """Return what a unit says about itself. Moves nothing.

    ``clock`` and ``open_line`` are as of `drivers.flir_ptu.head.open_head`. Raises LineLost, NoReply,
    BadReply, Refused.
    """
    with _talking(open_line(port, baud, DEVICE), clock) as talk:
        return _facts(talk)


def home(port: str, baud: int, clock: Clock | None = None, open_line: OpenLine = SerialLine) -> Facts:
    """Reset a unit: both axes SWEEP THEIR FULL RANGE, whatever limits are set, and end at position 0.

    Takes up to half a minute. Afterwards the unit knows its positions and its resolution. ``clock`` and
    ``open_line`` are as of `drivers.flir_ptu.head.open_head`. Raises LineLost, NoReply, BadReply, Refused if
    it does not come through.
    """
    with _talking(open_line(port, baud, DEVICE), clock) as talk:
        talk.reset(HOMING_S)
        return _facts(talk)


@contextmanager
def _talking(line: ByteLine, clock: Clock | None) -> Iterator[Conversation]:
    """A conversation on a line of its own."""
    talk = Conversation(line, DEVICE, lambda axis: None, clock or SystemClock())
    try:
        with talk.patient():
            yield talk
    finally:
        talk.close()


def _facts(talk: Conversation) -> Facts:
    """Ask everything."""
    resolutions = talk.in_step()
    return Facts(
        version=talk.tell("V"),
        supply=_told(talk, "O"),
        pan=_axis(talk, "pan", resolutions["pan"]),
        tilt=_axis(talk, "tilt", resolutions["tilt"]),
    )


def _axis(talk: Conversation, name: str, resolution_arcsec: float) -> AxisFacts:
    """Ask everything about one axis."""

    def number(query: ask.Query) -> int | None:
        try:
            return round(talk.ask(query))
        except Refused:
            return None

    return AxisFacts(
        resolution_arcsec=resolution_arcsec,
        position=round(talk.ask(ask.POSITION[name])),
        lowest=number(ask.LOWEST[name]),
        highest=number(ask.HIGHEST[name]),
        speed=number(ask.SPEED[name]),
        fastest=number(ask.FASTEST[name]),
        acceleration=number(ask.ACCELERATION[name]),
        step_mode=_told(talk, f"W{name[0].upper()}"),
    )


def _told(talk: Conversation, command: str) -> str:
    """A text that not every firmware gives."""
    try:
        return talk.tell(command)
    except DriverError:
        talk.in_step()
        return ""

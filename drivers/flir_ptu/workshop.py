"""A unit on the bench: its values, and homing it. For ``mastctl rig ptu``, not for the head."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from drivers.clock import Clock, SystemClock
from drivers.errors import DriverError, Refused
from drivers.flir_ptu import protocol as queries
from drivers.flir_ptu.axis import BAUDS, DEVICE
from drivers.flir_ptu.conversation import Conversation
from drivers.registry import Ends, ProbedHead, UnitBench
from drivers.serial_line import ByteLine, OpenLine, SerialLine

ARCSEC_RAD = math.radians(1 / 3600)
SIGNS = {"pan": -1, "tilt": 1}
"""A unit counts pan to the left and tilt upwards, the mast to the right and upwards."""
PROBED_BAUDS = (9600, 38_400)
"""As units come from the factory, and as docs/how-to/hardware.md has them set up."""
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
    with talking(open_line(port, baud, DEVICE), clock) as talk:
        return _facts(talk)


def home(port: str, baud: int, clock: Clock | None = None, open_line: OpenLine = SerialLine) -> Facts:
    """Reset a unit: both axes SWEEP THEIR FULL RANGE, whatever limits are set, and end at position 0.

    Takes up to half a minute. Afterwards the unit knows its positions and its resolution. ``clock`` and
    ``open_line`` are as of `drivers.flir_ptu.head.open_head`. Raises LineLost, NoReply, BadReply, Refused if
    it does not come through.
    """
    with talking(open_line(port, baud, DEVICE), clock) as talk:
        talk.reset(HOMING_S)
        return _facts(talk)


@contextmanager
def talking(line: ByteLine, clock: Clock | None) -> Iterator[Conversation]:
    """Hold a conversation on a line of its own."""
    talk = Conversation(line, DEVICE, lambda axis: None, clock or SystemClock())
    try:
        with talk.patient():
            yield talk
    finally:
        talk.close()


def _facts(talk: Conversation) -> Facts:
    """Read everything."""
    resolutions = talk.in_step()
    return Facts(
        version=talk.request("V"),
        supply=_optional_text(talk, "O"),
        pan=_axis(talk, "pan", resolutions["pan"]),
        tilt=_axis(talk, "tilt", resolutions["tilt"]),
    )


def _axis(talk: Conversation, name: str, resolution_arcsec: float) -> AxisFacts:
    """Read everything about one axis."""

    def number(query: queries.Query) -> int | None:
        try:
            return round(talk.value_of(query))
        except Refused:
            return None

    return AxisFacts(
        resolution_arcsec=resolution_arcsec,
        position=round(talk.value_of(queries.POSITION[name])),
        lowest=number(queries.LOWEST[name]),
        highest=number(queries.HIGHEST[name]),
        speed=number(queries.SPEED[name]),
        fastest=number(queries.FASTEST[name]),
        acceleration=number(queries.ACCELERATION[name]),
        step_mode=_optional_text(talk, f"W{name[0].upper()}"),
    )


def _optional_text(talk: Conversation, command: str) -> str:
    """A text that not every firmware gives."""
    try:
        return talk.request(command)
    except DriverError:
        talk.in_step()
        return ""


class UnitOnLine(ProbedHead):
    """A unit that answered on a line."""

    driver = DEVICE

    def __init__(self, port: str, unit: Facts, baud: int) -> None:
        self.port = port
        self._unit, self._baud = unit, baud

    @property
    def summary(self) -> str:
        """The unit's own name."""
        return f"{self.port}: a FLIR PTU, {self._unit.version}"

    def configured(self, ends: Ends, ids: Mapping[str, int]) -> tuple[dict[str, Any], Ends]:
        """Return options whose limits the unit has too, where it reports them."""
        ends = {axis: self._within(axis, ends[axis]) for axis in ends}
        axes = {axis: {"sign": SIGNS[axis], "limits_rad": list(ends[axis])} for axis in ends}
        return {"baud": self._baud, **axes}, ends

    def _within(self, name: str, ends: tuple[float, float]) -> tuple[float, float]:
        axis: AxisFacts = getattr(self._unit, name)
        count_rad = SIGNS[name] * axis.resolution_arcsec * ARCSEC_RAD
        reach = sorted(count_rad * end for end in (axis.lowest, axis.highest) if end is not None)
        if len(reach) < 2:
            return ends
        return max(ends[0], math.ceil(1e3 * reach[0]) / 1e3), min(ends[1], math.floor(1e3 * reach[1]) / 1e3)


def probe(
    port: str, path: str, clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> tuple[UnitOnLine | None, str]:
    """Return the unit of a line, as `drivers.registry.Driver.probe`.

    One that answers in short form is set to its usual one, which it forgets at power-off.
    """
    for baud in PROBED_BAUDS:
        with suppress(DriverError):  # no unit
            return UnitOnLine(port, facts(path, baud, clock, open_line), baud), ""
    return None, ""


BENCH = UnitBench((9600, *(baud for baud in BAUDS if baud != 9600)), facts, home)

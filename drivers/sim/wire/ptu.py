"""A simulated FLIR / Directed Perception pan/tilt unit on a line: its ASCII protocol, byte by byte.

What a command means is known in `drivers.sim.wire.ptu_commands`, what the unit does then in
`drivers.sim.wire.ptu_unit`.
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.errors import BadOptions
from drivers.faults import nearest
from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.line import Reply
from drivers.sim.wire.ptu_axis import PtuAxis
from drivers.sim.wire.ptu_commands import BAUD_RATES, answer
from drivers.sim.wire.ptu_models import MODELS, STEPS
from drivers.sim.wire.ptu_unit import PtuUnit

ANSWER_S = 0.001
"""From the end of a command to its answer (assumed)."""

BANNER = b"\r\n### FLIR Motion Control Systems pan-tilt unit\r\n"
"""What an E series unit says to whoever connects by TCP (the wording differs with the firmware)."""

_LONGEST = 100  # bytes of one command; the controller's buffer (D46 manual 7.3.2)


class SimulatedPtu:
    """A unit on a line (``drivers.sim.wire.line.WireDevice``).

    Parameters
    ----------
    model
        A name of ``drivers.sim.wire.ptu_models.MODELS``.
    pan, tilt
        What it turns.
    step_mode
        F, H, Q, E or A; as delivered when left out.
    signs
        Whether positions of pan and tilt grow (1) or fall (-1) with the axis angle. By default pan falls:
        the unit counts to the left, the mast to the right.
    baud
        Of its serial line at first.

    Raises
    ------
    BadOptions
        For a model, step mode or baud rate that does not exist.
    """

    def __init__(
        self,
        model: str,
        pan: WireAxis,
        tilt: WireAxis,
        *,
        step_mode: str | None = None,
        signs: tuple[int, int] = (-1, 1),
        baud: int = 9600,
    ) -> None:
        if model not in MODELS:
            raise BadOptions(f"there is no pan/tilt unit {model!r}{nearest(model, MODELS)}")
        mode = MODELS[model].step_mode if step_mode is None else step_mode
        if mode not in STEPS:
            raise BadOptions(f"step mode {mode!r} where one of {', '.join(STEPS)} is expected")
        if baud not in BAUD_RATES:
            rates = ", ".join(str(rate) for rate in BAUD_RATES)
            raise BadOptions(f"a pan/tilt unit has no baud rate {baud}; there is {rates}")
        self._unit = PtuUnit(MODELS[model], pan, tilt, mode, signs, baud)
        self._received = bytearray()

    @property
    def pan(self) -> PtuAxis:
        """The axis P."""
        return self._unit.pan

    @property
    def tilt(self) -> PtuAxis:
        """The axis T."""
        return self._unit.tilt

    @property
    def eeprom_writes(self) -> int:
        """How often it was told to save."""
        return self._unit.eeprom_writes

    @property
    def baud(self) -> int:
        """Bits a second of its serial line, now."""
        return self._unit.baud

    @property
    def banner(self) -> bytes:
        """What it says to whoever connects by TCP."""
        return BANNER if self._unit.model.e_series else b""

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        """Take bytes and answer the commands that are complete; later ones wait for one that takes long."""
        self._received += data
        return self._work(time_s)

    def poll(self, time_s: float) -> Sequence[Reply]:
        """Return the answers that have become due, and !P and !T."""
        return self._work(time_s)

    def _work(self, time_s: float) -> list[Reply]:
        unit = self._unit
        sent = [Reply(f"!{letter}".encode()) for letter in unit.follow(time_s)]
        while unit.busy is None or not unit.busy(time_s):
            if unit.busy is not None:
                sent.append(self._framed("*"))
                unit.busy = None
                continue
            end = next((i for i, byte in enumerate(self._received) if byte in b" \r\n"), None)
            if end is None:
                del self._received[_LONGEST:]
                break
            words, delimiter = bytes(self._received[:end]), bytes(self._received[end : end + 1])
            del self._received[: end + 1]
            echo = words + delimiter if unit.echo else b""
            framed = self._framed(answer(unit, words, time_s)).data if words else b""
            if unit.busy is not None:
                framed = b""  # later
            if echo + framed:
                sent.append(Reply(echo + framed, ANSWER_S))
        return sent

    def _framed(self, text: str) -> Reply:
        lead = b"\n" if self._unit.model.e_series else b""
        return Reply(lead + text.encode("ascii", "replace") + b"\r\n", ANSWER_S)

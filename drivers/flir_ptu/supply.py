"""What a unit says about its supply and its temperature, and when that is a fault.

The manuals' answer to ``O`` is ``Input 30 VDC @ 86 degF``; units with more sensors list more temperatures.
They give no bounds for all models, so these are the configuration's, or what was there at the start.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass

from drivers.clock import Clock
from drivers.errors import Refused
from drivers.flir_ptu.conversation import Conversation
from drivers.flir_ptu.options import DEVICE, Options

log = logging.getLogger(__name__)

EVERY_S = 5.0
"""How often a resting unit is asked."""
DIP = 0.8
"""Below this part of what it was at the start a supply counts as fallen, where no bounds are configured."""

_VOLTS = re.compile(r"(\d+(?:\.\d+)?) ?V")
_DEGREES_F = re.compile(r"(-?\d+(?:\.\d+)?) ?(?:deg)?F\b")


@dataclass(frozen=True)
class Supply:
    """Supply, volts, and the hottest temperature that the unit tells, °C."""

    volts: float
    hottest_c: float


def supply_of(text: str) -> Supply | None:
    """Return what an answer to ``O`` says; None if it says something else."""
    volts, degrees = _VOLTS.findall(text), _DEGREES_F.findall(text)
    if len(volts) != 1 or not degrees:
        return None
    return Supply(float(volts[0]), (max(float(one) for one in degrees) - 32) / 1.8)


def supply_words(now: Supply, at_start: Supply, options: Options) -> tuple[str, ...]:
    """Say what is wrong with the supply or the temperature; empty if nothing is."""
    words = []
    low, high = options.supply_V or (DIP * at_start.volts, float("inf"))
    if not low <= now.volts <= high:
        expected = f"{low:.1f} to {high:.1f} V" if options.supply_V else f"{low:.1f} V or more"
        words.append(f"the supply is {now.volts:.1f} V, expected {expected}")
    if now.hottest_c > options.hottest_C:
        words.append(f"the unit is at {now.hottest_c:.0f} °C, expected {options.hottest_C:.0f} °C at most")
    return tuple(words)


class SupplyWatch:
    """The watch over a unit's supply and temperature.

    Attributes
    ----------
    words
        What is wrong, in plain words; empty if nothing is, or the unit does not tell.
    """

    def __init__(self, options: Options, clock: Clock) -> None:
        self.words: tuple[str, ...] = ()
        self._options = options
        self._clock = clock
        self._at_start: Supply | None = None  # None: this unit does not tell
        self._due_s = 0.0

    def begin(self, talk: Conversation) -> None:
        """Ask what there is, unless that is known; raises as `Conversation.tell`."""
        if self._at_start is not None:
            return
        first, again = _ask(talk), _ask(talk)
        if first is not None and again is not None:  # the middle, should a digit be damaged
            third = _ask(talk) or again
            self._at_start = sorted((first, again, third), key=lambda supply: supply.volts)[1]

    def look(self, talk: Conversation) -> None:
        """Ask and judge now and then; a fault is told only if it is measured twice. Raises as `begin`."""
        if self._at_start is None or self._clock.now_s() < self._due_s:
            return
        words: tuple[str, ...] = ()
        for _ in range(2):
            supply = _ask(talk)
            if supply is None:
                return  # damaged: asked again by the next reading
            words = supply_words(supply, self._at_start, self._options)
            if not words:
                break
        self.words, self._due_s = words, self._clock.now_s() + EVERY_S


def _ask(talk: Conversation) -> Supply | None:
    """Supply and temperature; None where the unit does not tell, or in words nobody knows."""
    try:
        return supply_of(talk.tell("O"))
    except Refused as error:
        log.info("%s: it does not tell its supply (%s)", DEVICE, error)
        return None

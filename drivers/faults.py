"""Faults for the simulated devices: the words, what each does to a head or a camera, and a panel to set them.

The panel only remembers; the simulated devices ask it. Words are those of PX4's failure injection, and three
more for cameras. docs/drivers.md shows ``HEAD_WORDS`` and ``CAMERA_WORDS`` as tables.
"""

from __future__ import annotations

import difflib
import math
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from drivers.errors import BadOptions

PAN_TILT = "pan_tilt"
"""The name of the head among the devices."""


@dataclass(frozen=True)
class Word:
    """What a fault word does to one kind of device.

    Attributes
    ----------
    does
        One plain sentence.
    parameters
        Parameter names with their defaults; the unit is in the name.
    """

    does: str
    parameters: Mapping[str, float]


_P = {"probability": 0.3, "seed": 0}

HEAD_WORDS: Mapping[str, Word] = MappingProxyType(
    {
        "off": Word("power gone: axes seize where they are, every call fails with NoReply", {}),
        "stuck": Word(
            "moves are accepted but the axes stay where they are; moving=1 keeps the flag up", {"moving": 0}
        ),
        "garbage": Word("the reading is not a number, absurd, or a random angle", {"seed": 0}),
        "wrong": Word(
            "both read-out angles are off by a constant, the motion is right", {"offset_rad": 0.0349}
        ),
        "slow": Word("speed and acceleration are this fraction of what was asked", {"factor": 0.05}),
        "delayed": Word("commands are executed at once, every reply comes this much late", {"delay_s": 0.5}),
        "intermittent": Word("each call fails with NoReply with this probability", _P),
    }
)

CAMERA_WORDS: Mapping[str, Word] = MappingProxyType(
    {
        "off": Word("no frames come", {}),
        "stuck": Word(
            "only the last frame before the fault is to be had, with its old sequence and time", {}
        ),
        "garbage": Word("new frames hold random pixels", {"seed": 0}),
        "wrong": Word("pictures are shifted by whole pixels", {"dx_px": 9, "dy_px": 6}),
        "slow": Word("the frame rate is this fraction of what it was", {"factor": 0.1}),
        "delayed": Word("frames are delivered this much late, with true stamps", {"delay_s": 0.5}),
        "intermittent": Word("each call fails with NoReply with this probability", _P),
        "dropped": Word(
            "each frame is missing with this probability: sequence gaps", {"probability": 0.9, "seed": 0}
        ),
        "dark": Word("pictures are black but for read noise", {}),
        "frozen": Word("the picture before the fault again and again, with new sequence and time", {}),
    }
)

WHEN: Mapping[str, float] = MappingProxyType({"after_s": 0.0, "for_s": math.inf})
"""Parameters of every word: it begins ``after_s`` after it is set and lasts ``for_s`` seconds."""

_BOUNDS = {
    "after_s": (0.0, 86400.0),
    "for_s": (0.0, math.inf),
    "delay_s": (0.0, 3600.0),
    "factor": (1e-4, 1.0),
    "probability": (0.0, 1.0),
    "moving": (0.0, 1.0),
    "offset_rad": (-math.pi, math.pi),
    "dx_px": (-4096.0, 4096.0),
    "dy_px": (-4096.0, 4096.0),
    "seed": (0.0, 2.0**53),
}


def nearest(name: str, names: Iterable[str]) -> str:
    """Return ``; did you mean 'x'?`` for the name most like the given one, or the list of all names."""
    names = sorted(names)
    close = difflib.get_close_matches(str(name), names, n=1)
    return f"; did you mean {close[0]!r}?" if close else f"; there is {', '.join(names) or 'none'}"


@dataclass(frozen=True)
class Fault:
    """A fault that is set: on which device, which word, with which parameters, from when to when.

    ``begin_s`` and ``end_s`` are seconds of the simulation's clock; ``end_s`` may be infinite.
    """

    device: str
    word: str
    parameters: Mapping[str, float]
    begin_s: float
    end_s: float

    def holds(self, time_s: float) -> bool:
        """Return whether the fault is in force at a moment."""
        return self.begin_s <= time_s < self.end_s

    def number(self, name: str) -> float:
        """Return a parameter."""
        return float(self.parameters[name])


class FaultPanel:
    """The switches of all faults of one simulated rover; safe from any thread.

    Parameters
    ----------
    now_s
        The simulation's clock.
    cameras
        Names of the cameras; the head is ``pan_tilt``.
    """

    def __init__(self, now_s: Callable[[], float], cameras: Iterable[str]) -> None:
        self._now_s = now_s
        self._words: dict[str, Mapping[str, Word]] = {PAN_TILT: HEAD_WORDS}
        self._words |= dict.fromkeys(cameras, CAMERA_WORDS)
        self._lock = threading.Lock()
        self._faults: dict[tuple[str, str], Fault] = {}
        self._random: dict[tuple[str, str], np.random.Generator] = {}

    def set(self, device: str, word: str, **parameters: Any) -> Fault:
        """Set a fault, in place of one with the same word on the same device.

        Parameters
        ----------
        device
            ``pan_tilt`` or a camera's name.
        word
            A key of ``HEAD_WORDS`` or ``CAMERA_WORDS``.
        **parameters
            Those of the word, and ``after_s`` and ``for_s`` of every word.

        Raises
        ------
        BadOptions
            For an unknown device, word or parameter, or a value that is not a number within its bounds.
        """
        if device not in self._words:
            raise BadOptions(f"there is no device {device!r}{nearest(device, self._words)}")
        words = self._words[device]
        if word not in words:
            raise BadOptions(f"{device} has no fault {word!r}{nearest(word, words)}")
        known = {**WHEN, **words[word].parameters}
        values = dict(known)
        for name, value in parameters.items():
            if name not in known:
                raise BadOptions(
                    f"fault {word!r} of {device} has no parameter {name!r}{nearest(name, known)}"
                )
            low, high = _BOUNDS[name]
            number = isinstance(value, int | float)
            if not number or math.isnan(value) or not low <= value <= high:
                raise BadOptions(
                    f"fault {word!r} of {device}: {name} is {value!r}, "
                    f"expected a number from {low:g} to {high:g}"
                )
            values[name] = float(value)
        begin_s = self._now_s() + values["after_s"]
        fault = Fault(device, word, MappingProxyType(values), begin_s, begin_s + values["for_s"])
        with self._lock:
            self._faults[device, word] = fault
            self._random[device, word] = np.random.default_rng(int(values.get("seed", 0)))
        return fault

    def set_all(self, faults: Any) -> None:
        """Set the faults of a configuration: a list of mappings with ``device``, ``word`` and parameters.

        Raises
        ------
        BadOptions
            As ``set``, or when it is not such a list; then nothing was set.
        """
        if not isinstance(faults, list | tuple):
            raise BadOptions(f"simulation.faults is {faults!r}, expected a list of {{device, word, ...}}")
        before = self.active()
        try:
            for entry in faults:
                if not isinstance(entry, Mapping) or not {"device", "word"} <= set(entry):
                    raise BadOptions(f"simulation.faults holds {entry!r}, expected device and word")
                if not all(isinstance(value, str) for value in (entry["device"], entry["word"], *entry)):
                    raise BadOptions(f"simulation.faults holds {entry!r}, expected device and word as text")
                self.set(**entry)
        except BadOptions:
            with self._lock:
                self._faults = {(fault.device, fault.word): fault for fault in before}
            raise

    def clear(self, device: str | None = None) -> None:
        """Take back all faults of one device, or of every device.

        Raises
        ------
        BadOptions
            For an unknown device.
        """
        if device is not None and device not in self._words:
            raise BadOptions(f"there is no device {device!r}{nearest(device, self._words)}")
        with self._lock:
            self._faults = {k: v for k, v in self._faults.items() if device is not None and k[0] != device}

    def active(self) -> tuple[Fault, ...]:
        """Return the faults that are set and not over, also those that have not begun."""
        now_s = self._now_s()
        with self._lock:
            return tuple(fault for fault in self._faults.values() if now_s < fault.end_s)

    def find(self, device: str, word: str, time_s: float) -> Fault | None:
        """Return the fault of this word on this device if it is in force at a moment."""
        with self._lock:
            fault = self._faults.get((device, word))
        return fault if fault is not None and fault.holds(time_s) else None

    def draw(self, fault: Fault) -> float:
        """Return the fault's next random number in [0, 1), from its seed."""
        with self._lock:
            generator = self._random.setdefault((fault.device, fault.word), np.random.default_rng(0))
            return float(generator.random())

    def strikes(self, device: str, time_s: float) -> bool:
        """Return whether a call at a moment falls to the device's ``intermittent`` fault."""
        fault = self.find(device, "intermittent", time_s)
        return fault is not None and self.draw(fault) < fault.number("probability")

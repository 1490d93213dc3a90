"""Faults for the simulated devices: the words, what each does to a head or a camera, and a panel to set them.

The panel only remembers; the simulated devices ask it: a head in memory, or the axes and the line of a byte
simulator, by the same words. Words are those of PX4's failure injection, more for a head's mechanism and its
line, and more for cameras. docs/drivers.md shows ``HEAD_WORDS`` and ``CAMERA_WORDS`` as tables.
"""

from __future__ import annotations

import difflib
import math
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from calib.errors import BadFile
from calib.files import read_bytes
from calib.files.yaml_text import parse_mapping
from drivers.errors import BadOptions

_MAX_SCRIPT_BYTES = 1_000_000

PAN_TILT = "pan_tilt"
"""The name of the head among the devices."""


@dataclass(frozen=True)
class Word:
    """The effect of a fault word on one kind of device.

    ``parameters`` are names with their defaults; the unit is in the name.
    """

    does: str
    parameters: Mapping[str, float]


_P = {"probability": 0.3, "seed": 0}

_N = {"replies": 1, "probability": 1.0, "seed": 0, "sender": 0}
_AXIS = {"axis": 2}

HEAD_WORDS: Mapping[str, Word] = MappingProxyType(
    {
        "off": Word("power gone: axes seize where they are, every call fails with NoReply", {}),
        "stuck": Word(
            "moves are accepted but the axes stay where they are; moving=1 keeps the flag up (in memory)",
            {"moving": 0, **_AXIS},
        ),
        "garbage": Word(
            "the reading is not a number (in memory), absurd, or a random angle", {"seed": 0, **_AXIS}
        ),
        "wrong": Word(
            "read-out angles are off by a constant, the motion is right", {"offset_rad": 0.0349, **_AXIS}
        ),
        "slow": Word(
            "speed is this fraction of what was requested, and acceleration from rest; it brakes as ever",
            {"factor": 0.05, **_AXIS},
        ),
        "delayed": Word("commands are executed at once, every reply comes this much late", {"delay_s": 0.5}),
        "intermittent": Word("each call fails with NoReply with this probability", _P),
        "drifting": Word(
            "read-out angles drift away at this rate, the motion is right", {"rate_rad_per_s": 0.002, **_AXIS}
        ),
        "overload": Word(
            "an obstacle stands at this angle: the axis stops there and is overloaded",
            {"angle_rad": 0.2, "axis": 1},
        ),
        "voltage_dip": Word("the supply is this fraction of what it should be", {"factor": 0.7}),
        "temperature_ramp": Word(
            "the motors begin at 35 °C and get hotter at this rate", {"rate_c_per_s": 5.0, **_AXIS}
        ),
        "mute": Word("so many replies are not sent", _N),
        "corrupt": Word("so many replies have a wrong byte (in memory: BadReply)", _N),
        "late": Word(
            "so many replies come this much late, and may be taken for the answer to something else",
            {"delay_s": 0.3, **_N},
        ),
        "duplicate": Word("so many replies are sent twice (in memory: nothing)", _N),
        "swapped": Word("so many replies change places with the next one (in memory: BadReply)", _N),
        "misnamed": Word(
            "so many replies bear the id of another servo, with a checksum that fits (Dynamixel line only)",
            {"as_id": 2, **_N, "sender": 1},
        ),
        "noise": Word("so many replies have garbage in front of them (in memory: nothing)", _N),
        "half": Word("so many replies break off in the middle (in memory: NoReply)", _N),
        "hang_up": Word("the line is unplugged; it comes back when the fault ends", {}),
        "silent": Word(
            "one servo of two is dead: its axis stays where it is and it answers nothing, the other obeys "
            "(PTU line: the unit answers for both)",
            {"axis": 1},
        ),
        "not_a_number": Word(
            "the reading is not a number, the motion is right (Dynamixel line, which has whole counts only: "
            "nothing)",
            _AXIS,
        ),
    }
)
"""Words of a head. ``axis`` is 0 for pan, 1 for tilt, 2 for both; ``replies`` is the number of replies after
which a fault is over, ``probability`` that of each reply. ``sender`` is the id of the servo whose replies are
meant, 0 for any (on a line only)."""

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
        "hang": Word(
            "the call does not return until the fault is over: 0 any, 1 next_frame, 2 close, 3 recent_times, "
            "4 info, 5 exposure_held, 6 settings",
            {"call": 0},
        ),
    }
)

WHEN: Mapping[str, float] = MappingProxyType({"after_s": 0.0, "for_s": math.inf})
"""Parameters of every word: it begins ``after_s`` after it is set and lasts ``for_s`` seconds."""

BOUNDS = {
    "after_s": (0.0, 86400.0),
    "for_s": (0.0, math.inf),
    "delay_s": (0.0, 3600.0),
    "factor": (1e-4, 1.0),
    "probability": (0.0, 1.0),
    "call": (0.0, 6.0),
    "moving": (0.0, 1.0),
    "axis": (0.0, 2.0),
    "angle_rad": (-math.pi, math.pi),
    "rate_rad_per_s": (-1.0, 1.0),
    "rate_c_per_s": (0.0, 100.0),
    "replies": (1.0, math.inf),
    "sender": (0.0, 252.0),
    "as_id": (0.0, 252.0),
    "offset_rad": (-math.pi, math.pi),
    "dx_px": (-4096.0, 4096.0),
    "dy_px": (-4096.0, 4096.0),
    "seed": (0.0, 2.0**53),
}
"""The least and the most of each parameter."""


def read_script(path: Path) -> list[Any]:
    """Return the list of a fault script, a YAML file with the one key ``faults``, for ``FaultPanel.set_all``.

    Raises BadOptions if the file cannot be read.
    """
    try:
        document = parse_mapping(read_bytes(path, _MAX_SCRIPT_BYTES), path)
    except BadFile as error:
        raise BadOptions(str(error)) from None
    faults = document.get("faults")
    if set(document) != {"faults"} or not isinstance(faults, list):
        raise BadOptions(f"{path}: expected the one key 'faults' with a list of {{device, word, ...}}")
    return faults


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


class _Entry:
    """A fault that was set, its random numbers, and on how many replies it has yet to fall."""

    def __init__(self, fault: Fault) -> None:
        self.fault = fault
        self.random = np.random.default_rng(int(fault.parameters.get("seed", 0)))
        self.left = fault.parameters.get("replies", math.inf)


class FaultPanel:
    """The switches of all faults of one simulated rover; safe from any thread."""

    def __init__(self, now_s: Callable[[], float], cameras: Iterable[str]) -> None:
        self._now_s = now_s
        self._words: dict[str, Mapping[str, Word]] = {PAN_TILT: HEAD_WORDS}
        self._words |= dict.fromkeys(cameras, CAMERA_WORDS)
        self._lock = threading.Lock()
        self._entries: dict[tuple[str, str], tuple[_Entry, ...]] = {}
        self._listeners: tuple[Callable[[], None], ...] = ()

    @property
    def words(self) -> Mapping[str, Mapping[str, Word]]:
        """The words that each device takes, by its name."""
        return MappingProxyType(self._words)

    def listen(self, changed: Callable[[], None]) -> None:
        """Have a function called whenever a fault was set or taken back."""
        self._listeners = (*self._listeners, changed)

    def set(self, device: str, word: str, /, **parameters: Any) -> Fault:
        """Set a fault, in place of one with the same word on the same device.

        Raises BadOptions for an unknown device, word or parameter, or a value that is not a number within its
        bounds.
        """
        fault = self._fault(device, word, parameters)
        with self._lock:
            self._entries[device, word] = (_Entry(fault),)
        self._notify()
        return fault

    def _fault(self, device: str, word: str, parameters: Mapping[str, Any]) -> Fault:
        """The fault that is meant, checked."""
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
            low, high = BOUNDS[name]
            number = isinstance(value, int | float)
            if not number or math.isnan(value) or not low <= value <= high:
                raise BadOptions(
                    f"fault {word!r} of {device}: {name} is {value!r}, "
                    f"expected a number from {low:g} to {high:g}"
                )
            values[name] = float(value)
        begin_s = self._now_s() + values["after_s"]
        return Fault(device, word, MappingProxyType(values), begin_s, begin_s + values["for_s"])

    def set_all(self, faults: Any, origin: str = "simulation.faults") -> None:
        """Set the faults of a script, a list of mappings with ``device``, ``word`` and the word's parameters.

        They are beside those that are set. ``at_s`` says the same as ``after_s``: seconds from now. Of a word
        that comes more than once, the later one of those in force counts. Raises BadOptions as ``set``, or
        when it is not such a list; then nothing was set.
        """
        if not isinstance(faults, list | tuple):
            raise BadOptions(f"{origin} is {faults!r}, expected a list of {{device, word, ...}}")
        made = []
        for entry in faults:
            if not isinstance(entry, Mapping) or not {"device", "word"} <= set(entry):
                raise BadOptions(f"{origin} holds {entry!r}, expected device and word")
            if not all(isinstance(value, str) for value in (entry["device"], entry["word"], *entry)):
                raise BadOptions(f"{origin} holds {entry!r}, expected device and word as text")
            if {"at_s", "after_s"} <= set(entry):
                raise BadOptions(f"{origin} holds {entry!r}, expected at_s or after_s and not both")
            parameters = {"after_s" if name == "at_s" else name: value for name, value in entry.items()}
            device, word = parameters.pop("device"), parameters.pop("word")
            made.append(_Entry(self._fault(device, word, parameters)))
        with self._lock:
            for one in made:
                key = (one.fault.device, one.fault.word)
                self._entries[key] = (*self._entries.get(key, ()), one)
        self._notify()

    def clear(self, device: str | None = None, word: str | None = None) -> None:
        """Take back all faults of one device, or of every device; with a word only those of that word.

        Raises BadOptions for an unknown device.
        """
        if device is not None and device not in self._words:
            raise BadOptions(f"there is no device {device!r}{nearest(device, self._words)}")
        with self._lock:
            self._entries = {
                (its_device, its_word): entries
                for (its_device, its_word), entries in self._entries.items()
                if device not in (None, its_device) or word not in (None, its_word)
            }
        self._notify()

    def _notify(self) -> None:
        for changed in self._listeners:
            changed()

    def active(self) -> tuple[Fault, ...]:
        """Return the faults that are set and not over, also those that have not begun."""
        now_s = self._now_s()
        with self._lock:
            entries = [entry for some in self._entries.values() for entry in some]
            return tuple(e.fault for e in entries if now_s < e.fault.end_s and e.left > 0)

    def find(self, device: str, word: str, time_s: float) -> Fault | None:
        """Return the fault of this word on this device if it is in force at a moment."""
        entry = self._entry(device, word, time_s)
        return None if entry is None else entry.fault

    def draw(self, fault: Fault) -> float:
        """Return the fault's next random number in [0, 1), from its seed."""
        with self._lock:
            for entry in self._entries.get((fault.device, fault.word), ()):
                if entry.fault is fault:
                    return float(entry.random.random())
            return float(np.random.default_rng(int(fault.parameters.get("seed", 0))).random())

    def takes(self, device: str, word: str, time_s: float, sender: int = 0) -> Fault | None:
        """Return the fault of this word if it falls on a reply at a moment, and count that reply.

        ``sender`` is the servo that replies, 0 where there is one only.
        """
        entry = self._entry(device, word, time_s)
        if entry is None or entry.fault.number("sender") not in (0.0, float(sender)):
            return None
        with self._lock:
            if entry.left <= 0 or entry.random.random() >= entry.fault.number("probability"):
                return None
            entry.left -= 1
            return entry.fault

    def _entry(self, device: str, word: str, time_s: float) -> _Entry | None:
        """The last one set of those that are in force."""
        for entry in reversed(self._entries.get((device, word), ())):
            if entry.left > 0 and entry.fault.holds(time_s):
                return entry
        return None

    def strikes(self, device: str, time_s: float) -> bool:
        """Return whether a call at a moment falls to the device's ``intermittent`` fault."""
        fault = self.find(device, "intermittent", time_s)
        return fault is not None and self.draw(fault) < fault.number("probability")

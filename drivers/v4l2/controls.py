"""Controls by name: what a camera offers, and setting them, with a report of what it lacks."""

from __future__ import annotations

import ctypes
import difflib
import errno
import fcntl
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.v4l2 import abi
from drivers.v4l2.node import Node, reason

Value = int | str | bool

_MOST_CONTROLS = 1024
_TYPE_NAMES = {
    abi.CTRL_TYPE_INTEGER: "integer",
    abi.CTRL_TYPE_BOOLEAN: "boolean",
    abi.CTRL_TYPE_MENU: "menu",
    abi.CTRL_TYPE_BUTTON: "button",
    abi.CTRL_TYPE_INTEGER64: "integer64",
    abi.CTRL_TYPE_STRING: "string",
    abi.CTRL_TYPE_BITMASK: "bitmask",
    abi.CTRL_TYPE_INTEGER_MENU: "menu",
}
_SETTABLE = _TYPE_NAMES.keys() - {abi.CTRL_TYPE_STRING}

_REASONS = {
    errno.EACCES: "it cannot be changed now; its automatic may be on",
    errno.EBUSY: "it cannot be changed now; another program has it",
    errno.ERANGE: "the camera says that the value is out of its range",
    errno.EREMOTEIO: "the camera has not enough power",
}
"""What error numbers mean of a control, by the V4L2 API's pages and by uvcvideo (uvc_query_ctrl)."""


@dataclass(frozen=True)
class CameraControl:
    """One control as the driver describes it; its name is as `plain_name` spells it.

    ``kind`` is ``integer``, ``integer64``, ``boolean``, ``menu``, ``bitmask``, ``button``, ``string``, or
    ``type 263`` for one that this program does not know; the last two can be listed but not set.
    ``settable``: it takes a value (perhaps not now: an inactive one waits for its automatic to be off).
    """

    id: int
    name: str
    kind: str
    minimum: int
    maximum: int
    step: int
    default: int
    settable: bool
    menu: Mapping[int, str]


@dataclass(frozen=True)
class ControlProblem:
    """A control that is not as it was requested, in one plain sentence.

    ``became``: what it is instead; None if the camera did not take it.
    """

    control: str
    message: str
    became: int | None = None


def list_controls(node: Node) -> list[CameraControl]:
    """Return all controls of a camera; unknown types and compound ones are listed too, not tripped over."""
    found: list[CameraControl] = []
    last_id = 0
    for _ in range(_MOST_CONTROLS):
        query = abi.QueryExtCtrl(id=last_id | abi.CTRL_FLAG_NEXT_CTRL | abi.CTRL_FLAG_NEXT_COMPOUND)
        try:
            fcntl.ioctl(node.fileno(), abi.VIDIOC_QUERY_EXT_CTRL, query)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):
                break
            raise node.failure(error, "list its controls") from None
        last_id = query.id
        if query.type != abi.CTRL_TYPE_CTRL_CLASS and not query.flags & abi.CTRL_FLAG_DISABLED:
            found.append(_control(node, query))
    return found


def get_value(node: Node, control: CameraControl) -> int | None:
    """Return a control's value now, None if it has none that can be read."""
    if control.kind in ("button", "string") or control.kind.startswith("type "):
        return None
    entry = abi.ExtControl(id=control.id)
    if _exchange(node, abi.VIDIOC_G_EXT_CTRLS, entry):
        return None
    if control.kind == "integer64":
        return int(entry.u.value64)
    return int(entry.u.value) & 0xFFFFFFFF if control.kind == "bitmask" else int(entry.u.value)


def set_value(node: Node, control: CameraControl, value: Value) -> ControlProblem | None:
    """Set a control and read it back; return what did not go as requested."""
    number = _number(control, value)
    if isinstance(number, str):
        return ControlProblem(control.name, number)
    if not control.settable:
        return ControlProblem(
            control.name, f"{control.name} cannot be set: it is a {control.kind} to read only"
        )
    entry = abi.ExtControl(id=control.id)
    if control.kind == "integer64":
        entry.u.value64 = number
    else:
        entry.u.value = ctypes.c_int32(number).value
    if refused := _exchange(node, abi.VIDIOC_S_EXT_CTRLS, entry):
        return ControlProblem(control.name, f"{control.name} does not take {value!r}: {refused}")
    became = get_value(node, control)
    if became is not None and became != number:
        message = f"{control.name} is {became} where {number} was set{_range(control)}"
        return ControlProblem(control.name, message, became)
    return None


def set_by_name(node: Node, wanted: Mapping[str, Value]) -> list[ControlProblem]:
    """Set controls by name, in the order given; return a problem for each that is missing or refuses."""
    known = {control.name: control for control in list_controls(node)}
    problems = []
    for name, value in wanted.items():
        control = known.get(plain_name(name))
        if control is None:
            near = difflib.get_close_matches(plain_name(name), known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else "mastctl camera check lists what it has"
            problems.append(ControlProblem(name, f"the camera has no control {name!r}; {hint}"))
        elif problem := set_value(node, control, value):
            problems.append(problem)
    return problems


def first_of(controls: Sequence[CameraControl], ids: Sequence[int]) -> CameraControl | None:
    """Return the first control that the camera has of several ids that mean the same."""
    by_id = {control.id: control for control in controls}
    return next((by_id[i] for i in ids if i in by_id), None)


def plain_name(name: str) -> str:
    """Return a control's name as written here: ``Exposure Time, Absolute`` is ``exposure_time_absolute``."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _control(node: Node, query: ctypes.Structure) -> CameraControl:
    kind = _TYPE_NAMES.get(query.type, f"type {query.type}")
    if query.flags & abi.CTRL_FLAG_HAS_PAYLOAD and kind != "string":
        kind = f"type {query.type}"
    menu = _menu(node, query) if query.type in (abi.CTRL_TYPE_MENU, abi.CTRL_TYPE_INTEGER_MENU) else {}
    settable = query.type in _SETTABLE and not query.flags & (
        abi.CTRL_FLAG_READ_ONLY | abi.CTRL_FLAG_HAS_PAYLOAD
    )
    name = plain_name(query.name.decode(errors="replace"))
    bounds = (query.minimum, query.maximum, query.step, query.default_value)
    return CameraControl(query.id, name, kind, *bounds, settable, menu)


def _menu(node: Node, query: ctypes.Structure) -> dict[int, str]:
    """A menu's entries; numbers may be left out by the driver."""
    entries = {}
    for index in range(max(0, query.minimum), min(query.maximum, query.minimum + _MOST_CONTROLS) + 1):
        entry = abi.QueryMenu(id=query.id, index=index)
        try:
            fcntl.ioctl(node.fileno(), abi.VIDIOC_QUERYMENU, entry)
        except OSError:
            continue
        is_number = query.type == abi.CTRL_TYPE_INTEGER_MENU
        entries[index] = str(entry.u.value) if is_number else entry.u.name.decode(errors="replace")
    return entries


def _number(control: CameraControl, value: Value) -> int | str:
    """The number for a value as people write it, or a sentence on why there is none."""
    if isinstance(value, str):
        for index, word in control.menu.items():
            if plain_name(word) == plain_name(value):
                return index
        choices = ", ".join(control.menu.values()) or f"a number {control.minimum} to {control.maximum}"
        return f"{control.name} is no {value!r}; it takes {choices}"
    number = int(value)
    if control.kind != "button" and not control.minimum <= number <= control.maximum:
        return f"{control.name} is to be {number}, outside its range{_range(control)}"
    return number


def _range(control: CameraControl) -> str:
    return f" ({control.minimum} to {control.maximum}, step {control.step})"


def _exchange(node: Node, request: int, entry: ctypes.Structure) -> str:
    """Make a request about one control; empty if it went well, else why not."""
    whole = abi.ExtControls(which=abi.CTRL_WHICH_CUR_VAL, count=1, controls=ctypes.pointer(entry))
    try:
        fcntl.ioctl(node.fileno(), request, whole)
    except OSError as error:
        if error.errno in (errno.ENODEV, errno.ENXIO):
            raise node.failure(error, "take controls") from None
        return _REASONS.get(error.errno or 0) or reason(error)
    return ""

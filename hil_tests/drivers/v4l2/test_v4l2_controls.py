"""Controls by name, on a made-up driver that answers as the V4L2 API says (linux/videodev2.h).

What a real driver shows of them is tested in hil_tests/vm.
"""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass, field
from typing import Any

import pytest

from drivers.v4l2 import abi
from drivers.v4l2.controls import get_value, list_controls, set_by_name, set_value

BRIGHTNESS, POWER_LINE, LINK_MHZ, PAYLOAD, GONE, MASK = (0x980900 + n for n in (0, 24, 30, 40, 41, 50))

NEXT_CTRL, NEXT_COMPOUND = 0x80000000, 0x40000000
"""V4L2_CTRL_FLAG_NEXT_... of videodev2.h."""


@dataclass
class Offered:
    """A control of the made-up driver; ``rounds_to`` is the step that it keeps values to."""

    type: int
    name: bytes
    bounds: tuple[int, int, int, int]
    flags: int = 0
    menu: dict[int, bytes | int] = field(default_factory=dict)
    value: int = 0
    rounds_to: int = 1


class Driver:
    """The kernel's side of the requests about controls; ``refuses`` is the number of every setting."""

    refuses = 0

    def __init__(self) -> None:
        self.offered = {
            BRIGHTNESS: Offered(abi.CTRL_TYPE_INTEGER, b"Brightness", (-64, 64, 1, 0), rounds_to=4),
            POWER_LINE: Offered(
                abi.CTRL_TYPE_MENU,
                b"Power Line Frequency",
                (0, 3, 1, 1),
                menu={0: b"Disabled", 1: b"50 Hz", 3: b"Auto"},
            ),
            LINK_MHZ: Offered(
                abi.CTRL_TYPE_INTEGER_MENU,
                b"Link Frequency",
                (0, 1, 1, 0),
                abi.CTRL_FLAG_READ_ONLY,
                {0: 456_000_000, 1: 5_000_000_000},
            ),
            PAYLOAD: Offered(263, b"Shape", (0, 0, 0, 0), abi.CTRL_FLAG_HAS_PAYLOAD),
            GONE: Offered(abi.CTRL_TYPE_INTEGER, b"Gone", (0, 1, 1, 0), abi.CTRL_FLAG_DISABLED),
            MASK: Offered(abi.CTRL_TYPE_BITMASK, b"Mask", (0, 2**32 - 1, 0, 0)),
        }

    def ioctl(self, descriptor: int, request: int, asked: Any) -> None:
        assert descriptor == 7
        if request == abi.VIDIOC_QUERY_EXT_CTRL:  # the next plain or compound one, as the flags ask for
            wanted = [kind for flag, kind in ((NEXT_CTRL, False), (NEXT_COMPOUND, True)) if asked.id & flag]
            after = asked.id & ~(NEXT_CTRL | NEXT_COMPOUND)
            later = (i for i in sorted(self.offered) if i > after and self.is_compound(i) in wanted)
            asked.id = next(later, 0) or self.refuse()
            one = self.offered[asked.id]
            asked.type, asked.name, asked.flags = one.type, one.name, one.flags
            asked.minimum, asked.maximum, asked.step, asked.default_value = one.bounds
        elif request == abi.VIDIOC_QUERYMENU:
            entry = self.offered[asked.id].menu.get(asked.index)
            if entry is None:
                self.refuse()
            elif isinstance(entry, bytes):
                asked.u.name = entry
            else:
                asked.u.value = entry
        else:
            control = asked.controls[0]
            one = self.offered[control.id]
            if request == abi.VIDIOC_S_EXT_CTRLS and self.refuses:
                raise OSError(self.refuses, os.strerror(self.refuses))
            if request == abi.VIDIOC_S_EXT_CTRLS:
                one.value = control.u.value // one.rounds_to * one.rounds_to
            else:
                assert request == abi.VIDIOC_G_EXT_CTRLS
                control.u.value = one.value

    def is_compound(self, control: int) -> bool:
        return bool(self.offered[control].flags & abi.CTRL_FLAG_HAS_PAYLOAD)

    def refuse(self) -> int:
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr("fcntl.ioctl", Driver().ioctl)

    class Opened:
        def fileno(self) -> int:
            return 7

    return Opened()


def test_every_control_is_listed_with_its_range_and_menu(node: Any) -> None:
    found = {one.name: one for one in list_controls(node)}
    assert list(found) == ["brightness", "power_line_frequency", "link_frequency", "shape", "mask"]
    one = found["brightness"]
    assert (one.minimum, one.maximum, one.step, one.default) == (-64, 64, 1, 0)
    assert one.settable and one.kind == "integer" and not one.menu
    assert found["power_line_frequency"].menu == {0: "Disabled", 1: "50 Hz", 3: "Auto"}
    assert found["link_frequency"].menu == {0: "456000000", 1: "5000000000"}


def test_a_menu_takes_its_entries_by_name_and_by_number(node: Any) -> None:
    menu = {one.name: one for one in list_controls(node)}["power_line_frequency"]
    for value, number in (("50 Hz", 1), ("auto", 3), (0, 0)):
        assert set_value(node, menu, value) is None
        assert get_value(node, menu) == number
    refused = set_value(node, menu, "60 Hz")
    assert refused is not None
    assert refused.message == "power_line_frequency is no '60 Hz'; it takes Disabled, 50 Hz, Auto"


def test_both_ends_of_a_range_are_taken_and_no_further(node: Any) -> None:
    brightness = list_controls(node)[0]
    for value in (-64, 64):
        assert set_value(node, brightness, value) is None
        assert get_value(node, brightness) == value
    for value in (-65, 65):
        refused = set_value(node, brightness, value)
        assert refused is not None
        assert refused.message == (f"brightness is to be {value}, outside its range (-64 to 64, step 1)")
        assert get_value(node, brightness) == 64


def test_a_value_that_the_driver_changes_is_told(node: Any) -> None:
    (problem,) = set_by_name(node, {"Brightness": 7})
    assert problem.message == "brightness is 4 where 7 was set (-64 to 64, step 1)"


def test_a_name_that_the_camera_lacks_is_told_with_the_nearest(node: Any) -> None:
    near, far = set_by_name(node, {"brightnes": 1, "zoom_absolute": 1})
    assert near.message == "the camera has no control 'brightnes'; did you mean 'brightness'?"
    assert far.message.endswith("'zoom_absolute'; mastctl camera check lists what it has")


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EACCES, "it cannot be changed now; its automatic may be on"),
        (errno.EPROTO, "its USB transfers fail; try another cable, port or powered hub"),
        (errno.EIO, "Input/output error"),
    ],
)
def test_why_a_control_takes_no_value_is_said_in_words(
    node: Any, monkeypatch: pytest.MonkeyPatch, number: int, words: str
) -> None:
    monkeypatch.setattr(Driver, "refuses", number)
    problem = set_value(node, list_controls(node)[0], 4)
    assert problem is not None and problem.message == f"brightness does not take 4: {words}"

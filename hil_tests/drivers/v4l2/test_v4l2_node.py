"""What a node says of itself and of its format, by requests as the kernel's header lays them out."""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Callable
from typing import Any

import pytest

from drivers.errors import CameraBusy, DriverError, NoCamera, NoPermission, StreamFailed
from drivers.v4l2 import abi, node
from drivers.v4l2.node import Node, NotACamera

Answers = dict[int, Callable[[Any], bytes]]

CAPTURE, PLANES, META, OUTPUT, STREAMING, DEVICE_CAPS = 1, 0x1000, 0x00800000, 2, 0x04000000, 0x80000000
"""V4L2_CAP_... of videodev2.h."""


def capability(flags: int) -> bytes:
    """struct v4l2_capability of a node of a device that can also do all else."""
    everything = CAPTURE | PLANES | META | OUTPUT | STREAMING | DEVICE_CAPS
    return struct.pack("16s32s32sIII12x", b"isp", b"Two planes", b"platform:isp", 0x060100, everything, flags)


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> Answers:
    """Bytes that the kernel puts over a request's argument; every other request is refused."""
    answers: Answers = {}

    def ioctl(descriptor: int, request: int, argument: Any) -> int:
        if request not in answers:
            raise OSError(errno.ENOTTY, os.strerror(errno.ENOTTY))
        told = answers[request](argument)
        memoryview(argument).cast("B")[: len(told)] = told
        return 0

    monkeypatch.setattr(node.fcntl, "ioctl", ioctl)
    return answers


def test_a_format_in_planes_has_the_first_ones_stride_and_the_length_of_each(answers: Answers) -> None:
    answers[abi.VIDIOC_QUERYCAP] = lambda _: capability(PLANES | STREAMING)
    planes = [(64 * 50, 64), (32 * 50, 32), (7, 7)]  # the last is what a driver left there
    told = struct.pack("<II4sII", 60, 50, b"NM12", 1, 8)
    told += b"".join(struct.pack("<II12x", *plane) for plane in planes).ljust(8 * 20, b"\0") + bytes([2])

    def format_told(argument: Any) -> bytes:
        assert argument.type == 9  # V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE
        return struct.pack("<I4x", 9) + told

    answers[abi.VIDIOC_G_FMT] = format_told
    with Node("/dev/null", "eye") as opened:
        found = opened.current_format()
    assert (found.code, found.size_px, found.stride_bytes) == ("NM12", (60, 50), 64)
    assert (found.length_bytes, found.planes_bytes) == (64 * 50 + 32 * 50, (64 * 50, 32 * 50))


def test_a_format_in_one_piece_is_told_whole(answers: Answers) -> None:
    answers[abi.VIDIOC_QUERYCAP] = lambda _: capability(CAPTURE | PLANES | STREAMING)
    answers[abi.VIDIOC_G_FMT] = lambda argument: struct.pack(
        "<I4xII4sIII", argument.type, 60, 50, b"Y16 ", 1, 128, 6400
    )
    with Node("/dev/null", "eye") as opened:
        found = opened.current_format()
    assert (found.code, found.size_px, found.stride_bytes) == ("Y16", (60, 50), 128)
    assert (found.length_bytes, found.planes_bytes) == (6400, ())


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (META, "is a metadata node; the pictures come from the camera's other node"),
        (OUTPUT, "is a video output, it gives no pictures"),
        (CAPTURE, "cannot stream"),
        (PLANES, "cannot stream"),
        (STREAMING, "is no camera: it captures no video"),
    ],
)
def test_a_node_without_pictures_says_what_it_is(answers: Answers, flags: int, words: str) -> None:
    answers[abi.VIDIOC_QUERYCAP] = lambda _: capability(flags)
    with pytest.raises(NotACamera) as raised:
        Node("/dev/null", "eye")
    assert words in str(raised.value)


@pytest.mark.parametrize(
    ("number", "kind", "words"),
    [
        (errno.EACCES, NoPermission, "no permission to open /dev/null"),
        (errno.EPERM, NoPermission, "no permission to open /dev/null"),
        (errno.ENXIO, NoCamera, "there is no /dev/null; is the camera connected?"),
        (errno.EBUSY, CameraBusy, "/dev/null is in use by another program"),
        (errno.EIO, StreamFailed, "/dev/null cannot be opened: Input/output error"),
    ],
)
def test_why_a_node_does_not_open_is_said(
    monkeypatch: pytest.MonkeyPatch, number: int, kind: type[DriverError], words: str
) -> None:
    def refuse(*_: object) -> int:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(node.os, "open", refuse)
    with pytest.raises(kind) as raised:
        Node("/dev/null", "eye")
    assert words in str(raised.value)

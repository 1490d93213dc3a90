"""What a node says of itself and of its format, by requests as the kernel's header lays them out."""

from __future__ import annotations

import errno
import io
import os
import struct
from collections.abc import Callable
from typing import Any

import pytest

from drivers.errors import StreamFailed
from drivers.v4l2 import abi
from drivers.v4l2.node import Node

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

    monkeypatch.setattr("fcntl.ioctl", ioctl)
    return answers


def test_a_format_in_planes_has_its_stride_and_all_lengths(answers: Answers) -> None:
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


STARTED = 0x40045612  # VIDIOC_STREAMON of videodev2.h


def refused_start(monkeypatch: pytest.MonkeyPatch, number: int) -> str:
    """The message of a stream whose start the kernel refuses with a number."""

    def ioctl(descriptor: int, request: int, argument: Any) -> int:
        if request == STARTED:
            raise OSError(number, os.strerror(number))
        told = b""
        if request == abi.VIDIOC_QUERYCAP:
            told = capability(CAPTURE | STREAMING)
        elif request == abi.VIDIOC_G_FMT:
            told = struct.pack("<I4xII4sIII", argument.type, 1280, 720, b"YUYV", 1, 2560, 1843200)
        elif request == abi.VIDIOC_G_PARM:  # capability, mode, and 1/30 s from frame to frame
            told = struct.pack("<IIIII", argument.type, 0x1000, 0, 1, 30)
        elif request == abi.VIDIOC_QUERYBUF:
            argument.length = 4096
        memoryview(argument).cast("B")[: len(told)] = told
        return 0

    monkeypatch.setattr("fcntl.ioctl", ioctl)
    monkeypatch.setattr("mmap.mmap", lambda *_, **__: io.BytesIO())
    monkeypatch.setattr(Node, "queue", lambda *_: None)
    with Node("/dev/null", "navcam_left") as opened, pytest.raises(StreamFailed) as raised:
        opened.start(4)
    return str(raised.value)


def test_a_bus_without_bandwidth_is_said_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    assert refused_start(monkeypatch, errno.ENOSPC) == (
        "navcam_left: /dev/null does not start the stream: its USB bus has no bandwidth left for YUYV "
        "1280x720 at 30 Hz; use the format MJPG, a smaller size or a lower rate, or a port of another "
        "USB controller"
    )

"""An HDMI output of the vivid driver, as a screen that shows grey pictures until the next one is there."""

from __future__ import annotations

import ctypes
import fcntl
import mmap
import os
import struct
from pathlib import Path

import numpy as np

from drivers.interfaces import Image
from drivers.v4l2 import abi

SIZE_PX = (640, 480)
BUF_TYPE_VIDEO_OUTPUT = 2
BUFFERS = 2  # fewer the driver does not start with

# struct v4l2_dv_timings of 640x480 at 59.94 Hz (CEA-861 format 1): type BT.656/1120, width, height,
# interlaced, polarities, pixel clock, front porch, sync and back porch across and down, those of a second
# field, standards, flags; zeros fill it up.
_TIMINGS = struct.pack("=I4IQ11I", 0, *SIZE_PX, 0, 0, 25_175_000, 16, 96, 48, 10, 2, 33, 0, 0, 0, 0, 0)
_TIMINGS = _TIMINGS.ljust(132, b"\0")
_VIDIOC_S_DV_TIMINGS = 3 << 30 | len(_TIMINGS) << 16 | ord("V") << 8 | 87


def node(name: str, folder: Path = Path("/sys/class/video4linux")) -> Path:
    """Return the node that the kernel gives a name, as ``vivid-000-vid-out``. Raises LookupError."""
    for entry in folder.glob("video*"):
        if (entry / "name").read_text().strip() == name:
            return Path("/dev") / entry.name
    raise LookupError(f"the kernel has no video node {name}")


def set_timings(path: Path) -> None:
    """Set an HDMI input or output to 640x480 at 60 Hz; both ends of a cable need the same. Raises OSError."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        fcntl.ioctl(descriptor, _VIDIOC_S_DV_TIMINGS, _TIMINGS)
    finally:
        os.close(descriptor)


class HdmiOutput:
    """One open output; ``show`` from one thread at a time. Raises OSError when the kernel refuses."""

    def __init__(self, path: Path) -> None:
        self._maps: list[mmap.mmap] = []
        self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            self._start()
        except BaseException:
            self.close()
            raise

    def _start(self) -> None:
        wanted = abi.Format(type=BUF_TYPE_VIDEO_OUTPUT)
        pix = wanted.fmt.pix
        pix.width, pix.height = SIZE_PX
        pix.pixelformat, pix.field = abi.fourcc("YUYV"), abi.FIELD_NONE
        fcntl.ioctl(self._fd, abi.VIDIOC_S_FMT, wanted)
        got = (pix.width, pix.height, pix.bytesperline, abi.fourcc_text(pix.pixelformat))
        if got != (*SIZE_PX, 2 * SIZE_PX[0], "YUYV"):
            raise OSError(f"the output is set to {got} where {SIZE_PX} YUYV is expected")
        request = abi.RequestBuffers(count=BUFFERS, type=BUF_TYPE_VIDEO_OUTPUT, memory=abi.MEMORY_MMAP)
        fcntl.ioctl(self._fd, abi.VIDIOC_REQBUFS, request)
        if request.count != BUFFERS:
            raise OSError(f"the output gives {request.count} buffers where {BUFFERS} are expected")
        for index in range(BUFFERS):
            buffer = self._buffer(index)
            fcntl.ioctl(self._fd, abi.VIDIOC_QUERYBUF, buffer)
            self._maps.append(mmap.mmap(self._fd, buffer.length, offset=buffer.m.offset))

    def show(self, image: Image) -> None:
        """Show a grey picture (480, 640) from now on.

        The output is switched off for a moment, in which its capture node must give no frames: unlike a
        picture queued behind the present one, which the driver takes up at a later tick, nothing of the
        present one is seen after this. Raises OSError.
        """
        kind = ctypes.c_int32(BUF_TYPE_VIDEO_OUTPUT)
        fcntl.ioctl(self._fd, abi.VIDIOC_STREAMOFF, kind)
        for index in range(BUFFERS):
            self._queue(index, image)
        fcntl.ioctl(self._fd, abi.VIDIOC_STREAMON, kind)

    def close(self) -> None:
        """Switch the output off."""
        os.close(self._fd)
        for mapping in self._maps:
            mapping.close()

    def _queue(self, index: int, image: Image) -> None:
        """Fill a buffer with grey and no colour, and give it to the driver."""
        pixels = np.frombuffer(self._maps[index], np.uint8, 2 * image.size).reshape(*image.shape, 2)
        pixels[..., 0] = image
        pixels[..., 1] = 128
        buffer = self._buffer(index)
        buffer.bytesused = pixels.size
        fcntl.ioctl(self._fd, abi.VIDIOC_QBUF, buffer)

    def _buffer(self, index: int) -> ctypes.Structure:
        return abi.Buffer(
            index=index, type=BUF_TYPE_VIDEO_OUTPUT, memory=abi.MEMORY_MMAP, field=abi.FIELD_NONE
        )

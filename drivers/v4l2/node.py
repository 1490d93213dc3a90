"""One open video node: the kernel's requests as methods, and its refusals as typed errors."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import grp
import mmap
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from drivers.errors import (
    BadOptions,
    CameraBusy,
    DriverError,
    NoCamera,
    NoPermission,
    StreamFailed,
)
from drivers.pixels import PictureFormat
from drivers.v4l2 import abi

_quick_ioctl = ctypes.CDLL(None, use_errno=True).ioctl
"""For the two requests of every frame: half the time of `fcntl.ioctl`. It releases Python's lock, because
many drivers make them wait for the end of a control write."""
_quick_ioctl.argtypes = (ctypes.c_int, ctypes.c_ulong, ctypes.c_void_p)

_CAPTURES = abi.CAP_VIDEO_CAPTURE | abi.CAP_VIDEO_CAPTURE_MPLANE
_MOST_ENTRIES = 1024  # of any enumeration: a driver that never ends one must not hang us


_USB_TRANSFERS = "its USB transfers fail; try another cable, port or powered hub"
_USB_REASONS = {
    errno.EPROTO: _USB_TRANSFERS,
    errno.EILSEQ: _USB_TRANSFERS,
    errno.ETIME: _USB_TRANSFERS,
    errno.ETIMEDOUT: "it does not answer over USB; unplug it and plug it in again",
    errno.EPIPE: "it refuses the USB request; unplug it and plug it in again, or use another format",
}
"""What the kernel's error numbers mean of a USB device (Documentation/driver-api/usb/error-codes.rst)."""


class NotACamera(BadOptions):
    """The path leads to something that gives no pictures."""

    code = "not_a_camera"


@dataclass(frozen=True)
class Identity:
    """What a node says of itself: driver, card (the name for people), bus (where it is plugged in)."""

    driver: str
    card: str
    bus: str
    capabilities: int


class Dequeued(NamedTuple):
    """A filled buffer, still ours until it is queued again.

    ``planes`` has, of a camera that captures in planes, from which byte to which each plane is filled.
    """

    number: int
    used_bytes: int
    flags: int
    sequence: int
    stamp_s: float
    planes: tuple[tuple[int, int], ...] = ()


class Node:
    """An open video node, of either capture interface of the kernel: single-planar or multi-planar.

    A context manager; closing it stops the stream and gives everything back. Raises NoCamera, NoPermission,
    CameraBusy, NotACamera if it cannot be opened or gives no pictures.
    """

    def __init__(self, path: str | Path, name: str = "") -> None:
        self.path = Path(path)
        self.name = "" if name == str(path) else name  # messages name the path themselves
        self._maps: list[tuple[mmap.mmap, ...]] = []  # of each buffer, one a plane
        self._streaming = False
        self._fd = _open(self.path, self.name)
        try:
            self.identity = self._identify()
        except BaseException:
            os.close(self._fd)
            raise
        self._in_planes = not self.identity.capabilities & abi.CAP_VIDEO_CAPTURE
        self._type = abi.BUF_TYPE_VIDEO_CAPTURE_MPLANE if self._in_planes else abi.BUF_TYPE_VIDEO_CAPTURE
        self._planes = (abi.BufferPlane * abi.MAX_PLANES)()
        self._exchanged = self._buffer(0)  # for the requests made for every frame; made once, as each costs
        self._exchanged_at = ctypes.addressof(self._exchanged)

    def fileno(self) -> int:
        """Return the descriptor, for poll."""
        return self._fd

    def close(self) -> None:
        """Stop and give back buffers, mappings and descriptor, each even if another refuses."""
        if self._fd < 0:
            return
        fd, self._fd = self._fd, -1
        try:
            if self._streaming:
                fcntl.ioctl(fd, abi.VIDIOC_STREAMOFF, ctypes.c_int32(self._type))
        except OSError:
            pass  # a camera that is gone has no stream to stop
        finally:
            self._unmap()
            os.close(fd)  # the kernel frees the buffers with it

    def __enter__(self) -> Node:
        return self

    def __exit__(self, *ignored: object) -> None:
        self.close()

    # What it can do

    def formats(self) -> list[str]:
        """Return the codes of the formats that it offers, in the driver's order."""
        found = []
        for index in range(_MOST_ENTRIES):
            entry = abi.FmtDesc(index=index, type=self._type)
            if not self._next(abi.VIDIOC_ENUM_FMT, entry):
                break
            found.append(abi.fourcc_text(entry.pixelformat))
        return found

    def sizes(self, code: str) -> tuple[list[tuple[int, int]], tuple[int, ...] | None]:
        """Return a format's (width, height), or (min_w, max_w, step_w, min_h, max_h, step_h) of a range."""
        found = []
        for index in range(_MOST_ENTRIES):
            entry = abi.FrmSizeEnum(index=index, pixel_format=abi.fourcc(code))
            if not self._next(abi.VIDIOC_ENUM_FRAMESIZES, entry):
                break
            if entry.type != abi.FRMSIZE_DISCRETE:
                return [], tuple(entry.sizes)
            found.append((int(entry.sizes[0]), int(entry.sizes[1])))
        return found, None

    def rates_hz(self, code: str, size_px: tuple[int, int]) -> list[float]:
        """Return the frame rates at a format and size; of a range its two ends."""
        found = []
        for index in range(_MOST_ENTRIES):
            entry = abi.FrmIvalEnum(
                index=index, pixel_format=abi.fourcc(code), width=size_px[0], height=size_px[1]
            )
            if not self._next(abi.VIDIOC_ENUM_FRAMEINTERVALS, entry):
                break
            intervals = entry.intervals[:1] if entry.type == abi.FRMIVAL_DISCRETE else entry.intervals[:2]
            found += [i.denominator / i.numerator for i in intervals if i.numerator and i.denominator]
            if entry.type != abi.FRMIVAL_DISCRETE:
                break
        return found

    def selection(self, target: int) -> tuple[int, int, int, int] | None:
        """Return a rectangle of its cropping: left, top, width, height; None if it reports none."""
        # The kernel takes the single-planar type for nodes of either kind.
        entry = abi.Selection(type=abi.BUF_TYPE_VIDEO_CAPTURE, target=target)
        if not self._next(abi.VIDIOC_G_SELECTION, entry, "report its crop"):
            return None
        return entry.r.left, entry.r.top, entry.r.width, entry.r.height

    # What it shall do

    def set_format(self, code: str, size_px: tuple[int, int]) -> PictureFormat:
        """Ask for a format and return the driver's, which may be another. Raises DriverError."""
        wanted = abi.Format(type=self._type)
        pix = wanted.fmt.pix_mp if self._in_planes else wanted.fmt.pix
        pix.width, pix.height = size_px
        pix.pixelformat, pix.field = abi.fourcc(code), abi.FIELD_NONE
        self.call(abi.VIDIOC_S_FMT, wanted, f"set the format {code} {size_px[0]}x{size_px[1]}")
        return _picture_format(wanted)

    def current_format(self) -> PictureFormat:
        """Return the format that is set now. Raises DriverError."""
        found = abi.Format(type=self._type)
        self.call(abi.VIDIOC_G_FMT, found, "report its format")
        return _picture_format(found)

    def set_rate(self, rate_hz: float) -> float | None:
        """Ask for a frame rate and return the driver's, None if it has no say in it. Raises DriverError."""
        parm = abi.StreamParm(type=self._type)
        parm.parm.capture.timeperframe = abi.Fract(1000, round(rate_hz * 1000))
        try:
            fcntl.ioctl(self._fd, abi.VIDIOC_S_PARM, parm)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):
                return None
            raise self.failure(error, f"set the rate {rate_hz:g} Hz") from None
        return _rate(parm)

    def current_rate(self) -> float | None:
        """Return the frame rate that is set now, None where the driver does not say."""
        parm = abi.StreamParm(type=self._type)
        return _rate(parm) if self._next(abi.VIDIOC_G_PARM, parm) else None

    # The stream

    def start(self, buffers: int) -> None:
        """Get buffers, queue them all, start. Raises DriverError; `close` gives back what was got."""
        request = abi.RequestBuffers(count=buffers, type=self._type, memory=abi.MEMORY_MMAP)
        self.call(abi.VIDIOC_REQBUFS, request, f"give {buffers} buffers")
        if request.count < 2:
            raise StreamFailed(
                f"its driver gives {request.count} buffers where at least 2 are needed", device=self.name
            )
        for index in range(request.count):
            buffer = self._buffer(index)
            self.call(abi.VIDIOC_QUERYBUF, buffer, f"locate buffer {index}")
            planes = [(buffer.length, buffer.m.offset)]
            if self._in_planes:
                planes = [(plane.length, plane.m.mem_offset) for plane in self._planes[: buffer.length]]
            try:
                self._maps.append(
                    tuple(
                        mmap.mmap(self._fd, length, mmap.MAP_SHARED, mmap.PROT_READ, offset=offset)
                        for length, offset in planes
                    )
                )
            except OSError as error:
                raise self.failure(error, f"map buffer {index}") from None
            self.queue(index)
        try:
            fcntl.ioctl(self._fd, abi.VIDIOC_STREAMON, ctypes.c_int32(self._type))
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise self.failure(error, "start the stream") from None
            raise StreamFailed(
                f"{self.path} does not start the stream: its USB bus has no bandwidth left for "
                f"{self._picture()}; use the format MJPG, a smaller size or a lower rate, or a port of "
                "another USB controller",
                device=self.name,
            ) from None
        self._streaming = True

    def queue(self, index: int) -> None:
        """Give a buffer back to the driver. Raises DriverError."""
        self._exchanged.index = index
        if _quick_ioctl(self._fd, abi.VIDIOC_QBUF, self._exchanged_at) < 0:
            raise self.failure(OSError(ctypes.get_errno(), ""), f"take buffer {index} back")

    def dequeue(self) -> Dequeued | None:
        """Return the next filled buffer, None if there is none yet. Raises DriverError."""
        buffer = self._exchanged
        if _quick_ioctl(self._fd, abi.VIDIOC_DQBUF, self._exchanged_at) < 0:
            if (number := ctypes.get_errno()) == errno.EAGAIN:
                return None
            raise self.failure(OSError(number, ""), "give a frame")
        stamp = buffer.timestamp
        stamp_s = stamp.tv_sec + stamp.tv_usec * 1e-6
        if self._in_planes:
            planes = tuple(
                (p.data_offset, p.bytesused) for p in self._planes[: len(self._maps[buffer.index])]
            )
            used_bytes = sum(end - begin for begin, end in planes)
            return Dequeued(buffer.index, used_bytes, buffer.flags, buffer.sequence, stamp_s, planes)
        return Dequeued(buffer.index, buffer.bytesused, buffer.flags, buffer.sequence, stamp_s)

    def bytes_of(self, buffer: Dequeued) -> memoryview:
        """Return a dequeued buffer's bytes, in the driver's own memory: good until it is queued again.

        Of several planes they are joined, one after the other, in memory of their own.
        """
        maps = self._maps[buffer.number]
        if not buffer.planes:
            return memoryview(maps[0])[: buffer.used_bytes]
        parts = [memoryview(m)[begin:end] for m, (begin, end) in zip(maps, buffer.planes, strict=True)]
        return parts[0] if len(parts) == 1 else memoryview(b"".join(parts))

    def check_there(self) -> None:
        """Raise NoCamera if the camera was unplugged."""
        self.call(abi.VIDIOC_QUERYCAP, abi.Capability(), "answer")

    def call(self, request: int, argument: ctypes.Structure | ctypes.c_int32, what: str) -> None:
        """Make one request; a refusal becomes a typed error that says what the camera did not do."""
        try:
            fcntl.ioctl(self._fd, request, argument)
        except OSError as error:
            raise self.failure(error, what) from None

    def _buffer(self, index: int) -> ctypes.Structure:
        buffer = abi.Buffer(index=index, type=self._type, memory=abi.MEMORY_MMAP)
        if self._in_planes:
            buffer.m.planes, buffer.length = ctypes.addressof(self._planes), abi.MAX_PLANES
        return buffer

    def _next(self, request: int, entry: ctypes.Structure, what: str = "list its formats") -> bool:
        """Fill one entry of an enumeration; False at its end, and where the driver has none."""
        try:
            fcntl.ioctl(self._fd, request, entry)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY, errno.ENODATA):
                return False
            raise self.failure(error, what) from None
        return True

    def _identify(self) -> Identity:
        found = abi.Capability()
        try:
            fcntl.ioctl(self._fd, abi.VIDIOC_QUERYCAP, found)
        except OSError as error:
            if error.errno in (errno.ENOTTY, errno.EINVAL):
                raise NotACamera(f"{self.path} is no video device", device=self.name) from None
            raise self.failure(error, "identify itself") from None
        flags = found.capabilities
        flags = found.device_caps if flags & abi.CAP_DEVICE_CAPS else flags
        driver, card, bus = (f.decode(errors="replace") for f in (found.driver, found.card, found.bus_info))
        if not flags & _CAPTURES or not flags & abi.CAP_STREAMING:
            raise NotACamera(f"{self.path} ({card}) {_what_else(flags)}", device=self.name)
        return Identity(driver, card, bus, flags)

    def failure(self, error: OSError, what: str) -> DriverError:
        """Return the typed error for a refused request; ``what`` says what the camera did not do."""
        if error.errno in (errno.ENODEV, errno.ENXIO):
            return NoCamera(f"{self.path} is gone", device=self.name)
        if error.errno == errno.EBUSY:
            return CameraBusy(f"{self.path} is in use by another program", device=self.name)
        return StreamFailed(f"{self.path} does not {what}: {reason(error)}", device=self.name)

    def _picture(self) -> str:
        """The format, size and rate that are set, for a message."""
        try:
            set_now = self.current_format()
        except DriverError:
            return "its pictures"
        rate_hz = self.current_rate()
        at = "" if rate_hz is None else f" at {rate_hz:g} Hz"
        return f"{set_now.code} {set_now.size_px[0]}x{set_now.size_px[1]}{at}"

    def _unmap(self) -> None:
        for mapping in chain.from_iterable(self._maps):
            with contextlib.suppress(BufferError):  # a frame is still in use: it goes with that
                mapping.close()
        self._maps = []


def reason(error: OSError) -> str:
    """Return why the kernel refused a request."""
    return _USB_REASONS.get(error.errno or 0) or os.strerror(error.errno or 0)


def capture_nodes(folder: Path = Path("/sys/class/video4linux")) -> Iterator[Path]:
    """Yield the paths of all video nodes that exist now, in the kernel's order; not all of them capture."""
    if folder.is_dir():
        numbered = [(int(p.name[5:]), p.name) for p in folder.glob("video*") if p.name[5:].isdecimal()]
        for _, name in sorted(numbered):
            yield Path("/dev") / name


def _open(path: Path, name: str) -> int:
    """Open a node without waiting; each refusal as one sentence."""
    try:
        status = path.stat()
        if not stat.S_ISCHR(status.st_mode):
            raise NotACamera(f"{path} is no video device", device=name)
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.ENOTDIR):
            raise NoCamera(f"there is no {path}; is the camera connected?", device=name) from None
        if error.errno in (errno.EACCES, errno.EPERM):
            raise NoPermission(f"no permission to open {path}{_who_may(path)}", device=name) from None
        if error.errno == errno.EBUSY:
            raise CameraBusy(f"{path} is in use by another program", device=name) from None
        raise StreamFailed(f"{path} cannot be opened: {os.strerror(error.errno or 0)}", device=name) from None


def _who_may(path: Path) -> str:
    """Which group may open a node, and how to join it."""
    try:
        status = path.stat()
    except OSError:
        return ""
    try:
        group = grp.getgrgid(status.st_gid).gr_name
    except KeyError:
        group = str(status.st_gid)
    if status.st_mode & 0o060 != 0o060 or status.st_gid == 0:
        return "; only root may; a udev rule (docs/how-to/cameras.md) gives it to the group video"
    return f"; the group {group} may: add the user to it (usermod -aG {group} USER) and log in again"


def _what_else(flags: int) -> str:
    """What a node is that gives no pictures."""
    if flags & abi.CAP_META_CAPTURE:
        return "is a metadata node; the pictures come from the camera's other node"
    if flags & abi.CAP_VIDEO_OUTPUT:
        return "is a video output, it gives no pictures"
    if flags & _CAPTURES:
        return "cannot stream"
    return "is no camera: it captures no video"


def _picture_format(answer: ctypes.Structure) -> PictureFormat:
    if answer.type == abi.BUF_TYPE_VIDEO_CAPTURE_MPLANE:
        several = answer.fmt.pix_mp
        lengths = tuple(plane.sizeimage for plane in several.plane_fmt[: several.num_planes])
        size_px, stride_bytes = (several.width, several.height), several.plane_fmt[0].bytesperline
        code = abi.fourcc_text(several.pixelformat)
        return PictureFormat(code, size_px, stride_bytes, sum(lengths), several.field, lengths)
    pix = answer.fmt.pix
    code = abi.fourcc_text(pix.pixelformat)
    return PictureFormat(code, (pix.width, pix.height), pix.bytesperline, pix.sizeimage, pix.field)


def _rate(parm: ctypes.Structure) -> float | None:
    """The frame rate in an answer, if it holds one."""
    period = parm.parm.capture.timeperframe
    if not parm.parm.capture.capability & abi.CAPTURE_TIMEPERFRAME or not period.numerator:
        return None
    return float(period.denominator / period.numerator)

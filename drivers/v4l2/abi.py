"""The kernel's interface to cameras, as C lays it out: structures, request numbers, constants.

Source: include/uapi/linux/videodev2.h and v4l2-controls.h, which the kernel promises not to change. Only what
capture needs, in one plane or several. Layouts are those of 64-bit Linux (x86-64 and aarch64 agree).
"""

from __future__ import annotations

import ctypes
from ctypes import Structure, Union, c_char, c_int32, c_int64, c_uint8, c_uint16, c_uint32, c_uint64, c_void_p

BUF_TYPE_VIDEO_CAPTURE = 1
BUF_TYPE_VIDEO_CAPTURE_MPLANE = 9
MAX_PLANES = 8
MEMORY_MMAP = 1
FIELD_ANY, FIELD_NONE = 0, 1

CAP_VIDEO_CAPTURE = 0x00000001
CAP_VIDEO_OUTPUT = 0x00000002
CAP_VIDEO_CAPTURE_MPLANE = 0x00001000
CAP_META_CAPTURE = 0x00800000
CAP_STREAMING = 0x04000000
CAP_DEVICE_CAPS = 0x80000000

CAPTURE_TIMEPERFRAME = 0x1000  # v4l2_captureparm.capability

FRMSIZE_DISCRETE = FRMIVAL_DISCRETE = 1

BUF_FLAG_ERROR = 0x00000040
BUF_FLAG_TIMESTAMP_MASK = 0x0000E000
BUF_FLAG_TIMESTAMP_MONOTONIC = 0x00002000
BUF_FLAG_TSTAMP_SRC_MASK = 0x00070000
BUF_FLAG_TSTAMP_SRC_SOE = 0x00010000

SEL_TGT_CROP = 0x0000
SEL_TGT_CROP_BOUNDS = 0x0002
SEL_TGT_NATIVE_SIZE = 0x0003
SEL_TGT_COMPOSE = 0x0100

CTRL_FLAG_DISABLED = 0x0001
CTRL_FLAG_READ_ONLY = 0x0004
CTRL_FLAG_HAS_PAYLOAD = 0x0100
CTRL_FLAG_NEXT_COMPOUND = 0x40000000
CTRL_FLAG_NEXT_CTRL = 0x80000000
CTRL_WHICH_CUR_VAL = 0

CTRL_TYPE_INTEGER = 1
CTRL_TYPE_BOOLEAN = 2
CTRL_TYPE_MENU = 3
CTRL_TYPE_BUTTON = 4
CTRL_TYPE_INTEGER64 = 5
CTRL_TYPE_CTRL_CLASS = 6
CTRL_TYPE_STRING = 7
CTRL_TYPE_BITMASK = 8
CTRL_TYPE_INTEGER_MENU = 9

CID_EXPOSURE_AUTO = 0x009A0901
CID_EXPOSURE_ABSOLUTE = 0x009A0902  # in units of 100 us
CID_EXPOSURE_AUTO_PRIORITY = 0x009A0903
CID_FOCUS_ABSOLUTE = 0x009A090A
CID_FOCUS_AUTO = 0x009A090C
CID_AUTO_WHITE_BALANCE = 0x0098090C
CID_AUTOGAIN = 0x00980912
CID_GAIN = 0x00980913
CID_HFLIP = 0x00980914
CID_VFLIP = 0x00980915
CID_WHITE_BALANCE_TEMPERATURE = 0x0098091A
EXPOSURE_MANUAL = 1


class Capability(Structure):
    """struct v4l2_capability."""

    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class FmtDesc(Structure):
    """struct v4l2_fmtdesc."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class Fract(Structure):
    """struct v4l2_fract."""

    _fields_ = (("numerator", c_uint32), ("denominator", c_uint32))


class FrmSizeEnum(Structure):
    """struct v4l2_frmsizeenum; ``sizes`` holds width, height, or min, max, step of both."""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("type", c_uint32),
        ("sizes", c_uint32 * 6),
        ("reserved", c_uint32 * 2),
    )


class FrmIvalEnum(Structure):
    """struct v4l2_frmivalenum; ``intervals`` holds one interval, or min, max and step."""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("type", c_uint32),
        ("intervals", Fract * 3),
        ("reserved", c_uint32 * 2),
    )


class PixFormat(Structure):
    """struct v4l2_pix_format."""

    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("bytesperline", c_uint32),
        ("sizeimage", c_uint32),
        ("colorspace", c_uint32),
        ("priv", c_uint32),
        ("flags", c_uint32),
        ("ycbcr_enc", c_uint32),
        ("quantization", c_uint32),
        ("xfer_func", c_uint32),
    )


class PlanePixFormat(Structure):
    """struct v4l2_plane_pix_format, which is packed."""

    _pack_ = 1
    _fields_ = (("sizeimage", c_uint32), ("bytesperline", c_uint32), ("reserved", c_uint16 * 6))


class PixFormatMplane(Structure):
    """struct v4l2_pix_format_mplane, which is packed."""

    _pack_ = 1
    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("colorspace", c_uint32),
        ("plane_fmt", PlanePixFormat * MAX_PLANES),
        ("num_planes", c_uint8),
        ("flags", c_uint8),
        ("ycbcr_enc", c_uint8),
        ("quantization", c_uint8),
        ("xfer_func", c_uint8),
        ("reserved", c_uint8 * 7),
    )


class _FormatUnion(Union):
    # v4l2_window holds pointers, which align the union to 8.
    _fields_ = (("pix", PixFormat), ("pix_mp", PixFormatMplane), ("raw", c_uint8 * 200), ("align", c_uint64))


class Format(Structure):
    """struct v4l2_format."""

    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class CaptureParm(Structure):
    """struct v4l2_captureparm."""

    _fields_ = (
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("timeperframe", Fract),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("reserved", c_uint32 * 4),
    )


class _ParmUnion(Union):
    _fields_ = (("capture", CaptureParm), ("raw", c_uint8 * 200))


class StreamParm(Structure):
    """struct v4l2_streamparm."""

    _fields_ = (("type", c_uint32), ("parm", _ParmUnion))


class RequestBuffers(Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    )


class Rect(Structure):
    """struct v4l2_rect."""

    _fields_ = (("left", c_int32), ("top", c_int32), ("width", c_uint32), ("height", c_uint32))


class Selection(Structure):
    """struct v4l2_selection."""

    _fields_ = (
        ("type", c_uint32),
        ("target", c_uint32),
        ("flags", c_uint32),
        ("r", Rect),
        ("reserved", c_uint32 * 9),
    )


class Timeval(Structure):
    """struct timeval."""

    _fields_ = (("tv_sec", c_int64), ("tv_usec", c_int64))


class Timecode(Structure):
    """struct v4l2_timecode."""

    _fields_ = (
        ("type", c_uint32),
        ("flags", c_uint32),
        ("frames", c_uint8),
        ("seconds", c_uint8),
        ("minutes", c_uint8),
        ("hours", c_uint8),
        ("userbits", c_uint8 * 4),
    )


class _BufferMemory(Union):
    _fields_ = (("offset", c_uint32), ("userptr", c_uint64), ("planes", c_void_p), ("fd", c_int32))


class _PlaneMemory(Union):
    _fields_ = (("mem_offset", c_uint32), ("userptr", c_uint64), ("fd", c_int32))


class BufferPlane(Structure):
    """struct v4l2_plane."""

    _fields_ = (
        ("bytesused", c_uint32),
        ("length", c_uint32),
        ("m", _PlaneMemory),
        ("data_offset", c_uint32),
        ("reserved", c_uint32 * 11),
    )


class Buffer(Structure):
    """struct v4l2_buffer."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("timestamp", Timeval),
        ("timecode", Timecode),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _BufferMemory),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    )


class QueryExtCtrl(Structure):
    """struct v4l2_query_ext_ctrl."""

    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int64),
        ("maximum", c_int64),
        ("step", c_uint64),
        ("default_value", c_int64),
        ("flags", c_uint32),
        ("elem_size", c_uint32),
        ("elems", c_uint32),
        ("nr_of_dims", c_uint32),
        ("dims", c_uint32 * 4),
        ("reserved", c_uint32 * 32),
    )


class _ExtControlValue(Union):
    _pack_ = 1
    _fields_ = (("value", c_int32), ("value64", c_int64), ("pointer", c_void_p))


class ExtControl(Structure):
    """struct v4l2_ext_control, which is packed."""

    _pack_ = 1
    _fields_ = (
        ("id", c_uint32),
        ("size", c_uint32),
        ("reserved2", c_uint32),
        ("u", _ExtControlValue),
    )


class ExtControls(Structure):
    """struct v4l2_ext_controls."""

    _fields_ = (
        ("which", c_uint32),
        ("count", c_uint32),
        ("error_idx", c_uint32),
        ("request_fd", c_int32),
        ("reserved", c_uint32),
        ("controls", ctypes.POINTER(ExtControl)),
    )


class _MenuEntry(Union):
    _pack_ = 1
    _fields_ = (("name", c_char * 32), ("value", c_int64))


class QueryMenu(Structure):
    """struct v4l2_querymenu, which is packed."""

    _pack_ = 1
    _fields_ = (("id", c_uint32), ("index", c_uint32), ("u", _MenuEntry), ("reserved", c_uint32))


_WRITE, _READ = 1, 2


def _request(direction: int, number: int, size: int) -> int:
    """An ioctl request number as asm-generic/ioctl.h composes it, of the kernel's group 'V'."""
    return direction << 30 | size << 16 | ord("V") << 8 | number


def _both(number: int, structure: type[Structure]) -> int:
    return _request(_READ | _WRITE, number, ctypes.sizeof(structure))


VIDIOC_QUERYCAP = _request(_READ, 0, ctypes.sizeof(Capability))
VIDIOC_ENUM_FMT = _both(2, FmtDesc)
VIDIOC_G_FMT = _both(4, Format)
VIDIOC_S_FMT = _both(5, Format)
VIDIOC_REQBUFS = _both(8, RequestBuffers)
VIDIOC_QUERYBUF = _both(9, Buffer)
VIDIOC_QBUF = _both(15, Buffer)
VIDIOC_DQBUF = _both(17, Buffer)
VIDIOC_STREAMON = _request(_WRITE, 18, ctypes.sizeof(c_int32))
VIDIOC_STREAMOFF = _request(_WRITE, 19, ctypes.sizeof(c_int32))
VIDIOC_G_PARM = _both(21, StreamParm)
VIDIOC_S_PARM = _both(22, StreamParm)
VIDIOC_QUERYMENU = _both(37, QueryMenu)
VIDIOC_G_EXT_CTRLS = _both(71, ExtControls)
VIDIOC_S_EXT_CTRLS = _both(72, ExtControls)
VIDIOC_ENUM_FRAMESIZES = _both(74, FrmSizeEnum)
VIDIOC_ENUM_FRAMEINTERVALS = _both(75, FrmIvalEnum)
VIDIOC_G_SELECTION = _both(94, Selection)
VIDIOC_QUERY_EXT_CTRL = _both(103, QueryExtCtrl)


def fourcc(code: str) -> int:
    """Return the number of a four-character format code; shorter codes are filled with spaces."""
    return int.from_bytes(code.ljust(4).encode("ascii"), "little")


def fourcc_text(number: int) -> str:
    """Return the code of a format number as people write it: bit 31 (big-endian) as ``-BE``."""
    text = (number & 0x7FFFFFFF).to_bytes(4, "little").decode("ascii", "replace").rstrip()
    return f"{text}-BE" if number & 0x80000000 else text

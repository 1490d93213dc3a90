"""The kernel's interface to cameras, as C lays it out: structures, request numbers, constants.

Source: include/uapi/linux/videodev2.h and v4l2-controls.h, which the kernel promises not to change. Only what
capture needs, in one plane or several. Layouts are those of 64-bit Linux (x86-64 and aarch64 agree).
"""

from __future__ import annotations

import ctypes
from ctypes import Structure, Union
from typing import Any

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


_TYPES: dict[str, Any] = {
    "u8": ctypes.c_uint8, "u16": ctypes.c_uint16, "u32": ctypes.c_uint32, "u64": ctypes.c_uint64,
    "s32": ctypes.c_int32, "s64": ctypes.c_int64, "char": ctypes.c_char, "void*": ctypes.c_void_p,
}  # fmt: skip


def _laid_out(name: str, declarations: str, base: type = Structure, packed: bool = False) -> type[Structure]:
    """Return a structure or union of C's declarations, such as ``u32 index; char name[32]``."""
    fields = []
    for declaration in declarations.split(";"):
        kind, _, names = declaration.strip().partition(" ")
        for one in names.split(","):
            field, _, count = one.strip().removesuffix("]").partition("[")
            fields.append((field, _TYPES[kind] * int(count) if count else _TYPES[kind]))
    members = {"_fields_": fields, "__doc__": f"struct v4l2_{name}.", **({"_pack_": 1} if packed else {})}
    made: type[Structure] = type(name, (base,), members)
    _TYPES[name] = made
    return made


Capability = _laid_out(
    "capability",
    "char driver[16], card[32], bus_info[32]; u32 version, capabilities, device_caps, reserved[3]",
)
FmtDesc = _laid_out(
    "fmtdesc", "u32 index, type, flags; char description[32]; u32 pixelformat, mbus_code, reserved[3]"
)
Fract = _laid_out("fract", "u32 numerator, denominator")
# ``sizes``: width and height, or min, max, step of both; ``intervals``: one, or min, max and step
FrmSizeEnum = _laid_out("frmsizeenum", "u32 index, pixel_format, type, sizes[6], reserved[2]")
FrmIvalEnum = _laid_out(
    "frmivalenum", "u32 index, pixel_format, width, height, type; fract intervals[3]; u32 reserved[2]"
)
PixFormat = _laid_out(
    "pix_format",
    "u32 width, height, pixelformat, field, bytesperline, sizeimage, colorspace, priv, flags, ycbcr_enc,"
    "quantization, xfer_func",
)
PlanePixFormat = _laid_out("plane_pix_format", "u32 sizeimage, bytesperline; u16 reserved[6]", packed=True)
PixFormatMplane = _laid_out(
    "pix_format_mplane",
    f"u32 width, height, pixelformat, field, colorspace; plane_pix_format plane_fmt[{MAX_PLANES}];"
    "u8 num_planes, flags, ycbcr_enc, quantization, xfer_func, reserved[7]",
    packed=True,
)
# v4l2_window holds pointers, which align the union to 8
_laid_out("format_fmt", "pix_format pix; pix_format_mplane pix_mp; u8 raw[200]; u64 align", Union)
Format = _laid_out("format", "u32 type; format_fmt fmt")
CaptureParm = _laid_out(
    "captureparm",
    "u32 capability, capturemode; fract timeperframe; u32 extendedmode, readbuffers, reserved[4]",
)
_laid_out("streamparm_parm", "captureparm capture; u8 raw[200]", Union)
StreamParm = _laid_out("streamparm", "u32 type; streamparm_parm parm")
RequestBuffers = _laid_out("requestbuffers", "u32 count, type, memory, capabilities; u8 flags, reserved[3]")
Rect = _laid_out("rect", "s32 left, top; u32 width, height")
Selection = _laid_out("selection", "u32 type, target, flags; rect r; u32 reserved[9]")
_laid_out("timeval", "s64 tv_sec, tv_usec")
Timecode = _laid_out("timecode", "u32 type, flags; u8 frames, seconds, minutes, hours, userbits[4]")
_laid_out("plane_m", "u32 mem_offset; u64 userptr; s32 fd", Union)
BufferPlane = _laid_out("plane", "u32 bytesused, length; plane_m m; u32 data_offset, reserved[11]")
_laid_out("buffer_m", "u32 offset; u64 userptr; void* planes; s32 fd", Union)
Buffer = _laid_out(
    "buffer",
    "u32 index, type, bytesused, flags, field; timeval timestamp; timecode timecode; u32 sequence, memory;"
    "buffer_m m; u32 length, reserved2; s32 request_fd",
)
QueryExtCtrl = _laid_out(
    "query_ext_ctrl",
    "u32 id, type; char name[32]; s64 minimum, maximum; u64 step; s64 default_value;"
    "u32 flags, elem_size, elems, nr_of_dims, dims[4], reserved[32]",
)
_laid_out("ext_control_value", "s32 value; s64 value64; void* pointer", Union, packed=True)
ExtControl = _laid_out("ext_control", "u32 id, size, reserved2; ext_control_value u", packed=True)
_TYPES["ext_control*"] = ctypes.POINTER(ExtControl)
ExtControls = _laid_out(
    "ext_controls", "u32 which, count, error_idx; s32 request_fd; u32 reserved; ext_control* controls"
)
_laid_out("querymenu_name", "char name[32]; s64 value", Union, packed=True)
QueryMenu = _laid_out("querymenu", "u32 id, index; querymenu_name u; u32 reserved", packed=True)


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
VIDIOC_STREAMON = _request(_WRITE, 18, ctypes.sizeof(ctypes.c_int32))
VIDIOC_STREAMOFF = _request(_WRITE, 19, ctypes.sizeof(ctypes.c_int32))
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

"""The kernel's structures and request numbers, against what a C compiler makes of videodev2.h on x86-64."""

from __future__ import annotations

import ctypes

from drivers.v4l2 import abi

SIZES = {
    "Capability": 104,
    "FmtDesc": 64,
    "FrmSizeEnum": 44,
    "FrmIvalEnum": 52,
    "PixFormat": 48,
    "PlanePixFormat": 20,
    "PixFormatMplane": 192,
    "BufferPlane": 64,
    "Format": 208,
    "CaptureParm": 40,
    "StreamParm": 204,
    "RequestBuffers": 20,
    "Rect": 16,
    "Selection": 64,
    "Timecode": 16,
    "Buffer": 88,
    "QueryExtCtrl": 232,
    "ExtControl": 20,
    "ExtControls": 32,
    "QueryMenu": 44,
}
REQUESTS = {
    "VIDIOC_QUERYCAP": 0x80685600,
    "VIDIOC_ENUM_FMT": 0xC0405602,
    "VIDIOC_G_FMT": 0xC0D05604,
    "VIDIOC_S_FMT": 0xC0D05605,
    "VIDIOC_REQBUFS": 0xC0145608,
    "VIDIOC_QUERYBUF": 0xC0585609,
    "VIDIOC_QBUF": 0xC058560F,
    "VIDIOC_DQBUF": 0xC0585611,
    "VIDIOC_STREAMON": 0x40045612,
    "VIDIOC_STREAMOFF": 0x40045613,
    "VIDIOC_G_PARM": 0xC0CC5615,
    "VIDIOC_S_PARM": 0xC0CC5616,
    "VIDIOC_QUERYMENU": 0xC02C5625,
    "VIDIOC_G_EXT_CTRLS": 0xC0205647,
    "VIDIOC_S_EXT_CTRLS": 0xC0205648,
    "VIDIOC_ENUM_FRAMESIZES": 0xC02C564A,
    "VIDIOC_ENUM_FRAMEINTERVALS": 0xC034564B,
    "VIDIOC_G_SELECTION": 0xC040565E,
    "VIDIOC_QUERY_EXT_CTRL": 0xC0E85667,
}


def test_structures_are_as_large_as_in_c() -> None:
    assert {name: ctypes.sizeof(getattr(abi, name)) for name in SIZES} == SIZES


def test_requests_have_the_kernels_numbers() -> None:
    assert {name: number for name, number in vars(abi).items() if name.startswith("VIDIOC_")} == REQUESTS


def test_fields_lie_where_c_puts_them() -> None:
    buffer = abi.Buffer
    assert (buffer.timestamp.offset, buffer.sequence.offset, buffer.m.offset, buffer.length.offset) == (
        24,
        56,
        64,
        72,
    )
    assert abi.Format.fmt.offset == 8
    assert (abi.PixFormatMplane.plane_fmt.offset, abi.PixFormatMplane.num_planes.offset) == (20, 180)
    assert abi.BufferPlane.data_offset.offset == 16

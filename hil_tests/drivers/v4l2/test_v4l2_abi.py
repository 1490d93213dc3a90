"""The kernel's structures and request numbers, against what a C compiler makes of videodev2.h on x86-64."""

from __future__ import annotations

import ctypes

import pytest

from drivers.v4l2 import abi

SIZES = {
    "Capability": 104,
    "FmtDesc": 64,
    "FrmSizeEnum": 44,
    "FrmIvalEnum": 52,
    "PixFormat": 48,
    "PlanePixFormat": 20,
    "PixFormatMplane": 192,
    "Plane": 64,
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


@pytest.mark.parametrize(("structure", "size_bytes"), SIZES.items())
def test_a_structure_is_as_large_as_in_c(structure: str, size_bytes: int) -> None:
    assert ctypes.sizeof(getattr(abi, structure)) == size_bytes


@pytest.mark.parametrize(("request_name", "number"), REQUESTS.items())
def test_a_request_has_the_kernels_number(request_name: str, number: int) -> None:
    assert getattr(abi, request_name) == number


def test_every_request_is_among_those_that_are_checked() -> None:
    assert {name for name in vars(abi) if name.startswith("VIDIOC_")} == set(REQUESTS)


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
    assert abi.Plane.data_offset.offset == 16


def test_format_codes_are_the_kernels() -> None:
    assert abi.fourcc("YUYV") == 0x56595559
    assert abi.fourcc("Y10") == 0x20303159
    assert abi.fourcc("BYR2") == 0x32525942
    assert abi.fourcc_text(0x20303159) == "Y10"
    assert abi.fourcc_text(0xA0363159) == "Y16-BE"

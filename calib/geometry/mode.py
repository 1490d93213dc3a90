"""Modes of a camera: which pixels of its sensor its pictures show, and its calibration in another mode.

Drivers read the mode, mast files keep it with the calibration, and the daemon compares the two.

The center of the top-left pixel is (0, 0). So a crop that begins at (x, y) subtracts x; binning by n makes
u' = (u + 0.5)/n - 0.5, and a flip of a picture w pixels wide u' = w - 1 - u. Each is u' = s u + t along an
axis, hence H' = s H + t A and V' likewise for every model: a pixel is (H.q, V.q) / (A.q). One flip leaves
H x V against A, which is right: the picture is a mirror image.

The lens of OpenCV's families has the camera's axes, y of which is V's part across A. A flip of V turns these
axes by half a turn about A. Coefficients whose terms are even change their sign then.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from operator import index
from typing import Any, Literal, NamedTuple

import numpy as np

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.lenses.opencv import NAMES
from calib.geometry.parameters import parameter_names, parameter_part
from calib.geometry.rigid import FloatArray, tangents

FlipName = Literal["none", "horizontal", "vertical", "both"]
FLIPS: Mapping[FlipName, tuple[bool, bool]] = {
    "none": (False, False),
    "horizontal": (True, False),
    "vertical": (False, True),
    "both": (True, True),
}
"""Names of flips (left to right, upside down), in files and commands."""

EVEN = ("p1", "p2", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""Coefficients of OpenCV's that change their sign when the lens is turned by half a turn."""


class BadMode(CalibError):
    """A mode that a calibration cannot be carried over to."""

    code = "bad_mode"


@dataclass(frozen=True)
class Mode:
    """The changes of the calibrated picture, in this order.

    ``crop_px`` is (x, y, width, height) in calibrated pixels, None for all of it; ``binning`` and ``flip``
    are across and down.
    """

    crop_px: tuple[int, int, int, int] | None = None
    binning: tuple[int, int] = (1, 1)
    flip: tuple[bool, bool] = (False, False)

    def __str__(self) -> str:
        """It as text; empty for the calibrated mode itself."""
        parts = []
        if self.crop_px is not None:
            parts.append("crop {2}x{3} px from ({0}, {1})".format(*self.crop_px))
        if self.binning != (1, 1):
            parts.append("binning {}x{}".format(*self.binning))
        return ", ".join([*parts, *_flips(self.flip)])


@dataclass(frozen=True)
class SensorMode:
    """Which pixels of a sensor a camera's pictures show, as its driver reads it.

    ``size_px`` is (width, height) of the pictures, ``crop_px`` (x, y, width, height) of the sensor's part
    that makes one and ``sensor_px`` (width, height) of all that can be read, both in the sensor's pixels, and
    None if the driver does not report them. ``flip``: whether the camera turns its pictures (left to right,
    upside down). ValueError if the size is none, the crop is not inside the sensor, or one of the two is
    missing.
    """

    size_px: tuple[int, int]
    crop_px: tuple[int, int, int, int] | None = None
    sensor_px: tuple[int, int] | None = None
    flip: tuple[bool, bool] = (False, False)

    def __post_init__(self) -> None:
        try:
            width, height = (index(side) for side in self.size_px)
        except (TypeError, ValueError):
            width = height = 0
        if min(width, height) < 1:
            raise ValueError(f"size_px is {self.size_px!r}, expected (width, height) of 1 px and more")
        object.__setattr__(self, "size_px", (width, height))
        if self.crop_px is None or self.sensor_px is None:
            if self.crop_px is not None or self.sensor_px is not None:
                raise ValueError("crop_px and sensor_px are expected together")
            return
        x, y, width, height = self.crop_px
        across, down = self.sensor_px
        if min(x, y) < 0 or min(width, height) < 1 or x + width > across or y + height > down:
            raise ValueError(
                f"crop_px {list(self.crop_px)} is not inside the sensor's {across}x{down} px ([x, y, width, "
                "height] is expected)"
            )

    def __str__(self) -> str:
        part = "an unknown part of its sensor"
        if self.crop_px is not None and self.sensor_px is not None:
            part = "{2}x{3} px from ({0}, {1}) of {4}x{5} px".format(*self.crop_px, *self.sensor_px)
        return ", ".join([f"{part} as {self.size_px[0]}x{self.size_px[1]} px", *_flips(self.flip)])


def mode_between(then: SensorMode, now: SensorMode) -> Mode:
    """Return how pictures of one mode differ from those of another of the same camera.

    An unknown crop is treated as equal. Makers differ in the side from which the crop of a flipped picture
    is counted, so such a crop has to be in the middle. Raises BadMode if no crop, binning and flip of the
    former pictures makes the present ones.
    """
    flip = then.flip[0] != now.flip[0], then.flip[1] != now.flip[1]
    if then.crop_px is None or now.crop_px is None or then.sensor_px is None or now.sensor_px is None:
        if then.size_px != now.size_px:
            raise BadMode("which part of the sensor they show is not known")
        return Mode(flip=flip)
    if then.sensor_px != now.sensor_px:
        raise BadMode(
            "the camera has a sensor of {}x{} px where the calibrated one had {}x{} px".format(
                *now.sensor_px, *then.sensor_px
            )
        )
    begins, lengths, binnings = [], [], []
    for axis, side in enumerate("xy"):
        (then_begin, then_px), (begin, length) = then.crop_px[axis::2], now.crop_px[axis::2]
        middle = [2 * at + px == now.sensor_px[axis] for at, px in ((then_begin, then_px), (begin, length))]
        moved = flip[axis] or (then_begin, then_px) != (begin, length)
        if moved and (then.flip[axis] or now.flip[axis]) and not all(middle):
            raise BadMode(
                "the crop is not in the middle, and from which side of the sensor it counts in flipped "
                "pictures is the maker's choice"
            )
        # A calibrated pixel is then_px / size sensor pixels.
        size = then.size_px[axis]
        (at, at_left), (span, span_left) = (divmod(px * size, then_px) for px in (begin - then_begin, length))
        if at < 0 or (begin - then_begin + length) > then_px:
            raise BadMode(f"they show more of the sensor along {side} than was calibrated")
        if at_left or span_left:
            raise BadMode(f"their part of the calibrated picture begins or ends amid a pixel along {side}")
        by, rest = divmod(span, now.size_px[axis])
        if rest:
            raise BadMode(f"a scale of {now.size_px[axis] / span:.3g} along {side} is no binning")
        begins.append(at)
        lengths.append(span)
        binnings.append(by)
    crop = begins[0], begins[1], lengths[0], lengths[1]
    return Mode(None if crop == (0, 0, *then.size_px) else crop, (binnings[0], binnings[1]), flip)


def sensor_mode_after(then: SensorMode, mode: Mode) -> SensorMode | None:
    """Return the sensor's mode whose pictures are changed ones of another.

    None where that is not known: a crop of a flipped picture that is not in its middle (`mode_between`).
    """
    crop = mode.crop_px or (0, 0, *then.size_px)
    if crop == (0, 0, *then.size_px):
        mode = replace(mode, crop_px=None)
    size_px = crop[2] // mode.binning[0], crop[3] // mode.binning[1]
    flip = then.flip[0] != mode.flip[0], then.flip[1] != mode.flip[1]
    if then.crop_px is None or then.sensor_px is None:
        return SensorMode(size_px, flip=flip)
    x, y, width, height = (px * then.crop_px[2 + i % 2] // then.size_px[i % 2] for i, px in enumerate(crop))
    read = then.crop_px[0] + x, then.crop_px[1] + y, width, height
    after = SensorMode(size_px, read, then.sensor_px, flip)
    try:
        return after if mode_between(then, after) == mode else None
    except BadMode:
        return None


def flip_name(flip: tuple[bool, bool]) -> FlipName:
    """Return a flip's name, by `FLIPS`."""
    return next(name for name, one in FLIPS.items() if one == flip)


def _flips(flip: tuple[bool, bool]) -> list[str]:
    """A flip as text, if it is one."""
    sides = [side for side, on in zip(("horizontal", "vertical"), flip, strict=True) if on]
    return [f"flip {' and '.join(sides)}"] if sides else []


class PixelChange(NamedTuple):
    """u' = ``scale`` u + ``shift`` along x and y, and the new picture's (width, height)."""

    scale: tuple[float, float]
    shift: tuple[float, float]
    size_px: tuple[int, int]


def pixel_change(size_px: tuple[int, int], mode: Mode) -> PixelChange:
    """Return how a mode moves the pixels of a picture of ``size_px`` (width, height).

    Raises BadMode if the crop is not inside the picture, or binning does not divide it.
    """
    width, height = size_px
    x, y, *cropped = mode.crop_px or (0, 0, width, height)
    if min(x, y) < 0 or min(cropped) < 1 or x + cropped[0] > width or y + cropped[1] > height:
        raise BadMode(
            f"the crop of {cropped[0]}x{cropped[1]} px from ({x}, {y}) is not inside the calibrated "
            f"{width}x{height} px"
        )
    scale, shift, size = [], [], []
    for begin, length, by, flip, side in zip(
        (x, y), cropped, mode.binning, mode.flip, ("wide", "high"), strict=True
    ):
        if by < 1 or length % by:
            raise BadMode(
                f"binning by {by} does not divide a picture {length} px {side}; how the camera treats the "
                "pixels left over is not known"
            )
        new = length // by
        s, t = 1.0 / by, (0.5 - begin) / by - 0.5
        scale.append(-s if flip else s)
        shift.append(new - 1 - t if flip else t)
        size.append(new)
    return PixelChange((scale[0], scale[1]), (shift[0], shift[1]), (size[0], size[1]))


def in_mode(model: CameraModel, mode: Mode) -> tuple[CameraModel, FloatArray]:
    """Return a camera as it is in another mode, and how a step (p,) of it follows one of the former: (p, p).

    Raises BadMode as `pixel_change`.

    Examples
    --------
    >>> H, V = [500, 0, 319.5], [0, 500, 239.5]
    >>> camera = CameraModel("CAHV", (640, 480), C=[0, 0, 0], A=[0, 0, 1], H=H, V=V)
    >>> half, _ = in_mode(camera, Mode(binning=(2, 2)))
    >>> half.size_px, half.H.tolist()
    ((320, 240), [250.0, 0.0, 159.5])
    """
    change = pixel_change(model.size_px, mode)
    moved: dict[str, Any] = {}
    rates = np.eye(len(parameter_names(model.kind)))
    for letter, scale, shift in zip("HV", change.scale, change.shift, strict=True):
        moved[letter] = scale * getattr(model, letter) + shift * model.A
        part = parameter_part(model.kind, letter)
        rates[part, part] *= scale
        rates[part, parameter_part(model.kind, "A")] = shift * tangents(model.A).T
    if mode.flip[1] and "D" in model.letters:
        signs = _signs(model)
        moved["distortion"] = model.distortion * signs
        part = parameter_part(model.kind, "D")
        rates[part, part] *= signs
    return replace(model, size_px=change.size_px, **moved), rates


def _signs(model: CameraModel) -> FloatArray:
    """(n,): -1 for each coefficient that half a turn changes."""
    names = NAMES[: len(model.distortion)] if model.kind != "OPENCV_FISHEYE" else ()
    return np.array([-1.0 if name in EVEN else 1.0 for name in names] or [1.0] * len(model.distortion))

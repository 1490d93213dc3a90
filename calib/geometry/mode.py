"""A calibration carried over to another mode of its camera: a crop, binning or flip of its picture.

The center of the top-left pixel is (0, 0). So a crop that begins at (x, y) subtracts x; binning by n makes
u' = (u + 0.5)/n - 0.5, and a flip of a picture w pixels wide u' = w - 1 - u. Each is u' = s u + t along an
axis, hence H' = s H + t A and V' likewise for every model: a pixel is (H.q, V.q) / (A.q). One flip leaves
H x V against A, which is right: the picture is a mirror image.

The lens of OpenCV's families stands in the camera's axes, y of which is V's part across A. Where V is turned
over, these axes are turned by half a turn about A. Coefficients whose terms are even change their sign then,
and control points of splines, which stand around A, change their places and signs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import stored_covariance
from calib.geometry.lenses.opencv import NAMES
from calib.geometry.parameters import parameter_names, parameter_part
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, tangents
from calib.geometry.sensor_mode import BadMode, Mode, sensor_mode_after

EVEN = ("p1", "p2", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""Coefficients of OpenCV's that change their sign when the lens is turned by half a turn."""


@dataclass(frozen=True)
class PixelChange:
    """u' = ``scale`` u + ``shift`` along x and y, and the new picture's (width, height)."""

    scale: tuple[float, float]
    shift: tuple[float, float]
    size_px: tuple[int, int]

    def pixels(self, pixels_px: FloatArray) -> FloatArray:
        """Return where pixels (..., 2) of the calibrated picture are in the new one."""
        return np.asarray(pixels_px * np.array(self.scale) + np.array(self.shift))


def pixel_change(size_px: tuple[int, int], mode: Mode) -> PixelChange:
    """Return how a mode moves the pixels of a picture of ``size_px`` (width, height).

    Raises
    ------
    BadMode
        If the crop is not inside the picture, or binning does not divide it.
    """
    width, height = size_px
    x, y, *cropped = mode.crop_px or (0, 0, width, height)
    if min(x, y) < 0 or min(cropped) < 1 or x + cropped[0] > width or y + cropped[1] > height:
        raise BadMode(
            f"the crop of {cropped[0]}x{cropped[1]} px from ({x}, {y}) is not inside the calibrated "
            f"{width}x{height} px"
        )
    scale, shift, size = [], [], []
    for begin, length, by, flip, word in zip(
        (x, y), cropped, mode.binning, mode.flip, ("wide", "high"), strict=True
    ):
        if by < 1 or length % by:
            raise BadMode(
                f"binning by {by} does not divide a picture {length} px {word}; the camera's way with the "
                "pixels left over is not known"
            )
        new = length // by
        s, t = 1.0 / by, (0.5 - begin) / by - 0.5
        scale.append(-s if flip else s)
        shift.append(new - 1 - t if flip else t)
        size.append(new)
    return PixelChange((scale[0], scale[1]), (shift[0], shift[1]), (size[0], size[1]))


def in_mode(model: CameraModel, mode: Mode) -> CameraModel:
    """Return a camera as it is in another mode.

    Raises
    ------
    BadMode
        As `pixel_change`.

    Examples
    --------
    >>> H, V = [500, 0, 319.5], [0, 500, 239.5]
    >>> camera = CameraModel("CAHV", (640, 480), C=[0, 0, 0], A=[0, 0, 1], H=H, V=V)
    >>> half = in_mode(camera, Mode(binning=(2, 2)))
    >>> half.size_px, half.H.tolist()
    ((320, 240), [250.0, 0.0, 159.5])
    """
    change = pixel_change(model.size_px, mode)
    moved: dict[str, Any] = {
        letter: change.scale[axis] * vector + change.shift[axis] * model.A
        for axis, (letter, vector) in enumerate((("H", model.H), ("V", model.V)))
    }
    if mode.flip[1] and model.spline is not None:
        control = model.distortion.reshape(model.spline.rows, model.spline.columns, 2)
        moved["distortion"] = -control[::-1, ::-1].ravel()
    elif mode.flip[1] and model.free_lens is not None:
        moved["distortion"] = model.distortion * _signs(model)
    return replace(model, size_px=change.size_px, **moved)


def rig_in_mode(rig: Rig, camera: str, mode: Mode) -> Rig:
    """Return a rig one of whose cameras is in another mode, with its covariance and the sensor's mode.

    Of ``fit`` the covariance stays. Other figures there are of the calibrated picture and go.

    Raises
    ------
    BadMode, CalibError
        As `in_mode`, and if the covariance does not fit the rig.
    """
    before = rig.cameras[camera]
    model = in_mode(before.model, mode)
    fit: Mapping[str, Any] = {}
    if (known := stored_covariance(rig)) is not None:
        names = [f"cameras.{camera}.{name}" for name in parameter_names(model.kind)]
        rates = _rates(before.model, mode)
        whole = np.eye(len(known.names))
        at = {name: i for i, name in enumerate(known.names)}
        has = [i for i, name in enumerate(names) if name in at]
        place = [at[names[i]] for i in has]
        whole[np.ix_(place, place)] = rates[np.ix_(has, has)]
        covariance = whole @ known.covariance @ whole.T
        fit = {"parameters": list(known.names), "covariance": covariance.tolist()}
    sensor = None if before.sensor_mode is None else sensor_mode_after(before.sensor_mode, mode)
    after = replace(before, model=model, sensor_mode=sensor)
    return replace(rig, cameras={**rig.cameras, camera: after}, fit=fit)


def _rates(model: CameraModel, mode: Mode) -> FloatArray:
    """d new step / d step (p, p) of a camera's parameters: the change is linear in them."""
    change = pixel_change(model.size_px, mode)
    rates = np.eye(len(parameter_names(model.kind)))
    turn = parameter_part(model.kind, "A")
    for axis, letter in enumerate("HV"):
        part = parameter_part(model.kind, letter)
        rates[part, part] *= change.scale[axis]
        rates[part, turn] = change.shift[axis] * tangents(model.A).T
    if mode.flip[1] and "D" in model.letters:
        part = parameter_part(model.kind, "D")
        rates[part, part] *= _signs(model)
    return rates


def _signs(model: CameraModel) -> FloatArray:
    """(n,): -1 for each coefficient that half a turn changes."""
    names = NAMES[: len(model.distortion)] if model.kind != "OPENCV_FISHEYE" else ()
    return np.array([-1.0 if name in EVEN else 1.0 for name in names] or [1.0] * len(model.distortion))

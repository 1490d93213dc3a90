"""How far apart two models of one camera are, by where they project.

Parameters would not do: |A|, |O| and R0 are gauges, so that two models may agree in every pixel and in no
number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray

GRID = 5
"""Pixels of the comparison along each side of the image."""

RANGES_M = (1.0, 100.0)
"""Near and far range of the comparison, metres.

At 1 m a shift of 1 µm moves a pixel as much as a turn of 1 µrad. Labels of six digits round positions
and joint angles above 1 m and 1 rad to 2.9 µm and 2.9 µrad (one sigma), so these ranges weigh them as
they deserve.
"""


@dataclass(frozen=True, eq=False)
class ModelDifference:
    """How far one model of a camera is from another one, by where they project.

    Attributes
    ----------
    position_m
        (3,) the other's C minus the reference's, in their common frame.
    rotation_rad
        (3,) rotation vector that turns the reference's rays onto the other's, same frame.
    shift_px
        (n, 2) how far the other projects points far away from where the reference does, pixels of the other;
        infinite where it does not see what the reference sees.
    """

    position_m: FloatArray
    rotation_rad: FloatArray
    shift_px: FloatArray


def model_difference(reference: CameraModel, other: CameraModel) -> ModelDifference:
    """Return how far ``other`` is from ``reference`` (two models of one camera in one frame), by where
    they project.

    The rotation is the one that turns a grid of the reference's rays onto the other's best (Kabsch).
    Sizes may differ where one image is the other one binned.

    Raises
    ------
    ValueError
        If the two have fewer than two rays of the grid in common.
    """
    wanted_px = pixel_grid(other.size_px)
    rays, other_rays = reference.ray(pixel_grid(reference.size_px)), other.ray(wanted_px)
    px, valid = other.project(rays.origins_m + RANGES_M[1] * rays.directions)
    both = rays.valid & other_rays.valid
    if both.sum() < 2:
        raise ValueError(
            f"the two models have {int(both.sum())} of {len(both)} rays in common, at least 2 are expected"
        )
    rotation, _ = Rotation.align_vectors(other_rays.directions[both], rays.directions[both])
    shift_px = np.where(valid[:, None], px - wanted_px, np.inf)[both]
    return ModelDifference(other.C - reference.C, rotation.as_rotvec(), shift_px)


def with_one_lens(models: Sequence[CameraModel], lens: CameraModel) -> tuple[CameraModel, ...]:
    """Return ``lens`` put where each of the models stands, as given by its C, A and H.

    For models whose lens changes from one to the next (interpolated over temperature): what stays of them is
    position and orientation. It trusts parameters, so it holds within one calibration only: A means the same
    direction in two models only if their R0 is the same.
    """
    return tuple(lens.moved(model.pose @ lens.pose.inverse) for model in models)


def pixel_grid(size_px: tuple[int, int]) -> FloatArray:
    """Return (25, 2) pixels spread evenly over an image: the same places of the view for a binned image."""
    fractions = (np.arange(GRID) + 0.5) / GRID
    x, y = np.meshgrid(fractions * size_px[0] - 0.5, fractions * size_px[1] - 0.5)
    return np.stack([x.ravel(), y.ravel()], axis=-1)

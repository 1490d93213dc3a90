"""Which view a picture shows, by what it shares with an earlier one; the pictures are exact pinholes'."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Mast, Rig, RigCamera
from calib.matching.patch_search import HALF, Reduced, agreed_view, cut, found
from calib.matching.shown_view import Posed, shown_view
from hil_tests.calib.matching.textured_planes import Pinhole, TexturedPlane, picture, random_texture

FOCAL_PX, SIZE_PX = 420.0, (300, 226)
LEVEL = Pinhole(np.zeros(3), 0.0, 0.0, FOCAL_PX, SIZE_PX)
RIG = Rig("one eye on the axes", Mast(np.zeros(3), np.zeros(3)), {"eye": RigCamera("head", LEVEL.model)})
SAME_RAD = 1e-3
"""A pixel is 2.4 mrad."""


@cache
def wall(seed: int) -> TexturedPlane:
    return TexturedPlane(np.array([4.0, 0.0, 0.0]), np.array([-1.0, 0.1, 0.2]), random_texture(seed), 0.008)


def posed(told: tuple[float, float], shown: tuple[float, float] | None = None, seed: int = 1) -> Posed:
    """The picture of one view with the angles told for it; turning about its own C knows no parallax."""
    pan, tilt = shown or told
    camera = Pinhole(np.zeros(3), pan, tilt, FOCAL_PX, SIZE_PX)
    return Posed(picture(camera, wall(seed), samples=2, noise_dn=1.0), *told)


@pytest.mark.parametrize(
    ("shown", "verdict"),
    [((0.15, 0.08), "seen"), ((0.12, 0.11), "contradicted"), ((-0.2, -0.1), "contradicted")],
)
def test_the_shown_view_is_found_near_the_told_one_and_far_off(
    shown: tuple[float, float], verdict: str
) -> None:
    seen = shown_view(RIG, "eye", posed((0.0, 0.0)), posed((0.15, 0.08), shown))
    assert seen.verdict == verdict
    assert (seen.pan_rad, seen.tilt_rad) == pytest.approx(shown, abs=SAME_RAD)


FOLD = 1.05
"""A lens that bends so much that nothing farther from its axis than this slope is in its image's circle."""


class Barrel(Pinhole):
    """The same camera with a lens x' = x (1 - r² / (3 FOLD²)), which the pixels in the corners lie beyond."""

    def rays(self, pixels_px: NDArray[np.float64]) -> NDArray[np.float64]:
        offsets = (pixels_px - self.middle_px) / self.focal_px
        bent = np.linalg.norm(offsets, axis=-1, keepdims=True)
        slopes = np.linspace(0.0, FOLD, 4000)
        straight = np.interp(bent, slopes * (1 - slopes**2 / 3 / FOLD**2), slopes)
        straight += np.maximum(bent - 2 / 3 * FOLD, 0.0)  # corners show the wall too, but not where it is
        return super().rays(self.middle_px + self.focal_px * offsets * straight / np.maximum(bent, 1e-9))


def test_what_lies_beyond_the_circle_of_a_lens_has_no_say() -> None:
    views = {told: Barrel(np.zeros(3), *told, 220.0, SIZE_PX) for told in ((0.0, 0.0), (0.12, 0.11))}
    level = views[0.0, 0.0]
    matrix = np.array([[220.0, 0, level.middle_px[0]], [0, 220.0, level.middle_px[1]], [0, 0, 1]])
    distortion = [-1 / 3 / FOLD**2, 0.0, 0.0, 0.0, 0.0]
    model = CameraModel.of_matrix("OPENCV5", SIZE_PX, matrix, distortion, level.axes, np.zeros(3))
    assert not model.ray([[0.0, 0.0]]).valid.any()
    rig = replace(RIG, cameras={"eye": RigCamera("head", model)})
    before, after = (picture(view, wall(1), samples=2, noise_dn=1.0) for view in views.values())
    for told, verdict in (((0.12, 0.11), "seen"), ((0.15, 0.08), "contradicted")):
        seen = shown_view(rig, "eye", Posed(before, 0.0, 0.0), Posed(after, *told))
        assert seen.verdict == verdict
        assert (seen.pan_rad, seen.tilt_rad) == pytest.approx((0.12, 0.11), abs=SAME_RAD)


def test_a_picture_of_something_else_is_no_view_of_the_wall() -> None:
    seen = shown_view(RIG, "eye", posed((0.0, 0.0)), posed((0.15, 0.08), seed=2))
    assert seen.verdict == "unlike"
    assert np.isnan(seen.pan_rad)


def test_a_patch_is_found_where_the_picture_was_moved_to() -> None:
    earlier = Reduced.of(picture(LEVEL, wall(1), samples=2))
    later = Reduced(np.roll(earlier.grey, (-9, 13), (0, 1)), earlier.step)
    place = np.array([[120.0, 100.0]])
    [patch] = cut(earlier, place, np.eye(2)[None], place.astype(int), place)
    assert patch.shape == (2 * HALF + 1, 2 * HALF + 1)
    seen, score = found(patch, later, place[0].astype(int), np.array([20, 20]))
    np.testing.assert_allclose(seen, [133.0, 91.0], atol=0.03)
    assert score > 0.999


def test_the_sigma_of_an_agreed_view_is_how_far_it_scatters() -> None:
    """Six patches, each good to 0.35 px: the mean of what is told against what 3000 draws do."""
    rng, noise_px, draws = np.random.default_rng(4), 0.35, 3000
    rates = 400.0 * (np.eye(2) + 0.1 * rng.normal(size=(6, 2, 2)))
    off, told = [], []
    for _ in range(draws):
        view = agreed_view(
            np.zeros(2), rng.normal(0.0, noise_px, (6, 2)), rates, np.zeros((6, 2)), np.ones(6), 1, 6
        )
        assert view is not None
        if view.agreeing == 6:
            off.append(view.angles_rad)
            told.append(view.sigma_rad**2)
    assert len(off) > 0.8 * draws
    assert np.mean(told) / np.var(off) == pytest.approx(1.0, abs=0.05)

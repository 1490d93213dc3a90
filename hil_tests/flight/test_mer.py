"""Opportunity: what docs/evidence/validation.md reports, with room for other versions of the libraries."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from calib.geometry.mosaic import MosaicSurface, canvas_of
from calib.geometry.rigid import Rigid
from drivers.clock import ManualClock
from tools.against_others import stitching
from tools.flight.difference import model_difference

MODELS_MM, MODELS_MRAD = 0.003, 0.003
ACROSS_MEDIAN_PX, ACROSS_WORST_PX = 1.1, 2.0
TURNED_MEDIAN_PX = 0.12
POINTED_RMS_PX = 1.1
PAIRS = [(2, 3, 40), (3, 4, 15)]
"""Earlier and later frame, counted from 0, and how many features at least are matched."""


@pytest.fixture(scope="module")
def rover(mer: ModuleType, mer_folder: Path) -> Any:
    products = mer.labels(mer_folder)
    return mer.rig(mer.fit(products), products)


@pytest.fixture(scope="module")
def views(mer: ModuleType, mer_folder: Path, rover: Any) -> list[Any]:
    clock = ManualClock(50.0)
    return mer.views(mer.replay(mer_folder, clock), clock, rover)


@pytest.fixture(scope="module")
def carried(mer: ModuleType, views: list[Any]) -> dict[tuple[int, int], list[Any]]:
    return {(a, b): mer.carried_features(views[a], views[b])[1] for a, b, _ in PAIRS}


def test_the_papers_mast_reproduces_the_five_published_models(mer: ModuleType, mer_folder: Path) -> None:
    products = mer.labels(mer_folder)
    assert len(products) == 5
    for found in mer.fit(products).residuals:
        assert np.linalg.norm(found.position_m) * 1e3 < MODELS_MM
        assert np.linalg.norm(found.rotation_rad) * 1e3 < MODELS_MRAD


def test_four_models_predict_the_fifth(mer: ModuleType, mer_folder: Path) -> None:
    products = mer.labels(mer_folder)
    for index, product in enumerate(products):
        fitted = mer.fit([one for other, one in enumerate(products) if other != index])
        predicted = fitted.camera_in_rover(product.azimuth_measured_rad, product.elevation_measured_rad)
        found = model_difference(product.camera_model, predicted)
        assert np.linalg.norm(found.position_m) * 1e3 < MODELS_MM
        assert np.linalg.norm(found.rotation_rad) * 1e3 < MODELS_MRAD


def test_the_mast_is_where_the_label_says(rover: Any) -> None:
    """MAST_FRAME of the labels: origin (0.45729, 0.02605, -1.0962) m in the rover frame, untilted."""
    assert rover.mast.translation_m == pytest.approx([0.45729, 0.02605, -1.0962], abs=1e-5)
    assert rover.mast.rotation_rad[:2] == pytest.approx([0.0, 0.0], abs=1e-5)


@pytest.mark.parametrize(("a", "b", "least"), PAIRS)
def test_features_are_found_on_their_epipolar_lines(
    mer: ModuleType,
    views: list[Any],
    carried: dict[tuple[int, int], list[Any]],
    a: int,
    b: int,
    least: int,
) -> None:
    across = np.array([one.across_px for one in carried[a, b]])
    assert len(across) >= least
    assert np.median(np.abs(across)) < ACROSS_MEDIAN_PX
    assert np.abs(across).max() < ACROSS_WORST_PX
    _, left = mer.turned(views[a], views[b], carried[a, b])
    assert np.median(np.abs(left)) < TURNED_MEDIAN_PX


def test_a_camera_that_points_elsewhere_is_seen(
    mer: ModuleType, views: list[Any], carried: dict[tuple[int, int], list[Any]]
) -> None:
    """Three milliradians about the horizontal axis are 3.9 px down, most of it across the lines."""
    camera = views[3].camera
    horizontal = camera.H - (camera.H @ camera.A) * camera.A
    turned = mer.turned_about_itself(camera, 3e-3 * horizontal / np.linalg.norm(horizontal))
    before = np.array([one.across_px for one in carried[2, 3]])
    after = np.array(
        [mer.across_px(views[2].camera, one.pixel_px, turned, one.found_px) for one in carried[2, 3]]
    )
    assert 2.5 < np.median(np.abs(after - before)) < 4.0
    assert np.median(np.abs(after)) > 2 * ACROSS_MEDIAN_PX


@pytest.mark.parametrize(("a", "b", "least"), PAIRS)
def test_pointing_at_features_lands_within_a_pixel_or_so(
    mer: ModuleType,
    views: list[Any],
    carried: dict[tuple[int, int], list[Any]],
    rover: Any,
    a: int,
    b: int,
    least: int,
) -> None:
    done = [mer.rehearse(views[a], views[b], carried[a, b], i, rover) for i in range(len(carried[a, b]))]
    assert max(one.off_rad for one in done) < 1e-9
    assert mer.rms(np.array([one.residual_px for one in done])) < POINTED_RMS_PX


def test_a_picture_from_elsewhere_matches_nothing(mer: ModuleType, views: list[Any]) -> None:
    """The first frame in the third's place: no feature of the 4th may be found in it."""
    elsewhere = replace(views[2], image=views[0].image)
    _, found = mer.carried_features(elsewhere, views[3])
    assert len(found) <= 2


def test_a_mosaic_by_label_models_meets_across_the_parallax_better_than_stitching() -> None:
    cameras, pictures = stitching.flight_pictures()
    origin = Rigid(np.eye(3), np.mean([camera.C for camera in cameras], axis=0))
    canvas = canvas_of(cameras, origin, MosaicSurface.of("ground"))
    known, seams = stitching.ours(canvas, cameras, pictures)
    assert known["pictures"] == 5 and known["patches"] >= 6
    assert known["across_px"] < ACROSS_MEDIAN_PX
    assert stitching.opencv(pictures, seams)["pictures"] < 5, "two frames have too little in common for it"

"""Wrong dots told without a camera: named, and none of a good survey."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.adjust.gross import Outlier
from calib.adjust.noise import without_wrong
from calib.adjust.terms import image_terms
from calib.calibrate.paper import fit_paper
from calib.calibrate.starts.survey import station_poses
from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.survey.records import Survey
from calib.targets.boards import Dots
from hil_tests.support.sim_survey.blunders import with_fewer_dots, with_outlier_dots, with_scattered_dots
from hil_tests.support.sim_survey.survey import simulate_survey

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(ROOT / "configs/sim/rocky8.yaml").rig


def wrong_in(survey: Survey) -> tuple[dict[str, np.ndarray], tuple[Outlier, ...]]:
    """The wrong dots of all images, check images among them."""
    images, checks, _ = image_terms(survey, station_poses(survey).rover_from_board, [])
    clean, wrong = without_wrong([*images, *checks])
    return {t.name: ~t.keep for t in clean if not t.keep.all()}, wrong


@pytest.fixture(scope="module")
def good(rig: Rig) -> Survey:
    return simulate_survey(rig, 1)[0]


@pytest.mark.parametrize("seed", range(4))
def test_a_good_survey_loses_nothing(rig: Rig, seed: int) -> None:
    survey = simulate_survey(rig, seed)[0]
    assert wrong_in(survey) == ({}, ())


@pytest.mark.parametrize("camera", ["pancam_left", "navcam_right", "hazcam_left"])
@pytest.mark.parametrize("distance_px", [1.2, 4.0, 50.0])
def test_wrong_dots_are_named_and_taken_out(good: Survey, camera: str, distance_px: float) -> None:
    image = next(i.name for i in good.images if i.camera == camera and i.purpose != "check")
    spoiled, places = with_outlier_dots(good, image, 2, distance_px, np.random.default_rng(2))
    found, wrong = wrong_in(spoiled)
    assert {s.name for s in wrong} == {f"image {image} dot (row {r}, column {c})" for r, c in places}
    assert all(s.kind == "dot" and s.size == pytest.approx(distance_px, abs=0.6) for s in wrong)
    dots = spoiled.dots[image]
    out = zip(dots.rows[found[image]].tolist(), dots.columns[found[image]].tolist(), strict=True)
    assert list(found) == [image] and set(out) == set(places)


def test_a_shifted_image_is_not_its_matter(good: Survey) -> None:
    shifted = {n: replace(d, pixels_px=d.pixels_px + 3.0) for n, d in good.dots.items()}
    assert wrong_in(replace(good, dots=shifted))[1] == ()


def test_check_images_lose_theirs_too(good: Survey) -> None:
    check = next(i.name for i in good.images if i.purpose == "check")
    spoiled, places = with_outlier_dots(good, check, 2, 20.0, np.random.default_rng(2))
    assert {s.name for s in wrong_in(spoiled)[1]} == {
        f"image {check} dot (row {r}, column {c})" for r, c in places
    }


def test_of_few_dots_the_gross_ones_are_named_and_of_fewer_none(good: Survey) -> None:
    few = with_fewer_dots(good, 2)  # 25 an image, check images among them
    assert wrong_in(few)[1] == ()
    wrong, spoiled = set[str](), few
    for image in good.images:
        spoiled, places = with_scattered_dots(spoiled, image.name, 1, np.random.default_rng(image.row))
        wrong |= {f"image {image.name} dot (row {r}, column {c})" for r, c in places}
    assert {s.name for s in wrong_in(spoiled)[1]} == wrong
    fewer = {n: Dots(d.rows[:15], d.columns[:15], d.pixels_px[:15]) for n, d in spoiled.dots.items()}
    assert wrong_in(replace(good, dots=fewer))[1] == ()
    assert wrong_in(replace(good, dots={}))[1] == ()


def test_the_papers_fit_names_them_and_is_as_good_without(rig: Rig) -> None:
    cameras = {n: c for n, c in rig.cameras.items() if n.startswith("navcam")}
    navcams = replace(rig, cameras=cameras, stereo={"navcam": rig.stereo["navcam"]})
    survey = simulate_survey(navcams, 1)[0]
    image = next(i.name for i in survey.images if i.purpose == "mast")
    spoiled, places = with_outlier_dots(survey, image, 1, 50.0, np.random.default_rng(2))
    fit = fit_paper(spoiled)
    assert [o.name for o in fit.outliers] == [
        f"image {image} dot (row {places[0][0]}, column {places[0][1]})"
    ]
    clean = fit_paper(survey)
    for camera, rms in clean.rms_px.items():
        assert fit.rms_px[camera] == pytest.approx(rms, rel=0.02)

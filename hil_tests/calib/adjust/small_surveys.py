"""Small simulated surveys for tests, and pictures of them that went wrong.

The simulator's survey takes poses from SciPy's rotations and pixels from the true cameras: nothing of an
estimator makes it. It is truth from outside for every fit, and for the commands above them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from calib.geometry.rig import Rig
from calib.survey.records import Survey
from calib.targets.boards import Dots
from hil_tests.support.sim_survey.plan import PAPER_RINGS, Ring, SurveyPlan, SurveyTruth, rover_from_head
from hil_tests.support.sim_survey.survey import simulate_survey


def rings(boards: int, *pairs: str) -> tuple[Ring, ...]:
    """The paper's rings of some pairs, or of all, with so many boards each."""
    return tuple(replace(ring, boards=boards) for ring in PAPER_RINGS if not pairs or ring.pair in pairs)


def survey_of(rig: Rig, seed: int, plan: SurveyPlan | None = None, **changes: Any) -> Survey:
    """What a survey measures, by a plan (the paper's if not given) with some changes."""
    return simulate_survey(rig, seed, replace(plan or SurveyPlan(), **changes))[0]


def of_cameras(survey: Survey, *names: str) -> Survey:
    """The survey as it would be without the other cameras."""
    images = tuple(image for image in survey.images if image.camera in names)
    return replace(
        survey,
        cameras={name: survey.cameras[name] for name in names},
        stereo={pair: eyes for pair, eyes in survey.stereo.items() if set(eyes) <= set(names)},
        images=images,
        dots={image.name: survey.dots[image.name] for image in images},
    )


def held(made: tuple[Survey, SurveyTruth], joint: str, at_rad: float) -> Survey:
    """The survey with one joint held still, dots where its head cameras then see the boards."""
    survey, truth = made
    rng = np.random.default_rng(3)
    images, dots = [], {}
    for image in survey.images:
        image = replace(image, **dict[str, Any]({joint: at_rad}))
        model = truth.rig.cameras[image.camera].model
        assert image.pan_rad is not None and image.tilt_rad is not None
        head = rover_from_head(truth.rig.mast, image.pan_rad, image.tilt_rad)
        pose = head.inverse @ truth.rover_from_board[image.setup, image.placement]
        seen = survey.dots[image.name]
        at, valid = model.project(pose.points(survey.board.dots_in_board_m(seen.rows, seen.columns)))
        if valid.all() and (at > 3).all() and (at < np.array(model.size_px) - 4).all():
            images.append(image)
            noise = survey.sigma.dot_px * rng.standard_normal(at.shape)
            dots[image.name] = Dots(seen.rows, seen.columns, at + noise)
    places = {(image.setup, image.placement) for image in images}
    station = tuple(p for p in survey.station if p.kind != "tape" or (p.setup, p.placement) in places)
    return replace(survey, images=tuple(images), dots=dots, station=station)


def with_shifted_dots(
    survey: Survey, image: str, shift_px: ArrayLike, which: int | slice = slice(None)
) -> Survey:
    """The survey with some dots of an image, or all, found ``shift_px`` (2,) aside."""
    pixels = survey.dots[image].pixels_px.copy()
    pixels[which] += np.asarray(shift_px)
    return replace(survey, dots={**survey.dots, image: replace(survey.dots[image], pixels_px=pixels)})


def with_swapped_dots(survey: Survey, one: str, other: str) -> Survey:
    """The survey with two pictures filed under each other's names."""
    dots = survey.dots
    return replace(survey, dots={**dots, one: dots[other], other: dots[one]})

"""What goes wrong in surveys, on demand: each function returns the survey with one mistake in it.

A point, image or placement that the survey does not have raises KeyError.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from calib.geometry.rigid import FloatArray, Rigid
from calib.survey.records import StationKind, StationPoint, Survey, SurveyImage
from calib.targets.boards import Dots
from hil_tests.support.sim_survey.plan import SurveyTruth


def with_moved_tape(survey: Survey, setup: str, placement: str, tape: str, shift_m: ArrayLike) -> Survey:
    """Return the survey with a tape measured ``shift_m`` (3,) aside, station frame."""
    return _moved(survey, (setup, "tape", placement, tape), shift_m)


def with_wrong_prism(survey: Survey, setup: str, prism: str, shift_m: ArrayLike) -> Survey:
    """Return the survey with a prism measured ``shift_m`` (3,) aside."""
    return _moved(survey, (setup, "prism", "", prism), shift_m)


def with_swapped_boards(survey: Survey, setup: str, placement: str, other: str) -> Survey:
    """Return the survey with the tapes of two placements written down under each other's names."""
    names = {placement: other, other: placement}
    for name in names:
        if not any(p.kind == "tape" and (p.setup, p.placement) == (setup, name) for p in survey.station):
            raise KeyError(f"no tapes of placement {name} in set-up {setup}")
    station = tuple(
        replace(p, placement=names.get(p.placement, p.placement)) if p.setup == setup else p
        for p in survey.station
    )
    return replace(survey, station=station)


def with_outlier_dots(
    survey: Survey, image: str, count: int, distance_px: float, rng: np.random.Generator
) -> tuple[Survey, tuple[tuple[int, int], ...]]:
    """Return the survey with dots of an image found ``distance_px`` aside in any direction, and which.

    The returned pairs are their (row, column).
    """
    dots = survey.dots[image]
    chosen = rng.choice(len(dots.rows), count, replace=False)
    angle = rng.uniform(-np.pi, np.pi, count)
    aside_px = distance_px * np.column_stack([np.cos(angle), np.sin(angle)])
    return _found_elsewhere(survey, image, chosen, dots.pixels_px[chosen] + aside_px)


def with_fewer_dots(survey: Survey, every: int) -> Survey:
    """Return the survey with the dots of each ``every``-th row and column alone."""
    seen = {}
    for name, dots in survey.dots.items():
        stay = (dots.rows % every == 0) & (dots.columns % every == 0)
        seen[name] = replace(
            dots, rows=dots.rows[stay], columns=dots.columns[stay], pixels_px=dots.pixels_px[stay]
        )
    return replace(survey, dots=seen)


def with_scattered_dots(
    survey: Survey, image: str, count: int, rng: np.random.Generator
) -> tuple[Survey, tuple[tuple[int, int], ...]]:
    """Return the survey with dots found anywhere in an image, and which, as above."""
    row = next(i for i in survey.images if i.name == image)
    chosen = rng.choice(len(survey.dots[image].rows), count, replace=False)
    anywhere_px = rng.uniform(0.0, np.array(survey.cameras[row.camera].size_px) - 1.0, (count, 2))
    return _found_elsewhere(survey, image, chosen, anywhere_px)


def _found_elsewhere(
    survey: Survey, image: str, chosen: np.ndarray, pixels_px: FloatArray
) -> tuple[Survey, tuple[tuple[int, int], ...]]:
    """The survey with some dots of an image at other pixels, and the (row, column) of each."""
    dots = survey.dots[image]
    pixels = dots.pixels_px.copy()
    pixels[chosen] = pixels_px
    changed: Mapping[str, Dots] = {**survey.dots, image: replace(dots, pixels_px=pixels)}
    places = tuple((int(dots.rows[i]), int(dots.columns[i])) for i in chosen)
    return replace(survey, dots=changed), places


def with_slipped_joint(survey: Survey, joint: str, first: str, slip_rad: float) -> Survey:
    """Return the survey with a joint (``pan`` or ``tilt``) read ``slip_rad`` too high from an image on."""
    later = _from(survey, first)
    return _read_otherwise(survey, joint, lambda image, angle: angle + slip_rad * (image.name in later))


def with_drifting_joint(survey: Survey, joint: str, drift_rad: float) -> Survey:
    """Return the survey with a joint read too high by more and more, by ``drift_rad`` at the last image."""
    passed = _passed(survey)
    return _read_otherwise(survey, joint, lambda image, angle: angle + drift_rad * passed[image.name])


def with_encoder_errors(survey: Survey, joint: str, first_rad: complex, second_rad: complex) -> Survey:
    """Return the survey with a joint's readings off by two waves around the turn.

    A magnet off centre: the reading is the angle plus the real part of ``first_rad`` times e to the minus i
    angle, and of ``second_rad`` with twice the angle.
    """

    def read(_: SurveyImage, angle: float) -> float:
        return angle + float((first_rad * np.exp(-1j * angle) + second_rad * np.exp(-2j * angle)).real)

    return _read_otherwise(survey, joint, read)


def with_changed_focus(survey: Survey, camera: str, first: str, times: float) -> Survey:
    """Return the survey with a camera's picture ``times`` as large from one of its images on."""
    middle = (np.array(survey.cameras[camera].size_px) - 1) / 2
    later = _from(survey, first)
    changed = {
        image.name: replace(
            survey.dots[image.name],
            pixels_px=middle + times * (survey.dots[image.name].pixels_px - middle),
        )
        for image in survey.images
        if image.camera == camera and image.name in later
    }
    return replace(survey, dots={**survey.dots, **changed})


def with_drifting_focus(survey: Survey, camera: str, times: float) -> Survey:
    """Return the survey with a camera's picture larger and larger, ``times`` as large at the last image."""
    middle = (np.array(survey.cameras[camera].size_px) - 1) / 2
    passed = _passed(survey)
    dots = dict(survey.dots)
    for image in survey.images:
        if image.camera == camera:
            scale = 1 + (times - 1) * passed[image.name]
            seen = dots[image.name]
            dots[image.name] = replace(seen, pixels_px=middle + scale * (seen.pixels_px - middle))
    return replace(survey, dots=dots)


def with_moved_board(
    survey: Survey, truth: SurveyTruth, images: tuple[str, ...], shift_m: ArrayLike, turn_rad: ArrayLike
) -> Survey:
    """Return the survey with some images taken of a board that had moved by (3,) and (3,), board frame."""
    turn, shift = (np.asarray(v, dtype=np.float64) for v in (turn_rad, shift_m))
    move = Rigid(Rotation.from_rotvec(turn).as_matrix(), shift)
    dots = dict(survey.dots)
    for name in images:
        places = survey.board.dots_in_board_m(dots[name].rows, dots[name].columns)
        dots[name] = _seen_elsewhere(survey, truth, name, places, move.points(places))
    return replace(survey, dots=dots)


def with_bowed_board(survey: Survey, truth: SurveyTruth, bow_m: float) -> Survey:
    """Return the survey with a board bent about its y axis, its edges ``bow_m`` behind its middle."""
    half_m = (survey.board.columns - 1) / 2 * survey.board.spacing_m
    dots = dict(survey.dots)
    for name, seen in survey.dots.items():
        places = survey.board.dots_in_board_m(seen.rows, seen.columns)
        bent = places + np.outer(bow_m * (places[:, 0] / half_m) ** 2, [0.0, 0.0, 1.0])
        dots[name] = _seen_elsewhere(survey, truth, name, places, bent)
    return replace(survey, dots=dots)


def _passed(survey: Survey) -> dict[str, float]:
    """What part of the images was taken before each, 0 to 1."""
    return {image.name: k / max(len(survey.images) - 1, 1) for k, image in enumerate(survey.images)}


def _from(survey: Survey, first: str) -> set[str]:
    """The names of an image and those after it."""
    names = [image.name for image in survey.images]
    if first not in names:
        raise KeyError(f"no image {first}")
    return set(names[names.index(first) :])


def _read_otherwise(survey: Survey, joint: str, read: Callable[[SurveyImage, float], float]) -> Survey:
    """The survey with other readings of a joint."""

    def again(image: SurveyImage) -> SurveyImage:
        if image.pan_rad is None or image.tilt_rad is None:
            return image
        if joint == "pan":
            return replace(image, pan_rad=read(image, image.pan_rad))
        return replace(image, tilt_rad=read(image, image.tilt_rad))

    return replace(survey, images=tuple(map(again, survey.images)))


def _seen_elsewhere(
    survey: Survey, truth: SurveyTruth, image: str, was_m: FloatArray, is_m: FloatArray
) -> Dots:
    """An image's dots with their noise, had they been at other places (n, 3) of the board frame."""
    camera, camera_from_board = truth.camera_from_board(survey, image)
    before, after = (camera.project(camera_from_board.points(places))[0] for places in (was_m, is_m))
    dots = survey.dots[image]
    return replace(dots, pixels_px=dots.pixels_px + after - before)


def _moved(survey: Survey, key: tuple[str, StationKind, str, str], shift_m: ArrayLike) -> Survey:
    """The survey with one point of the station moved."""
    found = [p for p in survey.station if (p.setup, p.kind, p.placement, p.point) == key]
    if not found:
        raise KeyError(f"no {key[1]} {key[3]} in set-up {key[0]} {key[2]}".rstrip())

    def place(point: StationPoint) -> StationPoint:
        moved = point.position_m + np.asarray(shift_m, dtype=np.float64)
        return replace(point, position_m=moved) if point is found[0] else point

    return replace(survey, station=tuple(map(place, survey.station)))

"""Residuals of every measurement after a fit, the fit's uncertainty, and the directions it leaves open."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calib.adjust.adjustment import PAN_TILT, Adjustment
from calib.adjust.result import (
    Calibration,
    CheckExpected,
    Degenerate,
    FittedRig,
    ImageResiduals,
    rig_of,
)
from calib.adjust.terms import ImageTerm, lens_notes
from calib.adjust.unknowns import Estimate
from calib.geometry.covariance import landing_rates, pixel_rates
from calib.geometry.parameters import parameter_names, parameter_part
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, tangents
from calib.geometry.significance import Level, chance_of_sum, rare_sum
from calib.survey.records import Click, Survey

OPEN = 0.05
"""A direction is open if the data leave more than this part of how far it could be off at all (1 m, 1 rad,
one focal length)."""

SEEN_RAD = 0.05
"""A joint that moves less than this between the fitted images is called still."""

PART = 0.25
"""A parameter is named if it makes up at least this part of an open direction; the mast's a third of it."""

USUAL = ("O", "R", "E", "D")
"""Numbers of a camera of which what lenses are usually like decides, however little the data show of them."""


def image_residuals(
    survey: Survey,
    problem: Adjustment,
    state: Estimate,
    all_images: Sequence[ImageTerm],
    checks: Sequence[ImageTerm],
    scatter: Mapping[str, float] | None = None,
) -> tuple[ImageResiduals, ...]:
    """Return what remains of every image with dots; for a check image, the joint angles as read.

    ``all_images`` and ``checks`` are with stated sigmas, ``scatter`` by image what these count times.
    """
    used = {t.name: t.keep for t in problem.images}
    by_name = {i.name: i for i in survey.images}
    terms = [replace(t, keep=np.ones_like(t.keep)) for t in (*all_images, *checks)]
    found = []
    for term, off in zip(terms, problem.residuals(state, terms), strict=True):
        image = by_name[term.name]
        board, seen_from = state.rover_from_board[term.board], state.cameras[term.camera].C
        if term.attitude is not None:
            head = problem.head(state, [term])
            seen_from = head.rotation[0] @ seen_from + head.translation_m[0]
        towards = board.translation_m - seen_from
        range_m = float(np.linalg.norm(towards))
        found.append(
            ImageResiduals(
                term.name,
                term.camera,
                image.purpose,
                image.setup,
                image.placement,
                image.pan_rad,
                image.tilt_rad,
                term.rows,
                term.columns,
                term.pixels_px,
                off.reshape(-1, 2) * term.sigma_px[:, None],
                term.sigma_px,
                used.get(term.name, np.zeros(len(term.keep), dtype=bool)),
                range_m,
                float(np.arccos(np.clip(abs(board.rotation[:, 2] @ towards) / range_m, 0.0, 1.0))),
                (scatter or {}).get(term.name, 1.0),
            )
        )
    return tuple(found)


def fitted_fields(
    survey: Survey,
    problem: Adjustment,
    state: Estimate,
    covariance: FloatArray,
    images: tuple[ImageResiduals, ...],
    checks: Sequence[ImageTerm],
    kinds: Sequence[str],
    level: Level,
    notes: Iterable[str],
    widened: float = 1.0,
) -> dict[str, Any]:
    """Return the fields of a `FittedRig` that follow from a state and the covariance (p, p) of its unknowns.

    ``checks`` are the check images with sigmas as large as their dots scatter, ``kinds`` those of the
    unknowns that are the rig's numbers, whose covariance is ``widened`` by a factor.
    """
    rig, names = rig_of(survey, state), tuple(problem.values(state, *kinds))
    numbers = problem.of_kinds(*kinds)
    of_rig = widened * covariance[np.ix_(numbers, numbers)]
    sigma = sigma_by_key(rig, names, of_rig)
    unfitted = [(i.camera, i.residuals_px) for i in images if i.purpose == "check"]
    unfitted += [(camera, off) for _, camera, off in _check_clicks(survey, state)]
    return {
        "rig": rig,
        "parameter_names": names,
        "covariance": of_rig,
        "sigma": sigma,
        "rms_px": _rms((i.camera, i.residuals_px[i.used]) for i in images),
        "check_rms_px": _rms((camera, off[np.isfinite(off).all(axis=1)]) for camera, off in unfitted),
        "checks": _expected_checks(problem, state, covariance, checks, images, level),
        "images": images,
        "notes": (*notes, *lens_notes(rig, sigma)),
        "rover_from_board": state.rover_from_board,
    }


def station_fields(survey: Survey, problem: Adjustment, state: Estimate) -> dict[str, Any]:
    """Return the fields of a `Calibration` that a survey has beyond those of a fitted rig."""
    off = problem.residuals(state, problem.station)
    clicks = _check_clicks(survey, state)
    return {
        "estimate": np.array(list(problem.values(state, "mast", "camera").values())),
        "unseen_clicks": tuple(click for click, _, off in clicks if not np.isfinite(off).all()),
        "station": tuple((p, p.sigma_m * r) for p, r in zip(problem.station, off, strict=True)),
        "rover_from_station": state.rover_from_station,
        "prisms_in_rover_m": state.prisms_in_rover_m,
    }


def _check_clicks(survey: Survey, state: Estimate) -> Iterator[tuple[Click, str, FloatArray]]:
    """Each click on a check point with its camera and what it is off by (1, 2), pixels."""
    points = {(p.setup, p.point): p.position_m for p in survey.station if p.kind == "check"}
    by_name, rig = {i.name: i for i in survey.images}, rig_of(survey, state)
    for click in survey.clicks:
        image = by_name.get(click.image)
        if image is None or (image.setup, click.point) not in points or image.camera not in state.cameras:
            continue
        in_rover = state.rover_from_station[image.setup].points(points[image.setup, click.point])[None]
        camera = rig.camera_in_rover(image.camera, image.pan_rad or 0.0, image.tilt_rad or 0.0)
        pixel, valid = camera.project(in_rover)
        yield click, image.camera, np.where(valid[:, None], pixel, np.nan) - click.pixel_px


def _rms(parts: Iterable[tuple[str, FloatArray]]) -> dict[str, tuple[float, float]]:
    """The (x, y) rms of residuals (n, 2) by camera, of those that have any."""
    collected: dict[str, list[FloatArray]] = {}
    for camera, residual in parts:
        if len(residual):
            collected.setdefault(camera, []).append(residual)
    rms = {}
    for camera, residuals in collected.items():
        x, y = np.sqrt(np.mean(np.concatenate(residuals) ** 2, axis=0))
        rms[camera] = (float(x), float(y))
    return rms


def _expected_checks(
    problem: Adjustment,
    state: Estimate,
    covariance: FloatArray,
    checks: Sequence[ImageTerm],
    residuals: Sequence[ImageResiduals],
    level: Level,
) -> dict[str, CheckExpected]:
    """By camera what its check images are off by, and should be: their noise and the error of their
    prediction. Dots that have no pixel do not count; the largest allowed size is passed with the chance
    ``level``.
    """
    off_px = {image.name: image.residuals_px for image in residuals}
    terms = [replace(t, keep=np.asarray(np.isfinite(off_px[t.name]).all(axis=1))) for t in checks]
    terms = [t for t in terms if t.keep.any()]
    expected = {}
    for camera in dict.fromkeys(t.camera for t in terms):
        mine = [t for t in terms if t.camera == camera]
        weights = check_weights(problem, state, covariance, mine)
        off = np.concatenate([off_px[t.name][t.keep] for t in mine])
        expected[camera] = CheckExpected(
            float(np.sqrt(np.mean(off**2))),
            float(np.sqrt(weights.mean())),
            float(np.sqrt(rare_sum(level, weights) / len(weights))),
            chance_of_sum(float(np.sum(off**2)), weights),
        )
    return expected


def check_weights(
    problem: Adjustment, state: Estimate, covariance: FloatArray, terms: Sequence[ImageTerm]
) -> FloatArray:
    """Return what the squares of independent unit errors count in the sum of squares of a camera's check
    images, (m,), px², that have m numbers in all.

    All of them hang on one calibration and share its error; those of one board share that of its tapes, those
    of one standstill that of its reading. So the distribution of that sum is known
    (`calib.geometry.significance.chance_of_sum`).
    """
    exact = problem.exact()
    standstills = list(dict.fromkeys((t.pan_rad, t.tilt_rad, t.approach) for t in terms))
    by_all, by_readings, own_px = [], [], []
    for term, motions in zip(terms, exact.motions(state, terms), strict=True):
        sigma_px = np.repeat(term.sigma_px[term.keep], 2)[:, None]
        rates = np.zeros((len(sigma_px), len(covariance)))
        rates[:, motions.block.columns] = sigma_px * motions.block.jacobian
        readings = np.zeros((len(sigma_px), len(standstills), 2))
        if term.attitude is not None and problem.joint_rad > 0:
            at = standstills.index((term.pan_rad, term.tilt_rad, term.approach))
            readings[:, at] = sigma_px * problem.joint_rad * motions.head[:, PAN_TILT]
        by_all.append(rates)
        by_readings.append(readings.reshape(len(rates), -1))
        own_px.append(sigma_px)
    rates = np.concatenate(by_all)
    touched = rates.any(axis=0)
    values, vectors = np.linalg.eigh(covariance[np.ix_(touched, touched)])
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    shared = np.hstack([rates[:, touched] @ root, np.concatenate(by_readings)])
    together = np.linalg.svd(shared, compute_uv=False) ** 2
    weights = np.sort(np.concatenate(own_px)[:, 0] ** 2)[::-1]
    weights[: len(together)] += together
    return weights


def sigma_by_key(rig: Rig, names: Sequence[str], covariance: FloatArray) -> dict[str, Any]:
    """Return standard deviations under the mast file's keys; vectors get one per component.

    A number that was not fitted gets 0.
    """
    deviation = dict(zip(names, np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist(), strict=True))
    mast: dict[str, Any] = {
        key: [deviation.get(f"mast.{key}.{axis}", 0.0) for axis in "xyz"]
        for key in ("translation_m", "rotation_rad")
    }
    mast |= {key: deviation.get(f"mast.{key}", 0.0) for key in ("axis_offset_m", "axis_twist_rad")}
    at = {name: i for i, name in enumerate(names)}
    cameras: dict[str, Any] = {}
    for name, camera in rig.cameras.items():
        kind = camera.model.kind
        first = [at[one] for p in parameter_names(kind) if (one := f"cameras.{name}.{p}") in at]
        if not first:
            continue
        mine = covariance[np.ix_(first, first)]
        cameras[name] = {}
        for letter in dict.fromkeys(camera.model.letters):
            part = parameter_part(kind, letter)
            block = mine[part, part]
            if letter in "AO":
                on = tangents(camera.model.A if letter == "A" else camera.model.O)
                block = on.T @ block @ on
            spread = np.sqrt(np.maximum(np.diag(block), 0.0)).tolist()
            key = "distortion" if letter == "D" else letter
            cameras[name][key] = [0.0, *spread] if letter == "R" else spread
    return {"mast": mast, "cameras": cameras}


def pixel_covariance(
    calibration: FittedRig, camera: str, pan_rad: float, tilt_rad: float, points_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return predicted pixels (n, 2) of rover-frame points (n, 3), metres, and covariances (n, 2, 2), px².

    Points and joint angles are treated as exact; what has no pixel comes out as not-a-number.
    """
    rig, names = calibration.rig, calibration.parameter_names
    pixels, rates, _ = pixel_rates(rig, names, camera, pan_rad, tilt_rad, points_m)
    return pixels, np.einsum("nip,pq,njq->nij", rates, calibration.covariance, rates)


def pointing_covariance(
    calibration: Calibration,
    pair: tuple[str, str],
    pan_rad: float,
    tilt_rad: float,
    left_px: FloatArray,
    range_m: float,
) -> FloatArray:
    """Return the covariance (2, 2), px², of where a target lands that was clicked in a stereo pair, from the
    calibration alone.

    The target is ``range_m`` along the ray of ``left_px`` in the left image at the given joint angles. It is
    found by stereo with the calibrated rig, and the head is pointed so that it should land in the middle of
    the left image. Raises CalibError if the target is not seen by both cameras, or cannot be pointed at.
    """
    rig = calibration.rig
    rays = rig.camera_in_rover(pair[0], pan_rad, tilt_rad).ray(left_px)
    target = rays.origins_m + range_m * rays.directions
    by_rig, _ = landing_rates(rig, calibration.parameter_names, pair, pan_rad, tilt_rad, target)
    return np.asarray(by_rig @ calibration.covariance @ by_rig.T)


def open_parameters(
    names: Sequence[str], covariance: FloatArray, weak: FloatArray
) -> tuple[tuple[str, ...], ...]:
    """Return the directions that the data leave open, the worst first, each as the parameters it moves most.

    ``covariance`` (p, p) is of ``names`` with the weak knowledge (p,) of ``calib.adjust.solver.minimise``
    added: an unknown that the data do not see keeps a sigma of 1 m, 1 rad or one focal length.
    """
    scale = np.sqrt(weak)
    values, vectors = np.linalg.eigh(covariance * np.outer(scale, scale))
    found = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if np.sqrt(max(value, 0.0)) < OPEN:
            break
        size = np.abs(vector) * np.array([3.0 if n.startswith("mast.") else 1.0 for n in names])
        order = [i for i in np.argsort(-size) if size[i] >= PART] or [int(np.argmax(size))]
        found.append(tuple(names[i] for i in order))
    return tuple(found)


def open_directions(problem: Adjustment, covariance: FloatArray) -> tuple[Degenerate, ...]:
    """Return the directions of cameras and mast that a survey leaves open, each with a sentence.

    ``covariance`` (p, p) is of all the problem's numbers, with its weak knowledge added.
    """
    shown = [i for i in problem.of_kinds("camera", "mast") if problem.names[i].split(".")[-2] not in USUAL]
    names = [problem.names[i] for i in shown]
    found = open_parameters(names, covariance[np.ix_(shown, shown)], problem.weak[shown])
    return tuple(Degenerate(parts, _reason(problem, parts)) for parts in found)


def _reason(problem: Adjustment, parameters: Sequence[str]) -> str:
    """Why a direction is open, and what to measure."""
    what = f"the survey does not fix {in_english(parameters)}"
    head = [t for t in problem.images if t.attitude is not None and t.keep.any()]
    owners = {name.split(".")[0] for name in parameters}
    cameras = {name.split(".")[1] for name in parameters if name.startswith("cameras.")}
    if head and ("mast" in owners or cameras & {t.camera for t in head}):
        pan = np.ptp([t.pan_rad for t in head])
        tilt = np.ptp([t.tilt_rad for t in head])
        still = [n for n, moved in (("pan", pan), ("tilt", tilt)) if moved < SEEN_RAD]
        if still:
            return (
                f"{what}: {' and '.join(still)} hardly moved between the head images "
                f"(pan {np.degrees(pan):.1f}°, tilt {np.degrees(tilt):.1f}°); take images of purpose mast "
                f"over the range of {' and '.join(still)} that will be used"
            )
    if cameras:
        name = sorted(cameras)[0]
        boards = len({t.board for t in problem.images if t.camera == name and t.keep.any()})
        return (
            f"{what}: camera {name} sees {boards} boards; take more at two distances and over the whole image"
        )
    return f"{what}; take more images of purpose mast, spread over pan and tilt"


def in_english(parameters: Sequence[str]) -> str:
    """Return some parameters as a person says them."""
    named = dict[str, None]()
    for first, *rest in (parameter.split(".") for parameter in parameters):
        if first == "cameras":
            name = f"{rest[1]} of {rest[0]}"
        elif first == "mast":
            name = "the mast's " + " ".join(rest).replace("_m", "").replace("_rad", "").replace("_", " ")
        else:
            name = f"the {first}'s {rest[0].split('_')[0]}"
        named[name] = None
    return ", ".join([*named][:4]) + (" and more" if len(named) > 4 else "")

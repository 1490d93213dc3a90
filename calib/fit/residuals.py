"""What remains of every measurement after a fit, for people and for the report."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from calib.fit.adjustment import Adjustment, Estimate
from calib.fit.calibration import ImageResiduals, StationResidual
from calib.fit.terms import ImageTerm
from calib.mast.gimbal import gimbal
from calib.rigid import FloatArray
from calib.survey import Survey

Rms = dict[str, tuple[float, float]]


def image_residuals(
    survey: Survey,
    problem: Adjustment,
    state: Estimate,
    all_images: Sequence[ImageTerm],
    checks: Sequence[ImageTerm],
) -> tuple[ImageResiduals, ...]:
    """Return what remains of every image with dots; for a check image, the joint angles as read."""
    used = {t.name: t.keep for t in problem.images}
    by_name = {i.name: i for i in survey.images}
    found = []
    for term in (*all_images, *checks):
        image = by_name[term.name]
        keep = used.get(term.name)
        residual = residual_px(problem, state, term)
        centre, facing = _seen_from(problem, state, term)
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
                residual,
                term.sigma_px,
                np.zeros(len(residual), dtype=bool) if keep is None else keep,
                float(np.linalg.norm(centre)),
                float(np.arccos(np.clip(abs(facing @ centre) / np.linalg.norm(centre), 0.0, 1.0))),
            )
        )
    return tuple(found)


def residual_px(problem: Adjustment, state: Estimate, term: ImageTerm) -> FloatArray:
    """Return predicted less measured pixels (n, 2) of every dot of an image."""
    pixels, _ = state.cameras[term.camera].project(problem.in_camera(state, term))
    return np.asarray(pixels - term.pixels_px)


def _seen_from(problem: Adjustment, state: Estimate, term: ImageTerm) -> tuple[FloatArray, FloatArray]:
    """The board's centre from the camera's C, and its normal; rover-frame directions."""
    board = state.rover_from_board[term.board]
    centre = state.cameras[term.camera].C
    if term.attitude is not None:
        head = gimbal(state.mast, *problem.joints(state, term))
        centre = head.rotation @ centre + head.translation_m
    return board.translation_m - centre, board.rotation[:, 2]


def rms_by_camera(images: Iterable[ImageResiduals]) -> Rms:
    """Return the (x, y) rms of the fitted dots of each camera, pixels."""
    return _rms((i.camera, i.residuals_px[i.used]) for i in images if i.used.any())


def check_rms(survey: Survey, state: Estimate, images: Iterable[ImageResiduals]) -> Rms:
    """Return the (x, y) rms over check images and clicks of each camera, pixels: none was fitted."""
    parts = [(i.camera, i.residuals_px) for i in images if i.purpose == "check"]
    points = {(p.setup, p.point): p.position_m for p in survey.station if p.kind == "check"}
    by_name = {i.name: i for i in survey.images}
    for click in survey.clicks:
        image = by_name.get(click.image)
        if image is None or (image.setup, click.point) not in points or image.camera not in state.cameras:
            continue
        in_rover = state.rover_from_station[image.setup].points(points[image.setup, click.point])[None]
        if image.pan_rad is not None and image.tilt_rad is not None:
            head = gimbal(state.mast, image.pan_rad, image.tilt_rad)
            in_rover = (in_rover - head.translation_m) @ head.rotation
        pixel, _ = state.cameras[image.camera].project(in_rover)
        parts.append((image.camera, pixel - click.pixel_px))
    return _rms((camera, residual) for camera, residual in parts if np.isfinite(residual).all())


def _rms(parts: Iterable[tuple[str, FloatArray]]) -> Rms:
    """Collect residuals by camera."""
    collected: dict[str, list[FloatArray]] = {}
    for camera, residual in parts:
        collected.setdefault(camera, []).append(residual)
    rms = {}
    for camera, residuals in collected.items():
        x, y = np.sqrt(np.mean(np.concatenate(residuals) ** 2, axis=0))
        rms[camera] = (float(x), float(y))
    return rms


def station_residuals(problem: Adjustment, state: Estimate) -> tuple[StationResidual, ...]:
    """Return what remains of every prism and tape, metres in the rover frame."""
    return tuple(
        StationResidual(
            "prism" if p.board is None else "tape",
            p.setup,
            "" if p.board is None else p.board[1],
            p.point,
            problem.station_residual(state, p) * p.sigma_m,
            p.keep,
        )
        for p in problem.station
    )

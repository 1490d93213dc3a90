"""What check images, which were not fitted, should be off by: their noise and the error of their prediction.

All check images of a camera hang on one calibration and share its error; those of one board share that of its
tapes, those of one standstill that of its reading. So the sum of their squares is one of independent unit
errors by weights, and its distribution is known (`calib.geometry.significance.chance_of_sum`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.adjust.adjustment import PAN_TILT, Adjustment
from calib.adjust.result import CheckExpected, ImageResiduals
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import Estimate
from calib.geometry.rigid import FloatArray
from calib.geometry.significance import Level, chance_of_sum, rare_sum


def expected_checks(
    problem: Adjustment,
    state: Estimate,
    covariance: FloatArray,
    checks: Sequence[ImageTerm],
    residuals: Sequence[ImageResiduals],
    level: Level,
) -> dict[str, CheckExpected]:
    """Return by camera what its check images are off by, and should be.

    ``covariance`` (p, p) is of a fit's unknowns, ``checks`` have sigmas as large as their dots scatter,
    ``residuals`` are of all images; dots that have no pixel do not count. The largest allowed size is passed
    with the chance ``level``.
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
    images, (m,), px², that have m numbers in all."""
    exact = problem.with_huber(None).at_rest()
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

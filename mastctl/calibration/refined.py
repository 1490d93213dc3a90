"""From records of hand-offs to a mast file with corrected body cameras: proposed and judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calib.adjust.uncertainty import sigma_by_key
from calib.calibrate.body import (
    PRIOR_SHIFT_M,
    PRIOR_TURN_RAD,
    BodyPose,
    body_groups,
    corrected_covariance,
    corrected_rig,
    fit_body_pose,
)
from calib.errors import NoCorrection
from calib.files.mast_file import StoredRig
from calib.files.yaml_text import plain
from calib.geometry.covariance import stored_covariance
from calib.geometry.rig import Rig
from calib.matching.handoff import HandoffBias, MatchedHandoff, handoff_bias
from mastctl.calibration.run import made, picked, rounded_matrix
from mastctl.drift.handoffs import ReadLog

SHIFT_FIRST = (3, 4, 5, 0, 1, 2)
"""In files and on the terminal a correction is its shift, then its turn."""


def refine(mast: StoredRig, logs: Sequence[ReadLog]) -> tuple[dict[str, Any], Rig | NoCorrection]:
    """Return the record of a refinement as JSON, and the corrected rig, or why there is none.

    Hand-offs of this very mast file are used, each once. Of each body pair the record has the correction,
    significant or not, or why there is none; the rig has every significant correction, its covariance and
    provenance, with mast and head cameras untouched.

    Raises NoCorrection ``too_few``: the mast file has no camera on the body.
    """
    groups = body_groups(mast.rig)
    if not groups:
        raise NoCorrection("too_few", f"{mast.path} has no camera on the rover's body to correct")
    every: dict[tuple[Any, ...], MatchedHandoff] = {}
    for log in logs:
        for one in log.handoffs:
            every[(one.time, one.mast_digest, one.pair, *one.clicks_px.ravel().tolist())] = one
    handoffs = tuple(one for one in every.values() if one.mast_digest == mast.digest)
    poses: dict[str, BodyPose] = {}
    refusals: dict[str, NoCorrection] = {}
    for group, cameras in groups.items():
        try:
            poses[group] = fit_body_pose(mast.rig, cameras, handoffs)
        except NoCorrection as refusal:
            refusals[group] = refusal
    other_mast = len(every) - len(handoffs)
    record = {
        "mast_file": None,
        "former": {"path": str(mast.path), "digest": mast.digest},
        "corrections": {group: _pose_as_json(pose) for group, pose in poses.items()},
        "refusals": {group: {"code": one.code, "message": str(one)} for group, one in refusals.items()},
        "bias": [_bias_as_json(one) for one in handoff_bias(handoffs)],
        "handoffs": len(handoffs),
        "other_mast": other_mast,
    }
    significant = {group: pose for group, pose in poses.items() if pose.significant}
    if significant:
        return record, _corrected(mast, significant, logs)
    sentences = [f"{group}: {one}" for group, one in refusals.items()]
    sentences += [
        f"{group}: {len(pose.used.handoffs)} hand-offs show no correction: {pose.sigmas:.1f} sigma where 3 "
        "are needed"
        for group, pose in poses.items()
    ]
    if other_mast:
        sentences.append(f"{other_mast} hand-offs were made with another mast file")
    codes = [*(one.code for one in refusals.values()), "not_significant"]
    return record, NoCorrection(codes[0], "; ".join(sentences))


def _corrected(mast: StoredRig, significant: dict[str, BodyPose], logs: Sequence[ReadLog]) -> Rig:
    rig, known = mast.rig, stored_covariance(mast.rig)
    for pose in significant.values():
        known = None if known is None else corrected_covariance(rig, known, pose)
        rig = corrected_rig(rig, pose)
    corrections = {group: _pose_as_json(pose) for group, pose in significant.items()}
    by = {
        "cameras": [name for pose in significant.values() for name in pose.cameras],
        "records": [{"file": log.path.name, "digest": log.digest} for log in logs],
        "handoffs": {group: len(pose.used.handoffs) for group, pose in significant.items()},
    }
    fit = {**mast.rig.fit, "refined": corrections}  # the rest stays as its survey left it
    if known is not None:
        fit["covariance"] = rounded_matrix(known.covariance).tolist()
        fit["sigma"] = plain(sigma_by_key(rig, known.names, known.covariance))
    before = mast.rig.provenance.get("refined", [])
    former = {"former_file": mast.path.name, "former_digest": mast.digest}
    refined = [*(before if isinstance(before, list) else [before]), {**former, **by, **made()}]
    return replace(rig, fit=fit, provenance={**mast.rig.provenance, "refined": refined})


def _bias_as_json(bias: HandoffBias) -> dict[str, Any]:
    """A camera's mean offset as JSON."""
    return {
        **picked(bias, "source", "camera", "handoffs", "left_out", "sigmas", "sentence"),
        "offset_px": bias.offset_px.tolist(),
        "sigma_px": np.sqrt(np.diag(bias.covariance_px2)).tolist(),
    }


def _pose_as_json(pose: BodyPose) -> dict[str, Any]:
    """A correction as JSON or YAML; the shift is of the origin, the turn about it, rover axes."""
    return {
        **picked(pose, "cameras", "origin_m", "chance", "chi2_before", "chi2_after", "degrees_of_freedom"),
        "shift_m": pose.step[3:].tolist(),
        "turn_rad": pose.step[:3].tolist(),
        "covariance": rounded_matrix(pose.covariance[np.ix_(SHIFT_FIRST, SHIFT_FIRST)]).tolist(),
        "prior_sigma": {"shift_m": PRIOR_SHIFT_M, "turn_rad": PRIOR_TURN_RAD},
        "significant": pose.significant,
        "significance_sigmas": pose.sigmas,
        "handoffs": len(pose.used.handoffs),
        "outliers": [one.sentence for one in pose.outliers],
        "rms_px": {
            name: {"before": list(before), "after": list(after)}
            for name, (before, after) in pose.rms_px.items()
        },
        "directions_seen": pose.seen,
        "unseen": list(pose.unseen),
    }

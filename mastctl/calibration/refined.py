"""From records of hand-offs to a mast file with corrected body cameras: proposed and judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

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
from calib.geometry.covariance import stored_covariance
from calib.geometry.rig import Rig
from calib.matching.handoff import HandoffBias, MatchedHandoff, handoff_bias
from mastctl.calibration.mast_file import picked, rounded_matrix, save_new, with_correction
from mastctl.watch.handoffs import ReadLog

SHIFT_FIRST = (3, 4, 5, 0, 1, 2)
"""In files and on the terminal a correction is its shift, then its turn."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """What records of hand-offs say of a mast file.

    ``handoffs`` are those of this very mast file, each once; ``other_mast`` counts those that were made with
    another one. ``bias``: mean offset by camera. ``poses``, ``refusals``: by body pair the correction,
    significant or not, or why there is none.
    """

    mast: StoredRig
    logs: tuple[ReadLog, ...]
    handoffs: tuple[MatchedHandoff, ...]
    other_mast: int
    bias: tuple[HandoffBias, ...]
    poses: Mapping[str, BodyPose]
    refusals: Mapping[str, NoCorrection]

    @property
    def significant(self) -> dict[str, BodyPose]:
        """The corrections that are worth a new mast file."""
        return {group: pose for group, pose in self.poses.items() if pose.significant}

    def refusal(self) -> NoCorrection:
        """Return why there is no correction at all; the first body pair's code stands for all."""
        codes, sentences = [], []
        for group, why in self.refusals.items():
            codes.append(why.code)
            sentences.append(f"{group}: {why}")
        for group, pose in self.poses.items():
            codes.append("not_significant")
            sentences.append(
                f"{group}: {len(pose.used.handoffs)} hand-offs show no correction: {pose.sigmas:.1f} sigma "
                "where 3 are needed"
            )
        if self.other_mast:
            sentences.append(f"{self.other_mast} hand-offs were made with another mast file")
        return NoCorrection(codes[0], "; ".join(sentences))


def propose(mast: StoredRig, logs: Sequence[ReadLog]) -> Proposal:
    """Return what records of hand-offs say of a mast file's body cameras.

    Raises
    ------
    NoCorrection
        ``too_few``: the mast file has no camera on the body.
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
    return Proposal(
        mast, tuple(logs), handoffs, len(every) - len(handoffs), handoff_bias(handoffs), poses, refusals
    )


def save_refined(proposal: Proposal, out: Path) -> tuple[StoredRig, Path | None]:
    """Save the mast file with every significant correction; return it, and where ``out``'s former one is.

    Raises
    ------
    NoCorrection
        If there is none; nothing is written.
    BadFile
        If ``out`` cannot be written; it holds what it held before.
    """
    if not proposal.significant:
        raise proposal.refusal()
    return save_new(refined_rig(proposal), out)


def refined_rig(proposal: Proposal) -> Rig:
    """Return the rig with every significant correction, its covariance and its provenance.

    Mast and head cameras are untouched.
    """
    rig = proposal.mast.rig
    known = stored_covariance(rig)
    for pose in proposal.significant.values():
        known = None if known is None else corrected_covariance(rig, known, pose)
        rig = corrected_rig(rig, pose)
    corrections = {group: pose_as_json(pose) for group, pose in proposal.significant.items()}
    by = {
        "cameras": [name for pose in proposal.significant.values() for name in pose.cameras],
        "records": [{"file": log.path.name, "digest": log.digest} for log in proposal.logs],
        "handoffs": {g: len(p.used.handoffs) for g, p in proposal.significant.items()},
    }
    return with_correction(proposal.mast, rig, known, {"refined": corrections}, by)


def pose_as_json(pose: BodyPose) -> dict[str, Any]:
    """Return a correction as JSON or YAML; the shift is of the origin, the turn about it, rover axes.

    Its covariance is of the shift, then the turn.
    """
    return {
        **picked(pose, "cameras", "origin_m", "chance", "chi2_before", "chi2_after", "degrees_of_freedom"),
        "shift_m": pose.step[3:].tolist(),
        "turn_rad": pose.step[:3].tolist(),
        "covariance": rounded_matrix(pose.covariance[np.ix_(SHIFT_FIRST, SHIFT_FIRST)]).tolist(),
        "prior_sigma": {"shift_m": PRIOR_SHIFT_M, "turn_rad": PRIOR_TURN_RAD},
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

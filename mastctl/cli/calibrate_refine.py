"""``mastctl calibrate --refine``: a mast file corrected by hand-offs."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import Answer, CommandError, Shown, WrongUse, check_file

if TYPE_CHECKING:
    from calib.calibrate.body import BodyPose
    from calib.files.mast_file import StoredRig
    from mastctl.calibration.refined import Proposal


OUTLIERS_SHOWN = 20


def refine(args: argparse.Namespace) -> Answer:
    """Propose a correction as a new mast file; 1, and no file, if the hand-offs show none."""
    from calib.files.mast_file import load_rig
    from mastctl.calibration.refined import propose, save_refined
    from mastctl.watch.handoffs import read_log

    unused = {"--report": args.report, "--in-use": args.in_use, "--method": args.method, "--mast": args.mast}
    if given := [option for option, value in unused.items() if value is not None]:
        raise WrongUse(f"{given[0]} belongs to a survey; --refine corrects by hand-offs alone")
    _check_out(args.out, [args.survey, *args.refine])
    mast = load_rig(args.survey)
    for note in mast.notes:
        output.tell(note)
    proposal = propose(mast, [read_log(path) for path in args.refine])
    if not proposal.significant:
        refusal = proposal.refusal()
        if not args.json:
            output.show(args, Answer({}, _shown(proposal)))
        raise CommandError(
            refusal.code, f"{refusal}; nothing was written", detail=_document(proposal, None, None)
        )
    saved, previous = save_refined(proposal, args.out)
    shown = chain(_shown(proposal), _saved(proposal, saved, previous))
    return Answer(_document(proposal, saved, previous), shown)


def _check_out(out: Path, read: list[Path]) -> None:
    """Refuse to overwrite what is read: a proposal is a new file. Raises CommandError."""
    for path in read:
        if out.resolve() == path.resolve():
            raise WrongUse(f"--out {out} is what is read; name another file, for the proposal")
    check_file(out, "--out")


def _document(proposal: Proposal, saved: StoredRig | None, previous: Path | None) -> dict[str, Any]:
    from mastctl.calibration.refined import pose_as_json
    from mastctl.watch.handoffs import bias_record

    return {
        "mast_file": None
        if saved is None
        else {
            "path": str(saved.path),
            "digest": saved.digest,
            "previous": None if previous is None else str(previous),
        },
        "former": {"path": str(proposal.mast.path), "digest": proposal.mast.digest},
        "corrections": {
            group: {**pose_as_json(pose), "significant": pose.significant}
            for group, pose in proposal.poses.items()
        },
        "refusals": {
            group: {"code": why.code, "message": str(why)} for group, why in proposal.refusals.items()
        },
        "bias": [bias_record(one) for one in proposal.bias],
        "handoffs": len(proposal.handoffs),
        "other_mast": proposal.other_mast,
    }


def _shown(proposal: Proposal) -> Iterator[str | Shown]:
    """The corrections and the mean offsets, pair by pair."""
    from calib.calibrate.body import STEP_NAMES
    from mastctl.calibration.refined import SHIFT_FIRST

    for group, pose in proposal.poses.items():
        sigma = pose.covariance.diagonal() ** 0.5
        significance = f"{pose.sigmas:.1f} sigma ({'' if pose.significant else 'not '}significant)"
        yield Shown(
            f"{group} against the mast cameras: {significance}, {len(pose.used.handoffs)} hand-offs",
            ("about the pair's middle, rover axes", "correction", "sigma", "unit"),
            [
                (
                    STEP_NAMES[i],
                    f"{1e3 * pose.step[i]:+.2f}",
                    f"{1e3 * sigma[i]:.2f}",
                    "mrad" if i < 3 else "mm",
                )
                for i in SHIFT_FIRST
            ],
            _notes(pose),
        )
    yield from (one.sentence for one in proposal.bias)
    yield from (f"{group}: {why}" for group, why in proposal.refusals.items())
    if proposal.other_mast:
        yield f"{proposal.other_mast} hand-offs of another mast file were passed over"


def _notes(pose: BodyPose) -> list[str]:
    notes = [
        f"{camera}, found less predicted: {before[0]:.2f}, {before[1]:.2f} px rms before, "
        f"{after[0]:.2f}, {after[1]:.2f} px after"
        for camera, (before, after) in pose.rms_px.items()
    ]
    notes += [*pose.unseen, *(one.sentence for one in pose.outliers[:OUTLIERS_SHOWN])]
    if len(pose.outliers) > OUTLIERS_SHOWN:
        notes.append(f"and {len(pose.outliers) - OUTLIERS_SHOWN} more were not used, all named by --json")
    if pose.scale > 1.0:
        notes.append(f"the sigmas are widened by {pose.scale**0.5:.2f}, as the residuals require")
    if pose.cameras_apart is not None and pose.cameras_apart.sigmas > 3.0:
        x, y = pose.cameras_apart.offset_px
        notes.append(
            f"right and left camera differ by {x:+.2f}, {y:+.2f} px "
            f"({pose.cameras_apart.sigmas:.1f} sigma): no motion of the pair explains it. "
            "One camera or its model is off; survey the pair again"
        )
    return notes


def _saved(proposal: Proposal, saved: StoredRig, previous: Path | None) -> Iterator[str]:
    known = "is that after the correction" if "covariance" in saved.rig.fit else "is unknown, as before"
    corrected = ", ".join(name for pose in proposal.significant.values() for name in pose.cameras)
    yield f"proposed mast file: {saved.path} ({saved.digest[:12]}); {corrected} corrected"
    yield f"its covariance {known}"
    yield f"{proposal.mast.path} is as it was; a daemon uses the new one after 'mastctl rig mast use'"
    if previous is not None:
        yield f"kept from before: {previous}"

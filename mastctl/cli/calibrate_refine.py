"""``mastctl calibrate --refine``: a mast file corrected by hand-offs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output

if TYPE_CHECKING:
    from calib.calibrate.body import BodyPose
    from calib.files.mast_file import StoredRig
    from mastctl.calibration.refined import Proposal


OUTLIERS_SHOWN = 20


def run(args: argparse.Namespace) -> int:
    """Propose a correction as a new mast file; 1, and no file, if the hand-offs tell none."""
    from calib.files.mast_file import load_rig
    from mastctl.calibration.refined import propose, save_refined
    from mastctl.watch.handoffs import read_log

    unused = {"--report": args.report, "--in-use": args.in_use, "--method": args.method, "--mast": args.mast}
    if given := [option for option, value in unused.items() if value is not None]:
        raise output.WrongUse(f"{given[0]} belongs to a survey; --refine corrects by hand-offs alone")
    _check_out(args.out, [args.survey, *args.refine])
    mast = load_rig(args.survey)
    for note in mast.notes:
        output.tell(note)
    proposal = propose(mast, [read_log(path) for path in args.refine])
    if not proposal.significant:
        refusal = proposal.refusal()
        if not args.json:
            _show(proposal)
        raise output.CommandError(
            refusal.code, f"{refusal}; nothing was written", detail=_document(proposal, None, None)
        )
    saved, previous = save_refined(proposal, args.out)
    if args.json:
        output.print_json(_document(proposal, saved, previous))
    else:
        _show(proposal)
        _show_saved(proposal, saved, previous)
    return 0


def _check_out(out: Path, read: list[Path]) -> None:
    """Refuse to overwrite what is read: a proposal is a new file."""
    from mastctl.cli.output import check_file

    for path in read:
        if out.resolve() == path.resolve():
            raise output.WrongUse(f"--out {out} is what is read; name another file, for the proposal")
    check_file(out, "--out")


def _document(proposal: Proposal, saved: StoredRig | None, previous: Path | None) -> dict[str, Any]:
    from mastctl.calibration.refined import pose_told
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
            group: {**pose_told(pose), "significant": pose.significant}
            for group, pose in proposal.poses.items()
        },
        "refusals": {
            group: {"code": why.code, "message": str(why)} for group, why in proposal.refusals.items()
        },
        "bias": [bias_record(one) for one in proposal.bias],
        "handoffs": len(proposal.handoffs),
        "other_mast": proposal.other_mast,
    }


def _show(proposal: Proposal) -> None:
    """What the hand-offs say, pair by pair."""
    notes = [one.sentence for one in proposal.bias]
    if proposal.other_mast:
        notes.append(f"{proposal.other_mast} hand-offs of another mast file were passed over")
    for group, pose in proposal.poses.items():
        _show_pose(group, pose)
    for group, why in proposal.refusals.items():
        notes.append(f"{group}: {why}")
    if not proposal.poses:
        for note in notes:
            output.tell(note)
        return
    rows = [
        [camera, *(f"{x:.2f}, {y:.2f}" for x, y in sizes)]
        for pose in proposal.poses.values()
        for camera, sizes in pose.rms_px.items()
    ]
    title = "Found less predicted, rms x, y px"
    output.print_table(title, ["camera", "before", "after the correction"], rows, notes)


def _show_pose(group: str, pose: BodyPose) -> None:
    from calib.calibrate.body import STEP_NAMES
    from mastctl.calibration.refined import SHIFT_FIRST

    sigma = pose.covariance.diagonal() ** 0.5
    rows = [
        [STEP_NAMES[i], f"{1e3 * pose.step[i]:+.2f}", f"{1e3 * sigma[i]:.2f}", "mrad" if i < 3 else "mm"]
        for i in SHIFT_FIRST
    ]
    notes = [
        f"chi-square {pose.chi2_before:.0f} before, {pose.chi2_after:.0f} after, "
        f"{pose.degrees_of_freedom:.0f} degrees of freedom",
        *pose.unseen,
        *(one.sentence for one in pose.outliers[:OUTLIERS_SHOWN]),
    ]
    if len(pose.outliers) > OUTLIERS_SHOWN:
        notes.append(f"and {len(pose.outliers) - OUTLIERS_SHOWN} more were not used, all named by --json")
    if pose.scale > 1.0:
        notes.append(f"the sigmas are widened by {pose.scale**0.5:.2f}, as the residuals ask")
    if pose.cameras_apart is not None and pose.cameras_apart.sigmas > 3.0:
        x, y = pose.cameras_apart.offset_px
        notes.append(
            f"right and left camera differ by {x:+.2f}, {y:+.2f} px ({pose.cameras_apart.sigmas:.1f} sigma): "
            "no motion of the pair explains it. One camera or its model is off; survey the pair again"
        )
    words = f"{pose.sigmas:.1f} sigma ({'' if pose.significant else 'not '}significant)"
    output.print_table(
        f"{group} against the mast cameras: {words}, {len(pose.used.handoffs)} hand-offs",
        ["about the pair's middle, rover axes", "correction", "sigma", "unit"],
        rows,
        notes,
    )


def _show_saved(proposal: Proposal, saved: StoredRig, previous: Path | None) -> None:
    covariance = "covariance" in saved.rig.fit
    notes = [
        f"proposed mast file: {saved.path} ({saved.digest[:12]}); {proposal.mast.path} is as it was",
        "its covariance is that after the correction"
        if covariance
        else "it has no covariance, as the former file has none",
        "a daemon uses it after 'mastctl mast use' (docs/how-to/calibrate.md, Use the mast file)",
    ]
    notes += [f"kept from before: {previous}"] if previous is not None else []
    output.print_table(
        "Corrected", ["pair", "cameras"],
        [[group, ", ".join(pose.cameras)] for group, pose in proposal.significant.items()], notes,
    )  # fmt: skip

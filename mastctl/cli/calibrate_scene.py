"""``mastctl calibrate MAST.yaml --refine-scene RECORD``: a rig corrected by a still scene."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from mastctl.cli import output

if TYPE_CHECKING:
    from calib.calibrate.scene.fit import SceneFit
    from calib.files.mast_file import StoredRig
    from mastctl.calibration.scene import SceneProposal

OUTLIERS_SHOWN = 10


def run(args: argparse.Namespace) -> int:
    """Propose a correction as a new mast file; 1, and no file, if the pictures tell none that holds."""
    from calib.calibrate.scene.fit import JOINT_SIGMA_RAD
    from calib.files.mast_file import load_rig
    from mastctl.calibration.scene import propose_scene, save_scene
    from mastctl.cli.places import check_file

    unused = {"--report": args.report, "--in-use": args.in_use, "--method": args.method, "--mast": args.mast}
    if given := [option for option, value in unused.items() if value is not None]:
        raise output.WrongUse(f"{given[0]} belongs to a survey; --refine-scene corrects by pictures alone")
    for path in (args.survey, args.refine_scene):
        if args.out.resolve() == path.resolve():
            raise output.WrongUse(f"--out {args.out} is what is read; name another file, for the proposal")
    check_file(args.out, "--out")
    mast = load_rig(args.survey)
    for note in mast.notes:
        output.tell(note)
    sigma_rad = JOINT_SIGMA_RAD if args.joint_sigma_rad is None else args.joint_sigma_rad
    with output.waiting(args.json, f"looking for features in {args.refine_scene}"):
        proposal = propose_scene(mast, args.refine_scene, sigma_rad, args.camera)
    saved, previous = save_scene(proposal, args.out)
    if args.json:
        output.print_json(_document(proposal, saved, None if previous is None else str(previous)))
    else:
        _show(proposal, saved, sigma_rad)
    return 0


def _document(proposal: SceneProposal, saved: StoredRig, previous: str | None) -> dict[str, Any]:
    from mastctl.calibration.scene import scene_told

    return {
        "mast_file": {"path": str(saved.path), "digest": saved.digest, "previous": previous},
        "former": {"path": str(proposal.mast.path), "digest": proposal.mast.digest},
        "pictures": len(proposal.views),
        "other_mast": proposal.other_mast,
        **scene_told(proposal.fit),
    }


def _show(proposal: SceneProposal, saved: StoredRig, told_rad: float) -> None:
    """Corrections with their sigmas, what each term gained, and how the rest is predicted."""
    fit = proposal.fit
    sigma = fit.covariance.diagonal() ** 0.5
    rows = [
        [name, f"{1e3 * value:+.3f}", f"{1e3 * one:.3f}", _unit(name), "not seen" * (name in fit.unseen)]
        for name, value, one in zip(fit.names, fit.values, sigma, strict=True)
    ]
    notes = [f"{words}: {gain:.1f} sigma" for words, gain in fit.gains.items()]
    notes += [
        f"{len(fit.features)} features of {len(proposal.views)} pictures: {fit.rms_px[0]:.3f} px rms before, "
        f"{fit.rms_px[1]:.3f} after; {fit.median_px[0]:.3f} and {fit.median_px[1]:.3f} in the median",
        f"each rest's own angles would explain it down to {fit.rms_px[2]:.3f} px rms: the joints repeat to "
        f"{1e3 * fit.joint_sigma_rad:.2f} mrad{_scatter(fit, told_rad)}",
        f"pictures that had no part in the correction: {fit.predicted_px[0]:.3f} px rms before, "
        f"{fit.predicted_px[1]:.3f} after",
        *fit.outliers[:OUTLIERS_SHOWN],
    ]
    if len(fit.outliers) > OUTLIERS_SHOWN:
        notes.append(f"and {len(fit.outliers) - OUTLIERS_SHOWN} more were not used, all named by --json")
    if proposal.other_mast:
        notes.append(
            f"{proposal.other_mast} pictures were taken with another mast file; what joints read counts"
        )
    if fit.scale > 1.0:
        notes.append(f"the sigmas are widened by {fit.scale**0.5:.2f}, as the residuals ask")
    notes += [
        f"proposed mast file: {saved.path} ({saved.digest[:12]}); {proposal.mast.path} is as it was",
        "what pictures cannot tell, where the rover is and the joints' zero, stays as the former file has it",
    ]
    output.print_table("Corrected by the scene", ["number", "added", "sigma", "", ""], rows, notes)


def _unit(name: str) -> str:
    """What a number is told in."""
    return {"scale": "1/1000 of the focal length", "r1": "1/1000"}.get(name.rpartition(".")[2], "mrad")


def _scatter(fit: SceneFit, told_rad: float) -> str:
    """What is to be said of how rests scatter."""
    return "" if fit.joint_sigma_rad <= told_rad else f", not to {1e3 * told_rad:.2f} as was told"

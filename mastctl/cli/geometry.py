"""Commands on a mast file alone, no rover needed: solve, triangulate, handoff; and the error budget."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.mast_files import camera_name, nearest_of, need_joints, read_mast_file, stereo_pair
from mastctl.cli.output import finite_number, positive_number

if TYPE_CHECKING:
    from calib.geometry.covariance import RigCovariance
    from calib.geometry.handoff import Handoff, Joints
    from calib.geometry.rig import Rig

MAST_HELP = "the mast file"
FROM_HELP = "present angle; solutions near it come first (default: 0)"
SIGMA_HELP = "one sigma of a click, each axis (default: 0.2)"


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add solve, triangulate, budget and handoff."""
    for add in (_add_geometry, _add_handoff):
        add(subparsers)


def _add_geometry(subparsers: Any) -> None:
    """Add the commands of this module to the parser's commands."""
    solve = subparsers.add_parser("solve", help="the true joint angles that bring a target onto a pixel")
    solve.add_argument("mast", type=Path, metavar="MAST.yaml", help=MAST_HELP)
    solve.add_argument("--camera", required=True, metavar="NAME", help="a camera on the head")
    solve.add_argument(
        "--target", required=True, nargs=3, type=finite_number, metavar=("X", "Y", "Z"), help="rover frame, m"
    )
    solve.add_argument(
        "--pixel", nargs=2, type=finite_number, metavar=("U", "V"), help="default: the image centre"
    )
    solve.add_argument("--from-pan", type=finite_number, default=0.0, metavar="RAD", help=FROM_HELP)
    solve.add_argument("--from-tilt", type=finite_number, default=0.0, metavar="RAD", help=FROM_HELP)
    solve.set_defaults(run=solve_pointing)

    triangulate = subparsers.add_parser(
        "triangulate", help="the point that a stereo pair sees, with covariance"
    )
    triangulate.add_argument("mast", type=Path, metavar="MAST.yaml", help=MAST_HELP)
    triangulate.add_argument(
        "--pair", required=True, metavar="NAME", help="a pair of the file's stereo section"
    )
    triangulate.add_argument("--pan", type=finite_number, metavar="RAD", help="true joint angle")
    triangulate.add_argument("--tilt", type=finite_number, metavar="RAD", help="true joint angle")
    for side in ("--left", "--right"):
        triangulate.add_argument(
            side,
            required=True,
            nargs=2,
            type=finite_number,
            metavar=("U", "V"),
            help=f"pixel in the {side[2:]} image",
        )
    triangulate.add_argument("--sigma-px", type=positive_number, default=0.2, metavar="PX", help=SIGMA_HELP)
    triangulate.set_defaults(run=triangulate_pair)

    budget = subparsers.add_parser("budget", help="the paper's error budget (Table I) from its formulas")
    budget.set_defaults(run=error_budget)


def solve_pointing(args: argparse.Namespace) -> int:
    """Solve for the joint angles that bring a target in the rover frame onto a pixel."""
    from calib.geometry.pointing import solve

    stored = read_mast_file(args.mast)
    camera = stored.rig.cameras[camera_name(stored, args.camera)]
    if camera.on != "head":
        raise output.WrongUse(
            f"camera '{args.camera}' is on the rover's body; a camera on the head is expected"
        )
    solutions = solve(
        stored.rig.mast,
        camera.model,
        args.target,
        args.pixel,
        from_pan_rad=args.from_pan,
        from_tilt_rad=args.from_tilt,
    )
    if args.json:
        keys = ("pan_rad", "tilt_rad", "range_m")
        output.print_json({"solutions": [{key: float(getattr(s, key)) for key in keys} for s in solutions]})
        return 0
    x, y = camera.model.image_center_px if args.pixel is None else args.pixel
    target = "(" + ", ".join(f"{value:g}" for value in args.target) + ")"
    output.print_table(
        f"{stored.rig.name}: target {target} m on pixel ({x:g}, {y:g}) of {args.camera}",
        ("pan rad", "tilt rad", "pan deg", "tilt deg", "range m"),
        [
            (
                f"{s.pan_rad:.9f}",
                f"{s.tilt_rad:.9f}",
                f"{math.degrees(s.pan_rad):.4f}",
                f"{math.degrees(s.tilt_rad):.4f}",
                f"{s.range_m:.6f}",
            )
            for s in solutions
        ],
        ["best first; the mast's limits belong to a configuration and are not looked at here"],
    )
    return 0


def triangulate_pair(args: argparse.Namespace) -> int:
    """Triangulate the point seen at a pixel of each camera of a pair, in the rover frame."""
    from calib.geometry.covariance import clicked_point, stored_covariance

    stored = read_mast_file(args.mast)
    rig, pair = stored.rig, stereo_pair(stored, args.pair)
    for name in pair:
        need_joints(rig, name, args)
    seen, gap = clicked_point(
        rig, pair, args.pan or 0.0, args.tilt or 0.0, args.left, args.right,
        sigma_px=args.sigma_px, calibration=stored_covariance(rig),
    )  # fmt: skip
    if args.json:
        output.print_json(
            {
                "position_m": seen.position_m.tolist(),
                "covariance_m2": seen.covariance_m2.tolist(),
                "ray_gap_m": seen.ray_gap_m,
            }
        )
        return 0
    sigmas_mm = [1e3 * math.sqrt(max(0.0, variance)) for variance in seen.covariance_m2.diagonal()]
    output.print_table(
        f"{rig.name}: the point that {args.pair} sees, in the rover frame",
        ("", "m", "sigma mm"),
        [
            (axis, f"{value:.6f}", f"{sigma:.3f}")
            for axis, value, sigma in zip("xyz", seen.position_m, sigmas_mm, strict=True)
        ],
        [
            f"ray gap {1e3 * seen.ray_gap_m:.3f} mm, {gap.sigmas:.1f} sigma; "
            f"sigma from {args.sigma_px:g} px in each pixel coordinate"
        ],
    )
    return 0


def error_budget(args: argparse.Namespace) -> int:
    """Compute the paper's Table I."""
    from calib.geometry.stereo import target_approach_budget

    rows = target_approach_budget()
    keys = ("stereo_cm", "untracked_cm", "tracked_cm")
    if args.json:
        output.print_json(
            {"cameras": [{"name": row.name, **{key: getattr(row, key) for key in keys}} for row in rows]}
        )
        return 0
    output.print_table(
        "Target approach from 10 m to 1 m, 3-sigma errors (Table I of the paper)",
        ("camera", "stereo cm", "untracked cm", "tracked cm"),
        [(row.name, *(f"{getattr(row, key):.2f}" for key in keys)) for row in rows],
    )
    return 0


def _add_handoff(subparsers: Any) -> None:
    """Add the command to the parser's commands."""
    handoff = subparsers.add_parser(
        "handoff", help="where a target seen by one stereo pair falls in another, with the ellipse to search"
    )
    handoff.add_argument("mast", type=Path, metavar="MAST.yaml", help=MAST_HELP)
    handoff.add_argument("--from", dest="source", required=True, metavar="PAIR", help="the pair that sees it")
    handoff.add_argument("--to", required=True, metavar="PAIR", help="a pair, or one camera")
    handoff.add_argument("--pan", type=finite_number, metavar="RAD", help="true joint angle")
    handoff.add_argument("--tilt", type=finite_number, metavar="RAD", help="true joint angle")
    for side in ("--left", "--right"):
        handoff.add_argument(
            side,
            required=True,
            nargs=2,
            type=finite_number,
            metavar=("U", "V"),
            help=f"pixel in the {side[2:]} image",
        )
    handoff.add_argument("--to-pan", type=finite_number, metavar="RAD", help="default: as --pan")
    handoff.add_argument("--to-tilt", type=finite_number, metavar="RAD", help="default: as --tilt")
    handoff.add_argument(
        "--point",
        action="store_true",
        help="turn the head first so that the target falls in the middle of --to",
    )
    handoff.add_argument("--sigma-px", type=positive_number, default=0.2, metavar="PX", help=SIGMA_HELP)
    handoff.add_argument(
        "--sigma-joint", type=positive_number, metavar="RAD", help="of a joint reading; default: exact"
    )
    handoff.set_defaults(run=hand_over)


def hand_over(args: argparse.Namespace) -> int:
    """Hand a target over, geometrically."""
    from calib.geometry.covariance import stored_covariance
    from calib.geometry.handoff import Joints, hand_off

    stored = read_mast_file(args.mast)
    rig, pair = stored.rig, stereo_pair(stored, args.source)
    if args.to not in rig.stereo and args.to not in rig.cameras:
        known = nearest_of(args.to, [*rig.stereo, *rig.cameras])
        raise output.WrongUse(f"no stereo pair or camera '{args.to}' in {args.mast}; {known}")
    to = rig.stereo.get(args.to, (args.to,))
    on_head = any(rig.cameras[name].on == "head" for name in (*pair, *to))
    if on_head and (args.pan is None or args.tilt is None):
        raise output.WrongUse("a camera is on the head; --pan RAD and --tilt RAD are expected")
    sigma = args.sigma_joint or 0.0
    joints = Joints(args.pan or 0.0, args.tilt or 0.0, sigma)
    calibration = stored_covariance(rig)
    done = hand_off(
        rig,
        pair,
        to,
        joints,
        args.left,
        args.right,
        to_joints=_destination(args, rig, pair, to[0], joints, calibration),
        sigma_px=args.sigma_px,
        calibration=calibration,
    )
    if args.json:
        output.print_json(_as_json(done))
    else:
        _print(args, rig, done)
    return 0


def _destination(
    args: argparse.Namespace,
    rig: Rig,
    pair: tuple[str, str],
    aim: str,
    joints: Joints,
    calibration: RigCovariance | None,
) -> Joints | None:
    """The joint angles of the destination images; None where the head does not turn."""
    from calib.geometry.covariance import clicked_point
    from calib.geometry.handoff import Joints
    from calib.geometry.pointing import solve

    if args.point:
        if args.to_pan is not None or args.to_tilt is not None:
            raise output.WrongUse("--point chooses the angles; leave --to-pan and --to-tilt out")
        if rig.cameras[aim].on != "head":
            raise output.WrongUse(f"--point: camera '{aim}' is on the rover's body and cannot be pointed")
        seen, _ = clicked_point(
            rig, pair, joints.pan_rad, joints.tilt_rad, args.left, args.right,
            sigma_px=args.sigma_px, sigma_rad=joints.sigma_rad, calibration=calibration,
        )  # fmt: skip
        best = solve(
            rig.mast,
            rig.cameras[aim].model,
            seen.position_m,
            from_pan_rad=joints.pan_rad,
            from_tilt_rad=joints.tilt_rad,
        )[0]
        return Joints(best.pan_rad, best.tilt_rad, joints.sigma_rad)
    pan = joints.pan_rad if args.to_pan is None else args.to_pan
    tilt = joints.tilt_rad if args.to_tilt is None else args.to_tilt
    if (pan, tilt) == (joints.pan_rad, joints.tilt_rad):
        return None
    return Joints(pan, tilt, joints.sigma_rad)


def _as_json(done: Handoff) -> dict[str, Any]:
    return {
        "pixels": {
            name: None
            if seen is None
            else {
                "x_px": float(seen.pixel_px[0]),
                "y_px": float(seen.pixel_px[1]),
                "covariance_px2": seen.covariance_px2.tolist(),
                "search_px2": seen.search_px2.tolist(),
            }
            for name, seen in done.pixels.items()
        },
        "reasons": dict(done.reasons),
        "position_m": done.seen.position_m.tolist(),
        "covariance_m2": done.covariance_m2.tolist(),
        "ray_gap_m": done.seen.ray_gap_m,
        "ray_gap_sigmas": done.gap.sigmas,
        "across_px": done.gap.across_px,
        "pan_rad": done.pan_rad,
        "tilt_rad": done.tilt_rad,
    }


def _print(args: argparse.Namespace, rig: Rig, done: Handoff) -> None:
    import numpy as np

    rows = []
    for name, seen in done.pixels.items():
        if seen is None:
            rows.append((name, "not seen", "", "", ""))
            continue
        values, vectors = np.linalg.eigh(seen.search_px2)
        major, minor = (3.0 * math.sqrt(max(v, 0.0)) for v in values[::-1])
        angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1])) % 180.0
        rows.append(
            (
                name,
                f"{seen.pixel_px[0]:.2f}",
                f"{seen.pixel_px[1]:.2f}",
                f"{major:.2f} x {minor:.2f}",
                f"{angle:.0f}",
            )
        )
    x, y, z = done.seen.position_m
    notes = [f"{name}: {why}" for name, why in done.reasons.items()]
    notes.append(f"head at pan {done.pan_rad:.6f}, tilt {done.tilt_rad:.6f} rad")
    gap = f"{1e3 * done.seen.ray_gap_m:.2f} mm, {done.gap.sigmas:.1f} sigma"
    notes.append(f"target at ({x:.4f}, {y:.4f}, {z:.4f}) m, rover frame; rays pass at {gap}")
    what = ["clicks"] + ["joints"] * bool(args.sigma_joint) + ["calibration"] * ("covariance" in rig.fit)
    notes.append(f"3-sigma half axes of where to search, from {', '.join(what)}; angle from x towards y")
    output.print_table(
        f"{rig.name}: from {args.source} to {args.to}",
        ("camera", "x px", "y px", "search px", "angle deg"),
        rows,
        notes,
    )

"""Commands on a mast file alone, no rover needed: solve, triangulate; and the paper's error budget."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from mastctl.cli import output
from mastctl.cli.mast_files import camera_name, need_joints, read_mast_file, stereo_pair
from mastctl.cli.output import finite_number, positive_number


def add_commands(subparsers: Any) -> None:
    """Add the commands of this module to the parser's commands."""
    solve = subparsers.add_parser("solve", help="the true joint angles that bring a target onto a pixel")
    solve.add_argument("mast", type=Path, metavar="MAST.yaml")
    solve.add_argument("--camera", required=True, metavar="NAME", help="a camera on the head")
    solve.add_argument(
        "--target", required=True, nargs=3, type=finite_number, metavar=("X", "Y", "Z"), help="rover frame, m"
    )
    solve.add_argument(
        "--pixel", nargs=2, type=finite_number, metavar=("U", "V"), help="default: the image centre"
    )
    solve.add_argument("--from-pan", type=finite_number, default=0.0, metavar="RAD")
    solve.add_argument("--from-tilt", type=finite_number, default=0.0, metavar="RAD")
    solve.set_defaults(run=solve_pointing)

    triangulate = subparsers.add_parser(
        "triangulate", help="the point that a stereo pair sees, with covariance"
    )
    triangulate.add_argument("mast", type=Path, metavar="MAST.yaml")
    triangulate.add_argument(
        "--pair", required=True, metavar="NAME", help="a pair of the file's stereo section"
    )
    triangulate.add_argument("--pan", type=finite_number, metavar="RAD", help="true joint angle")
    triangulate.add_argument("--tilt", type=finite_number, metavar="RAD", help="true joint angle")
    for side in ("--left", "--right"):
        triangulate.add_argument(side, required=True, nargs=2, type=finite_number, metavar=("U", "V"))
    triangulate.add_argument("--sigma-px", type=positive_number, default=0.2, metavar="PX")
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

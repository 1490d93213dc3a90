"""Commands on files alone, no rover needed: camera project, ray, convert; solve; triangulate; budget."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mastctl.cli.output import finite_number, positive_number


def add_commands(subparsers: Any) -> None:
    """Add the commands of this module to the parser's commands."""
    camera = subparsers.add_parser("camera", help="project points, give rays, convert camera files")
    actions = camera.add_subparsers(dest="action", metavar="ACTION", required=True)

    project = actions.add_parser("project", help="points x_m,y_m,z_m to pixels x_px,y_px, CSV to CSV")
    _add_camera_options(project)
    project.add_argument("--points", required=True, type=Path, metavar="P.csv", help="x_m,y_m,z_m")
    project.set_defaults(run=camera_project)

    ray = actions.add_parser("ray", help="pixels x_px,y_px to rays ox_m,oy_m,oz_m,dx,dy,dz, CSV to CSV")
    _add_camera_options(ray)
    ray.add_argument("--pixels", required=True, type=Path, metavar="Q.csv", help="x_px,y_px")
    ray.set_defaults(run=camera_ray)

    convert = actions.add_parser(
        "convert", help="write a camera as .yaml or .cahvor; says what the target format cannot hold"
    )
    convert.add_argument("source", type=Path, metavar="IN", help="mast or camera file, .cahvor, PDS3 label")
    convert.add_argument("target", type=Path, metavar="OUT", help="a .yaml or .cahvor file")
    convert.add_argument("--camera", metavar="NAME", help="which camera, where IN holds several")
    convert.set_defaults(run=camera_convert)

    solve = subparsers.add_parser("solve", help="the joint angles that bring a target onto a pixel")
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
    triangulate.add_argument("--pan", type=finite_number, metavar="RAD")
    triangulate.add_argument("--tilt", type=finite_number, metavar="RAD")
    for side in ("--left", "--right"):
        triangulate.add_argument(side, required=True, nargs=2, type=finite_number, metavar=("U", "V"))
    triangulate.add_argument("--sigma-px", type=positive_number, default=0.2, metavar="PX")
    triangulate.set_defaults(run=triangulate_pair)

    budget = subparsers.add_parser("budget", help="the paper's error budget (Table I) from its formulas")
    budget.set_defaults(run=error_budget)


def _add_camera_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose a camera model."""
    parser.add_argument("file", type=Path, metavar="FILE", help="mast or camera file, .cahvor, PDS3 label")
    parser.add_argument("--camera", metavar="NAME", help="which camera, where FILE holds several")
    parser.add_argument("--pan", type=finite_number, metavar="RAD", help="joint angle, for a head camera")
    parser.add_argument("--tilt", type=finite_number, metavar="RAD", help="joint angle, for a head camera")


def camera_project(args: argparse.Namespace) -> int:
    """Project points of a CSV table."""
    raise NotImplementedError


camera_ray = camera_convert = solve_pointing = triangulate_pair = error_budget = camera_project

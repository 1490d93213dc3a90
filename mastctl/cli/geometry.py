"""Commands on files alone, no rover needed: camera project, ray, convert; solve; triangulate; budget.

The other actions of ``camera``, on connected cameras, are in `mastctl.cli.cameras`."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import cameras, output
from mastctl.cli.output import finite_number, positive_number

if TYPE_CHECKING:
    from calib.camera.cahvor import CameraModel
    from calib.files.mast_file import StoredRig
    from calib.mast.rig import Rig


def add_commands(subparsers: Any) -> None:
    """Add the commands of this module to the parser's commands."""
    camera = subparsers.add_parser(
        "camera", help="camera files (project, ray, convert), cameras (list, check, grab, focus)"
    )
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

    cameras.add_actions(actions)

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
    """Project points of a CSV table: x_m,y_m,z_m to x_px,y_px."""
    from calib.files.tables import read_table, write_table

    model = _chosen_model(args)
    pixels, _ = model.project(read_table(args.points, ("x_m", "y_m", "z_m")))
    write_table(sys.stdout, ("x_px", "y_px"), pixels)
    return 0


def camera_ray(args: argparse.Namespace) -> int:
    """Give the rays through pixels of a CSV table: x_px,y_px to origin and direction."""
    import numpy as np

    from calib.files.tables import read_table, write_table

    model = _chosen_model(args)
    rays = model.ray(read_table(args.pixels, ("x_px", "y_px")))
    columns = ("ox_m", "oy_m", "oz_m", "dx", "dy", "dz")
    write_table(sys.stdout, columns, np.hstack([rays.origins_m, rays.directions]))
    return 0


def camera_convert(args: argparse.Namespace) -> int:
    """Write a camera of a file in another format, and say what that format cannot hold."""
    from calib.files import CameraFile
    from calib.files.any_camera import load_any, save_any

    source = load_any(args.source)
    if not isinstance(source, CameraFile):
        if args.target.exists() and args.target.samefile(args.source):
            words = "one camera would take the place of the mast and all its cameras"
            raise output.WrongUse(f"OUT is the mast file {args.source} itself: {words}; give another file")
        camera = source.rig.cameras[_camera_name(source, args.camera)]
        provenance = {"mast_file_sha256": source.digest, **source.rig.provenance}
        left_out = ("the mast file's 'fit' is left out",) if source.rig.fit else ()
        source = CameraFile(camera.model, camera.on, {}, provenance, source.notes + left_out)
    else:
        _refuse_name(args)
    done = save_any(source, args.target)
    if args.json:
        output.print_json(
            {
                "out": str(done.path),
                "format": done.format,
                "frame": source.frame,
                "lost": list(done.lost),
                "notes": list(source.notes),
            }
        )
        return 0
    sys.stdout.write(output.one_line(f"{done.path}: {done.format}, frame '{source.frame}'") + "\n")
    for sentence in (*source.notes, *done.lost):
        sys.stdout.write(output.one_line(sentence) + "\n")
    return 0


def solve_pointing(args: argparse.Namespace) -> int:
    """Solve for the joint angles that bring a target in the rover frame onto a pixel."""
    from calib.files.mast_file import load_rig
    from calib.mast.pointing import solve

    stored = load_rig(args.mast)
    _tell_notes(stored.notes)
    camera = stored.rig.cameras[_camera_name(stored, args.camera)]
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
    output.print_table(
        f"{stored.rig.name}: target {_triple(args.target)} m on pixel ({x:g}, {y:g}) of {args.camera}",
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
    from calib.files.mast_file import load_rig
    from calib.mast.covariance import stored_covariance
    from calib.mast.ray_gap import clicked_point

    stored = load_rig(args.mast)
    _tell_notes(stored.notes)
    rig = stored.rig
    if args.pair not in rig.stereo:
        raise output.WrongUse(
            f"no stereo pair '{args.pair}' in {args.mast}; {_nearest(args.pair, rig.stereo)}"
        )
    pair = rig.stereo[args.pair]
    for name in pair:
        _need_joints(rig, name, args)
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
    from calib.mast.budget import target_approach_budget

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


def _chosen_model(args: argparse.Namespace) -> CameraModel:
    """Return the camera of --camera at --pan and --tilt in the rover frame, or a single camera as it is."""
    from calib.files import CameraFile
    from calib.files.any_camera import load_any

    source = load_any(args.file)
    _tell_notes(source.notes)
    if isinstance(source, CameraFile):
        _refuse_name(args)
        if args.pan is not None or args.tilt is not None:
            raise output.WrongUse(f"{args.file} has no mast; leave --pan and --tilt out")
        return source.model
    return _at_joints(source.rig, _camera_name(source, args.camera), args)


def _at_joints(rig: Rig, name: str, args: argparse.Namespace) -> CameraModel:
    """Return a camera of the rig in the rover frame; a camera on the head needs --pan and --tilt."""
    _need_joints(rig, name, args)
    return rig.camera_in_rover(name, args.pan or 0.0, args.tilt or 0.0)


def _need_joints(rig: Rig, name: str, args: argparse.Namespace) -> None:
    """Refuse a camera on the head without --pan and --tilt."""
    if rig.cameras[name].on == "head" and (args.pan is None or args.tilt is None):
        raise output.WrongUse(f"camera '{name}' is on the head; --pan RAD and --tilt RAD are expected")


def _camera_name(stored: StoredRig, name: str | None) -> str:
    """Return the camera that was asked for, the only one by default."""
    cameras = stored.rig.cameras
    if name is None and len(cameras) == 1:
        return next(iter(cameras))
    if not cameras:
        raise output.WrongUse(f"{stored.path} holds no camera")
    if name is None:
        raise output.WrongUse(
            f"{stored.path} holds several cameras; --camera with one of {', '.join(cameras)}"
        )
    if name not in cameras:
        raise output.WrongUse(f"no camera '{name}' in {stored.path}; {_nearest(name, cameras)}")
    return name


def _refuse_name(args: argparse.Namespace) -> None:
    """Refuse --camera where the file holds one camera without a name."""
    if args.camera is not None:
        raise output.WrongUse("the file holds one camera without a name; leave --camera out")


def _nearest(word: str, known: Iterable[str]) -> str:
    from calib.files.strict import nearest

    return nearest(word, list(known)) if known else "it has none"


def _tell_notes(notes: Iterable[str]) -> None:
    """Tell what reading the file changed; on stderr, for stdout holds the result."""
    for note in notes:
        output.tell(note)


def _triple(values: Iterable[float]) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"

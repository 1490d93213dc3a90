"""Commands on camera files: camera project, ray, convert. The other actions are in `mastctl.cli.cameras`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import cameras, output
from mastctl.cli.mast_files import (
    camera_name,
    camera_of,
    chosen_camera,
    need_joints,
    read_mast_file,
    stereo_pair,
    tell_notes,
)
from mastctl.cli.output import finite_number, positive_number

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

    from calib.files import CameraFile
    from calib.files.any_camera import Conversion
    from calib.geometry.cahvor import CameraModel


_SOURCES = "mast or camera file, .cahvor, OpenCV's, ROS's, Kalibr's or mrcal's"

MOST_EMPTY_TOLD = 20
"""So many rows without a pixel or a ray get a sentence each; the others are counted."""


def add_commands(subparsers: Any) -> None:
    """Add ``camera`` with all its actions."""
    camera = subparsers.add_parser(
        "camera", help="camera files (project, ray, convert, maps), cameras (list, check, grab, focus)"
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
        "convert",
        help="write a camera in another format; says what that cannot hold, and the worst error in px",
    )
    convert.add_argument("source", type=Path, metavar="IN", help=_SOURCES)
    convert.add_argument(
        "target",
        type=Path,
        metavar="OUT",
        help="x.yaml (a camera file), x.cahvor, x.cameramodel, x.opencv.yaml, x.ros.yaml, x.kalibr.yaml",
    )
    convert.add_argument(
        "--camera",
        metavar="NAME",
        action="append",
        help="which camera, where IN holds several; again for each camera of a Kalibr file",
    )
    convert.add_argument(
        "--to",
        choices=("mastctl", "cahvor", "opencv", "ros", "kalibr", "mrcal"),
        default="",
        help="the format, where the name of OUT does not say it",
    )
    convert.add_argument(
        "--lens",
        choices=(
            "cahvor",
            "radtan",
            "plumb_bob",
            "rational_polynomial",
            "thin_prism",
            "equidistant",
            "tilted",
        ),
        default="",
        help="the lens of OUT (default: the plainest of its format that comes near enough)",
    )
    convert.add_argument(
        "--limit-px",
        type=positive_number,
        metavar="PX",
        help="refuse if a pixel anywhere in the image moves by more (default 0.25)",
    )
    convert.set_defaults(run=camera_convert)

    _add_maps(actions)
    cameras.add_actions(actions)


def _add_camera_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose a camera model."""
    parser.add_argument("file", type=Path, metavar="FILE", help=_SOURCES)
    parser.add_argument("--camera", metavar="NAME", help="which camera, where FILE holds several")
    parser.add_argument(
        "--pan", type=finite_number, metavar="RAD", help="true joint angle, for a head camera"
    )
    parser.add_argument(
        "--tilt", type=finite_number, metavar="RAD", help="true joint angle, for a head camera"
    )


def camera_project(args: argparse.Namespace) -> int:
    """Project points of a CSV table: x_m,y_m,z_m to x_px,y_px."""
    from calib.files.tables import read_table, write_table

    model = _chosen_model(args)
    points = read_table(args.points, ("x_m", "y_m", "z_m"))
    pixels, valid = model.project(points)
    write_table(sys.stdout, ("x_px", "y_px"), pixels)
    _tell_empty(model, args.points, points, valid)
    return 0


def camera_ray(args: argparse.Namespace) -> int:
    """Give the rays through pixels of a CSV table: x_px,y_px to origin and direction."""
    import numpy as np

    from calib.files.tables import read_table, write_table

    model = _chosen_model(args)
    pixels = read_table(args.pixels, ("x_px", "y_px"))
    rays = model.ray(pixels)
    columns = ("ox_m", "oy_m", "oz_m", "dx", "dy", "dz")
    write_table(sys.stdout, columns, np.hstack([rays.origins_m, rays.directions]))
    _tell_empty(model, args.pixels, pixels, rays.valid)
    return 0


def _tell_empty(model: CameraModel, path: Path, rows: np.ndarray, valid: np.ndarray) -> None:
    """Tell on stderr why the cells of points (n, 3) or pixels (n, 2) that are not valid are empty."""
    import numpy as np

    empty = np.flatnonzero(~valid)
    for at in empty[:MOST_EMPTY_TOLD].tolist():
        row = rows[at]
        told = f"({', '.join(f'{value:g}' for value in row)})"
        if not np.isfinite(row).all():
            words = "is not finite"
        elif len(row) == 2:
            words = f"px has no ray in this {model.kind} camera{model.why_no_ray}"
        else:
            away = row - model.C
            angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(away, model.A)), away @ model.A))
            words = (
                f"m is {angle:.1f} degrees from the axis of this {model.kind} camera, which does not see it"
            )
            words += model.why_no_ray
        output.tell(f"{path}: row {at + 1}: {told} {words}")
    if (more := len(empty) - MOST_EMPTY_TOLD) > 0:
        output.tell(f"{path}: {more} more rows are empty, the last is row {empty[-1] + 1}")


def camera_convert(args: argparse.Namespace) -> int:
    """Write a camera of a file in another format, and say what that format cannot hold."""
    from calib.files.any_camera import LIMIT_PX, load_any, save_any
    from calib.files.mast_file import StoredRig

    source = load_any(args.source)
    if isinstance(source, StoredRig) and args.target.exists() and args.target.samefile(args.source):
        words = "one camera would take the place of the mast and all its cameras"
        raise output.WrongUse(f"OUT is the mast file {args.source} itself: {words}; give another file")
    names = args.camera or [None]
    if len(set(names)) < len(names):
        raise output.WrongUse("--camera names one camera twice")
    cameras = dict(camera_of(source, name) for name in names)
    limit_px = LIMIT_PX if args.limit_px is None else args.limit_px
    done = save_any(cameras, args.target, args.to, args.lens, limit_px)
    notes = list(dict.fromkeys(note for camera in cameras.values() for note in camera.notes))
    (frame,) = {camera.frame for camera in cameras.values()}
    if args.json:
        told: dict[str, Any] = {"out": str(done.path), "format": done.format, "frame": frame}
        told |= {"lost": list(done.lost), "notes": notes}
        if done.errors:
            told["cameras"] = _errors_told(cameras, done)
        output.print_json(told)
        return 0
    sys.stdout.write(output.one_line(f"{done.path}: {done.format}, frame '{frame}'") + "\n")
    for name, error in _errors_told(cameras, done).items():
        words = f", {error['lens']}" if error["lens"] else ""
        told_px = f"worst {error['worst_px']:.2g} px, {error['rms_px']:.2g} px rms over the image"
        sys.stdout.write(output.one_line(f"{name}{words}: {told_px}") + "\n")
    for sentence in (*notes, *done.lost):
        sys.stdout.write(output.one_line(sentence) + "\n")
    return 0


def _errors_told(cameras: Mapping[str, CameraFile], done: Conversion) -> dict[str, dict[str, Any]]:
    """Lens and error in px of each camera that was not written as it is."""
    lenses = done.lens or ("",) * len(done.errors)
    return {
        name: {"lens": lens, "worst_px": error.worst_px, "rms_px": error.rms_px}
        for name, lens, error in zip(cameras, lenses, done.errors, strict=False)
    }


def _chosen_model(args: argparse.Namespace) -> CameraModel:
    """Return the camera of --camera at --pan and --tilt in the rover frame, or a single camera as it is."""
    from calib.files.any_camera import load_any
    from calib.files.mast_file import StoredRig

    source = load_any(args.file)
    if not isinstance(source, StoredRig):
        _, camera = camera_of(source, args.camera)
        tell_notes(camera.notes)
        if args.pan is not None or args.tilt is not None:
            raise output.WrongUse(f"{args.file} has no mast; leave --pan and --tilt out")
        return camera.model
    tell_notes(source.notes)
    name = camera_name(source, args.camera)
    need_joints(source.rig, name, args)
    return source.rig.camera_in_rover(name, args.pan or 0.0, args.tilt or 0.0)


def _add_maps(actions: Any) -> None:
    """Add ``camera maps``."""
    maps = actions.add_parser(
        "maps", help="maps for cv2.remap: without the lens, or a pair's rows side by side"
    )
    maps.add_argument(
        "file", type=Path, metavar="FILE", help="as for camera convert; --pair needs a mast file"
    )
    maps.add_argument("--camera", metavar="NAME", help="which camera, where FILE holds several")
    maps.add_argument("--pair", metavar="NAME", help="a stereo pair: rectify both its pictures")
    maps.add_argument(
        "--focal-px", type=positive_number, metavar="PX", help="of the new picture (default: the camera's)"
    )
    maps.add_argument("--out", required=True, type=Path, metavar="MAPS.npz", help="NumPy's archive to write")
    maps.set_defaults(run=camera_maps)


def camera_maps(args: argparse.Namespace) -> int:
    """Write the maps, the new camera's matrix and vectors, and for a pair OpenCV's Q."""
    from calib.geometry.maps import ideal_camera, maps_between, rectified_pair
    from mastctl.cli.output import check_file

    if args.out.suffix != ".npz":
        raise output.WrongUse(f"--out {args.out}: a name that ends with .npz is expected")
    check_file(args.out, "--out")
    held: dict[str, np.ndarray] = {}
    if args.pair is None:
        name, camera = chosen_camera(args.file, args.camera)
        new = ideal_camera(camera.model, args.focal_px)
        maps = maps_between(new, camera.model)
        held |= {"map_x": maps.map_x, "map_y": maps.map_y, **_maps_told(new, "")}
        frame, shown = camera.frame, {name: maps}
    else:
        if args.camera is not None:
            raise output.WrongUse("--camera and --pair: one of them is expected")
        stored = read_mast_file(args.file)
        names = stereo_pair(stored, args.pair)
        left, right = (stored.rig.cameras[one] for one in names)
        if left.on != right.on:
            raise output.WrongUse(f"'{args.pair}' is a pair of two mounts; both on one are expected")
        try:
            pair = rectified_pair(left.model, right.model, args.focal_px)
        except ValueError as error:
            raise output.CommandError("no_pair", f"{args.pair}: {error}") from None
        held["Q"] = pair.depth
        for side, new, maps in (("left", pair.left, pair.left_maps), ("right", pair.right, pair.right_maps)):
            held |= {f"{side}_map_x": maps.map_x, f"{side}_map_y": maps.map_y, **_maps_told(new, f"{side}_")}
        frame, shown = left.on, dict(zip(names, (pair.left_maps, pair.right_maps), strict=True))
    _save_maps(args.out, held)
    seen = {name: float((maps.map_x >= 0.0).mean()) for name, maps in shown.items()}
    if args.json:
        output.print_json({"out": str(args.out), "frame": frame, "arrays": sorted(held), "shown": seen})
        return 0
    sys.stdout.write(output.one_line(f"{args.out}: {', '.join(held)}; vectors in '{frame}'") + "\n")
    for name, part in seen.items():
        words = f"{name}: {100 * part:.0f} % of the new picture is shown by the old one"
        sys.stdout.write(output.one_line(words) + "\n")
    return 0


def _maps_told(camera: CameraModel, before: str) -> dict[str, np.ndarray]:
    """The new camera: K (3, 3), and C, A, H, V (3,)."""
    import numpy as np

    cx, cy = camera.H @ camera.A, camera.V @ camera.A
    fx, fy = camera.focal_px
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return {f"{before}K": matrix, **{f"{before}{letter}": getattr(camera, letter) for letter in "CAHV"}}


def _save_maps(path: Path, arrays: dict[str, np.ndarray]) -> None:
    import io

    import numpy as np

    from calib.files.atomic import save_bytes

    held = io.BytesIO()
    np.savez_compressed(held, **arrays)  # type: ignore[arg-type]  # names are names
    save_bytes(path, held.getvalue())

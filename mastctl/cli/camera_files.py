"""Commands on camera files: camera project, ray, convert. The other actions are in `mastctl.cli.cameras`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import cameras, output
from mastctl.cli.mast_files import camera_name, need_joints, tell_notes
from mastctl.cli.output import finite_number

if TYPE_CHECKING:
    from calib.camera.cahvor import CameraModel


def add_commands(subparsers: Any) -> None:
    """Add ``camera`` with all its actions."""
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


def _add_camera_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose a camera model."""
    parser.add_argument("file", type=Path, metavar="FILE", help="mast or camera file, .cahvor, PDS3 label")
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
        camera = source.rig.cameras[camera_name(source, args.camera)]
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


def _chosen_model(args: argparse.Namespace) -> CameraModel:
    """Return the camera of --camera at --pan and --tilt in the rover frame, or a single camera as it is."""
    from calib.files import CameraFile
    from calib.files.any_camera import load_any

    source = load_any(args.file)
    tell_notes(source.notes)
    if isinstance(source, CameraFile):
        _refuse_name(args)
        if args.pan is not None or args.tilt is not None:
            raise output.WrongUse(f"{args.file} has no mast; leave --pan and --tilt out")
        return source.model
    name = camera_name(source, args.camera)
    need_joints(source.rig, name, args)
    return source.rig.camera_in_rover(name, args.pan or 0.0, args.tilt or 0.0)


def _refuse_name(args: argparse.Namespace) -> None:
    """Refuse --camera where the file holds one camera without a name."""
    if args.camera is not None:
        raise output.WrongUse("the file holds one camera without a name; leave --camera out")

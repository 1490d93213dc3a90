"""Commands on camera files: camera project, ray, convert, maps and mode."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.geometry import (
    camera_name,
    camera_of,
    need_joints,
    read_mast_file,
    stereo_pair,
    tell_notes,
)
from mastctl.cli.options import command, option
from mastctl.cli.output import Answer, CommandError, WrongUse, tables_of

if TYPE_CHECKING:
    import numpy as np

    from calib.geometry.cahvor import CameraModel


SOURCES = "mast or camera file, .cahvor, OpenCV's, ROS's, Kalibr's or mrcal's"
MODEL = (
    option("FILE", SOURCES),
    option("--camera NAME", "which camera, where FILE has several"),
    option("--pan RAD", "true joint angle, for a head camera"),
    option("--tilt RAD", "true joint angle, for a head camera"),
)

MOST_ROWS = 20
"""So many rows without a pixel or a ray get a sentence each; the others are counted."""


@command(
    "camera project",
    *MODEL,
    option("--points P.csv", "x_m,y_m,z_m", required=True),
    help="points x_m,y_m,z_m to pixels x_px,y_px, CSV to CSV",
    example="mast.yaml --camera navcam_left --pan 0.3 --tilt -0.2 --points points.csv",
)
def camera_project(args: argparse.Namespace) -> int:
    """Project points of a CSV table: x_m,y_m,z_m to x_px,y_px."""
    from calib.files.tables import read_table, write_table

    model = _chosen_model(args)
    points = read_table(args.points, ("x_m", "y_m", "z_m"))
    pixels, valid = model.project(points)
    write_table(sys.stdout, ("x_px", "y_px"), pixels)
    _report_empty(model, args.points, points, valid)
    return 0


@command(
    "camera ray",
    *MODEL,
    option("--pixels Q.csv", "x_px,y_px", required=True),
    help="pixels x_px,y_px to rays ox_m,oy_m,oz_m,dx,dy,dz, CSV to CSV",
    example="mast.yaml --camera navcam_left --pan 0.3 --tilt -0.2 --pixels pixels.csv",
)
def camera_ray(args: argparse.Namespace) -> int:
    """Give the rays through pixels of a CSV table: x_px,y_px to origin and direction."""
    import numpy as np

    from calib.files.tables import read_table, write_table

    model = _chosen_model(args)
    pixels = read_table(args.pixels, ("x_px", "y_px"))
    rays = model.ray(pixels)
    columns = ("ox_m", "oy_m", "oz_m", "dx", "dy", "dz")
    write_table(sys.stdout, columns, np.hstack([rays.origins_m, rays.directions]))
    _report_empty(model, args.pixels, pixels, rays.valid)
    return 0


def _report_empty(model: CameraModel, path: Path, rows: np.ndarray, valid: np.ndarray) -> None:
    """Write on stderr why the cells of points (n, 3) or pixels (n, 2) that are not valid are empty."""
    import numpy as np

    empty = np.flatnonzero(~valid)
    for at in empty[:MOST_ROWS].tolist():
        row = rows[at]
        shown = f"({', '.join(f'{value:g}' for value in row)})"
        if not np.isfinite(row).all():
            reason = "is not finite"
        elif len(row) == 2:
            reason = f"px has no ray in this {model.kind} camera{model.why_no_ray}"
        else:
            away = row - model.C
            angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(away, model.A)), away @ model.A))
            reason = (
                f"m is {angle:.1f} degrees from the axis of this {model.kind} camera, which does not see it"
            )
            reason += model.why_no_ray
        output.tell(f"{path}: row {at + 1}: {shown} {reason}")
    if (more := len(empty) - MOST_ROWS) > 0:
        output.tell(f"{path}: {more} more rows are empty, the last is row {empty[-1] + 1}")


@command(
    "camera convert",
    option("IN", SOURCES, dest="source"),
    option(
        "OUT", "x.yaml (a camera file), x.cahvor, x.cameramodel, x.opencv.yaml, x.ros.yaml, x.kalibr.yaml"
    ),
    option(
        "--camera NAME", "which camera, where IN has several; again for each of a Kalibr file", repeat=True
    ),
    option(
        "--to mastctl|cahvor|opencv|ros|kalibr|mrcal",
        "the format, where the name of OUT does not say it",
        default="",
    ),
    option(
        "--lens cahvor|radtan|plumb_bob|rational_polynomial|thin_prism|equidistant|tilted",
        "the lens of OUT (default: the plainest of its format that comes near enough)",
        default="",
    ),
    option("--limit-px PX", "refuse if a pixel anywhere in the image moves by more (default 0.25)"),
    help="write a camera in another format; says what that cannot hold, and the worst error in px",
    example="camera.yaml camera.cahvor",
)
def camera_convert(args: argparse.Namespace) -> Answer:
    """Write a camera of a file in another format, with what that format cannot hold."""
    from calib.files.any_camera import LIMIT_PX, load_any, save_any
    from calib.files.mast_file import StoredRig

    source, out = load_any(args.source), args.out
    if isinstance(source, StoredRig) and out.exists() and out.samefile(args.source):
        why = "one camera would take the place of the mast and all its cameras"
        raise WrongUse(f"OUT is the mast file {args.source} itself: {why}; give another file")
    names = args.camera or [None]
    if len(set(names)) < len(names):
        raise WrongUse("--camera names one camera twice")
    cameras = dict(camera_of(source, name) for name in names)
    done = save_any(cameras, out, args.to, args.lens, args.limit_px or LIMIT_PX)
    notes = list(dict.fromkeys(note for camera in cameras.values() for note in camera.notes))
    (frame,) = {camera.frame for camera in cameras.values()}
    errors = {
        name: {"lens": lens, "worst_px": error.worst_px, "rms_px": error.rms_px}
        for name, lens, error in zip(
            cameras, done.lens or ("",) * len(done.errors), done.errors, strict=False
        )
    }
    document: dict[str, Any] = {"out": str(done.path), "format": done.format, "frame": frame}
    document |= {"lost": list(done.lost), "notes": notes} | ({"cameras": errors} if errors else {})
    line = f"{done.path}: {done.format}, frame '{frame}'"
    return Answer(document, [line, *tables_of(errors, "errors"), *notes, *done.lost])


def _chosen_model(args: argparse.Namespace) -> CameraModel:
    """Return the camera of --camera at --pan and --tilt in the rover frame, or a single camera as it is."""
    from calib.files.any_camera import load_any
    from calib.files.mast_file import StoredRig

    source = load_any(args.file)
    if not isinstance(source, StoredRig):
        _, camera = camera_of(source, args.camera)
        tell_notes(camera.notes)
        if args.pan is not None or args.tilt is not None:
            raise WrongUse(f"{args.file} has no mast; leave --pan and --tilt out")
        return camera.model
    tell_notes(source.notes)
    name = camera_name(source, args.camera)
    need_joints(source.rig, name, args)
    return source.rig.camera_in_rover(name, args.pan or 0.0, args.tilt or 0.0)


@command(
    "camera maps",
    option("FILE", "as for camera convert; --pair needs a mast file"),
    option("--camera NAME", "which camera, where FILE has several"),
    option("--pair NAME", "a stereo pair: rectify both its pictures"),
    option("--focal-px PX", "of the new picture (default: the camera's)"),
    option("--out MAPS.npz", "NumPy's archive to write", required=True),
    help="maps for cv2.remap: without the lens, or a pair's rows side by side",
    example="mast.yaml --pair navcam --out maps.npz",
)
def camera_maps(args: argparse.Namespace) -> Answer:
    """Write the maps, the new camera's K (3, 3) and C, A, H, V (3,), and for a pair OpenCV's Q."""
    import io

    import numpy as np

    from calib.files import save_bytes
    from calib.files.any_camera import load_any
    from calib.geometry.maps import ideal_camera, maps_between, rectified_pair

    if args.out.suffix != ".npz":
        raise WrongUse(f"--out {args.out}: a name that ends with .npz is expected")
    output.check_file(args.out, "--out")
    arrays: dict[str, np.ndarray] = {}
    if args.pair is None:
        name, camera = camera_of(load_any(args.file), args.camera)
        tell_notes(camera.notes)
        new = ideal_camera(camera.model, args.focal_px)
        frame, made = camera.frame, [("", name, new, maps_between(new, camera.model))]
    else:
        if args.camera is not None:
            raise WrongUse("--camera and --pair: one of them is expected")
        stored = read_mast_file(args.file)
        names = stereo_pair(stored, args.pair)
        left, right = (stored.rig.cameras[one] for one in names)
        if left.on != right.on:
            raise WrongUse(f"'{args.pair}' is a pair of two mounts; both on one are expected")
        try:
            pair = rectified_pair(left.model, right.model, args.focal_px)
        except ValueError as error:
            raise CommandError("no_pair", f"{args.pair}: {error}") from None
        arrays["Q"], frame = pair.depth, left.on
        made = [
            ("left_", names[0], pair.left, pair.left_maps), ("right_", names[1], pair.right, pair.right_maps)
        ]  # fmt: skip
    seen = {}
    for before, name, new, maps in made:
        (fx, fy), cx, cy = new.focal_px, new.H @ new.A, new.V @ new.A
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        arrays |= {f"{before}map_x": maps.map_x, f"{before}map_y": maps.map_y, f"{before}K": matrix}
        arrays |= {f"{before}{letter}": getattr(new, letter) for letter in "CAHV"}
        seen[name] = float((maps.map_x >= 0.0).mean())
    archive = io.BytesIO()
    np.savez_compressed(archive, **arrays)  # type: ignore[arg-type]  # names are names
    save_bytes(args.out, archive.getvalue())
    return Answer({"out": str(args.out), "frame": frame, "arrays": sorted(arrays), "shown": seen})


@command(
    "camera mode",
    option("MAST.yaml", "the mast file as it was calibrated", dest="file"),
    option("--camera NAME", "which camera, where the file has several"),
    option(
        "--crop X Y WIDTH HEIGHT", "the part of the calibrated picture that is read, in its pixels", type=int
    ),
    option(
        "--bin N...",
        "so many pixels make one: one number, or one across and one down; after the crop",
        default=[1],
    ),
    option("--flip none|horizontal|vertical|both", "after crop and binning", default="none"),
    option("--out NEW.yaml", "the mast file to write", required=True),
    help="write a mast file for a crop, binning or flip of the calibrated pictures of a camera",
    example="mast.yaml --camera navcam_left --bin 2 --flip both --out binned.yaml",
)
def camera_mode(args: argparse.Namespace) -> Answer:
    """Write the mast file of another mode."""
    from calib.files.mast_file import save_rig
    from calib.geometry.covariance import rig_in_mode
    from calib.geometry.mode import FLIPS, Mode

    if len(args.bin) > 2:
        raise WrongUse(f"--bin has {len(args.bin)} numbers where one or two are expected")
    stored = read_mast_file(args.file)
    name = camera_name(stored, args.camera)
    crop_px = None if args.crop is None else (args.crop[0], args.crop[1], args.crop[2], args.crop[3])
    mode = Mode(crop_px, (args.bin[0], args.bin[-1]), FLIPS[args.flip])
    rig = rig_in_mode(stored.rig, name, mode)
    size_px = rig.cameras[name].model.size_px
    if not str(mode):
        raise WrongUse("--crop, --bin or --flip is expected: the calibrated mode needs no other file")
    if args.out.exists() and args.out.samefile(args.file):
        raise WrongUse(f"--out {args.out} is MAST.yaml itself, which a second run would change again")
    before = rig.provenance.get("modes", [])  # any value may be there
    before = before if isinstance(before, list) else [] if before is None else [before]
    noted = [*before, {"camera": name, "of": stored.digest, "mode": str(mode)}]
    if stored.rig.cameras[name].sensor_mode is not None and rig.cameras[name].sensor_mode is None:
        output.tell(f"which part of the sensor {name} then shows is not known: its sensor_mode is left out")
    written = save_rig(replace(rig, provenance={**rig.provenance, "modes": noted}), args.out)
    document = {"out": str(args.out), "camera": name, "size_px": list(size_px), "mode": str(mode)}
    return Answer(
        document | {"digest": written.digest},
        f"{args.out}: {name} with {mode}: {size_px[0]}x{size_px[1]} px",
    )

"""Commands on mast and camera files, no rover needed; and the error budget."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Collection, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli.options import command, option, positive_number
from mastctl.cli.output import Answer, CommandError, WrongUse, check_file, show_line, tables_at

if TYPE_CHECKING:
    import numpy as np

    from calib.files import CameraFile
    from calib.files.mast_file import StoredRig
    from calib.geometry.cahvor import CameraModel
    from calib.geometry.rig import Rig

MAST = option("MAST.yaml", "the mast file")
STEREO = (
    option("--pan RAD", "true joint angle"),
    option("--tilt RAD", "true joint angle"),
    option("--left U V", "pixel in the left image", required=True),
    option("--right U V", "pixel in the right image", required=True),
    option("--sigma-px PX", "one sigma of a click, each axis", default=0.2),
)
PRESENT = "present angle; solutions near it come first"


@command(
    "solve",
    MAST,
    option("--camera NAME", "a camera on the head", required=True),
    option("--target X Y Z", "rover frame, m", required=True),
    option("--pixel U V", "default: the image centre"),
    option("--from-pan RAD", PRESENT, default=0.0),
    option("--from-tilt RAD", PRESENT, default=0.0),
    example="mast.yaml --camera navcam_left --target 6 1 0",
)
def solve_pointing(args: argparse.Namespace) -> Answer:
    """Solve for the joint angles that bring a target in the rover frame onto a pixel, the best first."""
    from calib.geometry.pointing import solve

    stored = read_mast_file(args.mast)
    camera = stored.rig.cameras[named(args.camera, stored.rig.cameras, stored.path)]
    if camera.on != "head":
        raise WrongUse(f"camera '{args.camera}' is on the rover's body; a camera on the head is expected")
    solutions = solve(
        stored.rig.mast, camera.model, args.target, args.pixel,
        from_pan_rad=args.from_pan, from_tilt_rad=args.from_tilt,
    )  # fmt: skip
    return Answer({"solutions": solutions})


@command(
    "triangulate",
    MAST,
    option("--pair NAME", "a pair of the file's stereo section", required=True),
    *STEREO,
    example="mast.yaml --pair navcam --pan 0.3 --tilt -0.2 --left 300 420 --right 271 420",
)
def triangulate_pair(args: argparse.Namespace) -> Answer:
    """Triangulate the point seen at a pixel of each camera of a pair, in the rover frame."""
    from calib.geometry.covariance import clicked_point, stored_covariance

    stored = read_mast_file(args.mast)
    rig, pair = stored.rig, _pair(stored, args.pair)
    for name in pair:
        need_joints(rig, name, args)
    seen, _ = clicked_point(
        rig, pair, args.pan or 0.0, args.tilt or 0.0, args.left, args.right,
        sigma_px=args.sigma_px, calibration=stored_covariance(rig),
    )  # fmt: skip
    document = {
        "position_m": seen.position_m, "covariance_m2": seen.covariance_m2, "ray_gap_m": seen.ray_gap_m
    }  # fmt: skip
    sigmas_m = seen.covariance_m2.diagonal().clip(0.0) ** 0.5
    return Answer(document, tables_at(document | {"sigma_m": sigmas_m}, "position_m sigma_m ray_gap_m"))


@command("budget")
def error_budget(args: argparse.Namespace) -> Answer:
    """Compute the paper's Table I: target approach from 10 m to 1 m, 3-sigma errors."""
    from calib.geometry.stereo import target_approach_budget

    return Answer({"cameras": [row._asdict() for row in target_approach_budget()]})


@command(
    "handoff",
    MAST,
    option("--from PAIR", "the pair that sees it", dest="source", required=True),
    option("--to PAIR", "a pair, or one camera", required=True),
    *STEREO,
    option("--to-pan RAD", "default: as --pan"),
    option("--to-tilt RAD", "default: as --tilt"),
    option("--sigma-joint RAD", "of a joint reading; default: exact", type=positive_number),
    example="mast.yaml --from navcam --to hazcam --pan 0.3 --tilt -0.2 --left 300 420 --right 271 420",
)
def hand_over(args: argparse.Namespace) -> Answer:
    """Hand a target over, geometrically, with the covariance of where to search."""
    from calib.geometry.covariance import stored_covariance
    from calib.geometry.handoff import Joints, hand_off

    stored = read_mast_file(args.mast)
    rig, pair = stored.rig, _pair(stored, args.source)
    named(args.to, [*rig.stereo, *rig.cameras], args.mast, "stereo pair or camera")
    to = rig.stereo.get(args.to, (args.to,))
    for name in (*pair, *to):
        need_joints(rig, name, args)
    joints = Joints(args.pan or 0.0, args.tilt or 0.0, args.sigma_joint or 0.0)
    pan = joints.pan_rad if args.to_pan is None else args.to_pan
    tilt = joints.tilt_rad if args.to_tilt is None else args.to_tilt
    turned = (pan, tilt) != (joints.pan_rad, joints.tilt_rad)
    done = hand_off(
        rig, pair, to, joints, args.left, args.right,
        to_joints=Joints(pan, tilt, joints.sigma_rad) if turned else None,
        sigma_px=args.sigma_px, calibration=stored_covariance(rig),
    )  # fmt: skip
    pixels = {
        name: None if seen is None else dict(zip(("x_px", "y_px"), seen.pixel_px, strict=True))
        | {"covariance_px2": seen.covariance_px2, "search_px2": seen.search_px2}
        for name, seen in done.pixels.items()
    }  # fmt: skip
    document = {
        "pixels": pixels, "reasons": done.reasons, "position_m": done.seen.position_m,
        "covariance_m2": done.covariance_m2, "ray_gap_m": done.seen.ray_gap_m,
        "ray_gap_sigmas": done.gap.sigmas, "across_px": done.gap.across_px,
        "pan_rad": done.pan_rad, "tilt_rad": done.tilt_rad,
    }  # fmt: skip
    return Answer(document)


def read_mast_file(path: Path) -> StoredRig:
    """Read a mast file, with its notes on stderr, for stdout holds the result."""
    from calib.files.mast_file import load_rig

    stored = load_rig(path)
    show_notes(stored.notes)
    return stored


def show_notes(notes: Iterable[str]) -> None:
    """Write on stderr what reading a file changed."""
    for note in notes:
        show_line(note)


def named(name: str | None, known: Collection[str], where: Path | None, kind: str = "camera") -> str:
    """Return the camera, or another thing, of this name; the only one by default. Raises WrongUse."""
    from calib.files.yaml_text import nearest

    if name is None and len(known) == 1:
        return next(iter(known))
    if name is None:
        one_of = f"--{kind} with one of {', '.join(known)}" if known else "one is expected"
        raise WrongUse(f"{where} holds {len(known)} {kind}s; {one_of}")
    if name not in known:
        hint = nearest(name, list(known)) if known else "it has none"
        raise WrongUse(f"no {kind} '{name}' in {where}; {hint}")
    return name


def _pair(stored: StoredRig, name: str) -> tuple[str, str]:
    return stored.rig.stereo[named(name, stored.rig.stereo, stored.path, "stereo pair")]


def need_joints(rig: Rig, name: str, args: argparse.Namespace) -> None:
    """Refuse a camera on the head without --pan and --tilt. Raises WrongUse."""
    if rig.cameras[name].on == "head" and (args.pan is None or args.tilt is None):
        raise WrongUse(f"camera '{name}' is on the head; --pan RAD and --tilt RAD are expected")


def camera_of(
    source: StoredRig | CameraFile | dict[str, CameraFile], name: str | None
) -> tuple[str, CameraFile]:
    """Return the camera that is meant, and its name. Raises WrongUse."""
    from calib.files import CameraFile

    if isinstance(source, CameraFile):
        if name is not None:
            raise WrongUse("the file holds one camera without a name; leave --camera out")
        return "camera", source
    if isinstance(source, dict):
        name = named(name, source, next(iter(source.values())).path)
        return name, source[name]
    name = named(name, source.rig.cameras, source.path)
    camera = source.rig.cameras[name]
    provenance = {"mast_file_sha256": source.digest, **source.rig.provenance}
    left_out = ("the mast file's 'fit' is left out",) if source.rig.fit else ()
    return name, CameraFile(camera.model, camera.on, {}, provenance, source.notes + left_out)


SOURCES = "mast or camera file, .cahvor, OpenCV's, ROS's, Kalibr's or mrcal's"
MODEL = (
    option("FILE", SOURCES),
    option("--camera NAME", "which camera, where FILE has several"),
    option("--pan RAD", "true joint angle, for a head camera"),
    option("--tilt RAD", "true joint angle, for a head camera"),
)

MOST_ROWS = 20
"""So many rows without a pixel or a ray are named; the others are counted."""


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

    pixels, valid = _chosen_model(args).project(read_table(args.points, ("x_m", "y_m", "z_m")))
    write_table(sys.stdout, ("x_px", "y_px"), pixels)
    _report_empty(args.points, valid, "no pixel")
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

    rays = _chosen_model(args).ray(read_table(args.pixels, ("x_px", "y_px")))
    columns = ("ox_m", "oy_m", "oz_m", "dx", "dy", "dz")
    write_table(sys.stdout, columns, np.hstack([rays.origins_m, rays.directions]))
    _report_empty(args.pixels, rays.valid, "no ray")
    return 0


def _report_empty(path: Path, valid: np.ndarray, what: str) -> None:
    """Write on stderr which rows have empty cells."""
    rows = [str(at + 1) for at in (~valid).nonzero()[0].tolist()]
    if rows:
        more = f" and {len(rows) - MOST_ROWS} more" if rows[MOST_ROWS:] else ""
        where = f"{', '.join(rows[:MOST_ROWS])}{more}"
        show_line(f"{path}: {what} in row {where}: behind the camera, beyond its reach, or not finite")


@command(
    "camera convert",
    option("IN", SOURCES, dest="source"),
    option("OUT", "x.yaml (a camera file), x.cahvor, x.cameramodel, x.opencv.yaml, x.ros.yaml, ..."),
    option("--camera NAME", "which camera, where IN has several; again for Kalibr", repeat=True),
    option("--to mastctl|cahvor|opencv|ros|kalibr|mrcal", "where OUT does not say it", default=""),
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
    return Answer(document, [line, *tables_at(errors, "", "errors"), *notes, *done.lost])


def _chosen_model(args: argparse.Namespace) -> CameraModel:
    """Return the camera of --camera at --pan and --tilt in the rover frame, or a single camera as it is."""
    from calib.files.any_camera import load_any
    from calib.files.mast_file import StoredRig

    source = load_any(args.file)
    if not isinstance(source, StoredRig):
        _, camera = camera_of(source, args.camera)
        show_notes(camera.notes)
        if args.pan is not None or args.tilt is not None:
            raise WrongUse(f"{args.file} has no mast; leave --pan and --tilt out")
        return camera.model
    show_notes(source.notes)
    name = named(args.camera, source.rig.cameras, source.path)
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
    check_file(args.out, "--out")
    arrays: dict[str, np.ndarray] = {}
    if args.pair is None:
        name, camera = camera_of(load_any(args.file), args.camera)
        show_notes(camera.notes)
        new = ideal_camera(camera.model, args.focal_px)
        frame, made = camera.frame, [("", name, new, maps_between(new, camera.model))]
    else:
        if args.camera is not None:
            raise WrongUse("--camera and --pair: one of them is expected")
        stored = read_mast_file(args.file)
        names = _pair(stored, args.pair)
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
    option("--crop X Y WIDTH HEIGHT", "the part of the calibrated picture that is read", type=int),
    option("--bin N...", "pixels that make one, after the crop: one number, or across and down", default=[1]),
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
    name = named(args.camera, stored.rig.cameras, stored.path)
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
        show_line(f"which part of the sensor {name} then shows is not known: its sensor_mode is left out")
    written = save_rig(replace(rig, provenance={**rig.provenance, "modes": noted}), args.out)
    document = {"out": str(args.out), "camera": name, "size_px": list(size_px), "mode": str(mode)}
    return Answer(
        document | {"digest": written.digest},
        f"{args.out}: {name} with {mode}: {size_px[0]}x{size_px[1]} px",
    )

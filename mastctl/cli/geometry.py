"""Commands on a mast file alone, no rover needed: solve, triangulate, handoff; and the error budget."""

from __future__ import annotations

import argparse
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli.options import command, option, positive_number
from mastctl.cli.output import Answer, WrongUse, tables_at, tell

if TYPE_CHECKING:
    from calib.files import CameraFile
    from calib.files.mast_file import StoredRig
    from calib.geometry.handoff import Handoff
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
    camera = stored.rig.cameras[camera_name(stored, args.camera)]
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
    rig, pair = stored.rig, stereo_pair(stored, args.pair)
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
    rig, pair = stored.rig, stereo_pair(stored, args.source)
    if args.to not in rig.stereo and args.to not in rig.cameras:
        known = nearest_of(args.to, [*rig.stereo, *rig.cameras])
        raise WrongUse(f"no stereo pair or camera '{args.to}' in {args.mast}; {known}")
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
    return Answer(_as_json(done))


def _as_json(done: Handoff) -> dict[str, Any]:
    return {
        "pixels": {
            name: None
            if seen is None
            else {
                "x_px": seen.pixel_px[0],
                "y_px": seen.pixel_px[1],
                "covariance_px2": seen.covariance_px2,
                "search_px2": seen.search_px2,
            }
            for name, seen in done.pixels.items()
        },
        "reasons": done.reasons,
        "position_m": done.seen.position_m,
        "covariance_m2": done.covariance_m2,
        "ray_gap_m": done.seen.ray_gap_m,
        "ray_gap_sigmas": done.gap.sigmas,
        "across_px": done.gap.across_px,
        "pan_rad": done.pan_rad,
        "tilt_rad": done.tilt_rad,
    }


def read_mast_file(path: Path) -> StoredRig:
    """Read a mast file, with its notes on stderr, for stdout holds the result."""
    from calib.files.mast_file import load_rig

    stored = load_rig(path)
    tell_notes(stored.notes)
    return stored


def tell_notes(notes: Iterable[str]) -> None:
    """Write on stderr what reading a file changed."""
    for note in notes:
        tell(note)


def camera_name(stored: StoredRig, name: str | None) -> str:
    """Return the camera of this name, the only one by default. Raises WrongUse."""
    return _named(name, stored.rig.cameras, str(stored.path))


def _named(name: str | None, cameras: Collection[str], where: str) -> str:
    if name is None and len(cameras) == 1:
        return next(iter(cameras))
    if name is None:
        known = f"--camera with one of {', '.join(cameras)}" if cameras else "one is expected"
        raise WrongUse(f"{where} holds {len(cameras)} cameras; {known}")
    if name not in cameras:
        raise WrongUse(f"no camera '{name}' in {where}; {nearest_of(name, cameras)}")
    return name


def stereo_pair(stored: StoredRig, name: str) -> tuple[str, str]:
    """Return the cameras (left, right) of a stereo pair. Raises WrongUse."""
    stereo = stored.rig.stereo
    if name not in stereo:
        raise WrongUse(f"no stereo pair '{name}' in {stored.path}; {nearest_of(name, stereo)}")
    return stereo[name]


def need_joints(rig: Rig, name: str, args: argparse.Namespace) -> None:
    """Refuse a camera on the head without --pan and --tilt. Raises WrongUse."""
    if rig.cameras[name].on == "head" and (args.pan is None or args.tilt is None):
        raise WrongUse(f"camera '{name}' is on the head; --pan RAD and --tilt RAD are expected")


def nearest_of(name: str, known: Collection[str]) -> str:
    """Return the nearest of the known names, or all, as a hint."""
    from calib.files.yaml_text import nearest

    return nearest(name, list(known)) if known else "it has none"


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
        name = _named(name, source, str(next(iter(source.values())).path))
        return name, source[name]
    name = camera_name(source, name)
    camera = source.rig.cameras[name]
    provenance = {"mast_file_sha256": source.digest, **source.rig.provenance}
    left_out = ("the mast file's 'fit' is left out",) if source.rig.fit else ()
    return name, CameraFile(camera.model, camera.on, {}, provenance, source.notes + left_out)

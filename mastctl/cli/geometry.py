"""Commands on a mast file alone, no rover needed: solve, triangulate, handoff; and the error budget."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any

from mastctl.cli.mast_files import camera_name, nearest_of, need_joints, read_mast_file, stereo_pair
from mastctl.cli.options import command, option, positive_number
from mastctl.cli.output import Answer, Shown, WrongUse, tables_of

if TYPE_CHECKING:
    from calib.geometry.handoff import Handoff, Joints
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
    """Solve for the joint angles that bring a target in the rover frame onto a pixel."""
    from calib.geometry.pointing import solve

    stored = read_mast_file(args.mast)
    camera = stored.rig.cameras[camera_name(stored, args.camera)]
    if camera.on != "head":
        raise WrongUse(f"camera '{args.camera}' is on the rover's body; a camera on the head is expected")
    solutions = solve(
        stored.rig.mast, camera.model, args.target, args.pixel,
        from_pan_rad=args.from_pan, from_tilt_rad=args.from_tilt,
    )  # fmt: skip
    x, y = camera.model.image_center_px if args.pixel is None else args.pixel
    target = ", ".join(f"{value:g}" for value in args.target)
    rows = [
        (
            *(f"{angle:.9f}" for angle in (one.pan_rad, one.tilt_rad)),
            *(f"{math.degrees(angle):.4f}" for angle in (one.pan_rad, one.tilt_rad)),
            f"{one.range_m:.6f}",
        )
        for one in solutions
    ]
    shown = Shown(
        f"{stored.rig.name}: target ({target}) m on pixel ({x:g}, {y:g}) of {args.camera}",
        ("pan rad", "tilt rad", "pan deg", "tilt deg", "range m"),
        rows,
        ["best first; the mast's limits belong to a configuration and are not applied"],
    )
    return Answer({"solutions": solutions}, shown)


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
    seen, gap = clicked_point(
        rig, pair, args.pan or 0.0, args.tilt or 0.0, args.left, args.right,
        sigma_px=args.sigma_px, calibration=stored_covariance(rig),
    )  # fmt: skip
    sigmas_mm = [1e3 * math.sqrt(max(0.0, variance)) for variance in seen.covariance_m2.diagonal()]
    document = {
        "position_m": seen.position_m,
        "covariance_m2": seen.covariance_m2,
        "ray_gap_m": seen.ray_gap_m,
    }
    axes = zip("xyz", document["position_m"], sigmas_mm, strict=True)
    shown = Shown(
        f"{rig.name}: the point that {args.pair} sees, in the rover frame",
        ("", "m", "sigma mm"),
        [(axis, f"{value:.6f}", f"{sigma:.3f}") for axis, value, sigma in axes],
        [
            f"ray gap {1e3 * seen.ray_gap_m:.3f} mm, {gap.sigmas:.1f} sigma; "
            f"sigma from {args.sigma_px:g} px in each pixel coordinate"
        ],
    )
    return Answer(document, shown)


@command("budget")
def error_budget(args: argparse.Namespace) -> Answer:
    """Compute the paper's Table I."""
    from calib.geometry.stereo import target_approach_budget

    rows = [row._asdict() for row in target_approach_budget()]
    title = "Target approach from 10 m to 1 m, 3-sigma errors (Table I of the paper)"
    return Answer({"cameras": rows}, tables_of({title: rows}))


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
    """Hand a target over, geometrically, with the ellipse to search."""
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
    calibration = stored_covariance(rig)
    done = hand_off(
        rig, pair, to, joints, args.left, args.right,
        to_joints=_destination(args, joints),
        sigma_px=args.sigma_px, calibration=calibration,
    )  # fmt: skip
    return Answer(_as_json(done), _shown(args, rig, done))


def _destination(args: argparse.Namespace, joints: Joints) -> Joints | None:
    """The joint angles of the destination images; None where the head does not turn."""
    from calib.geometry.handoff import Joints

    pan = joints.pan_rad if args.to_pan is None else args.to_pan
    tilt = joints.tilt_rad if args.to_tilt is None else args.to_tilt
    return None if (pan, tilt) == (joints.pan_rad, joints.tilt_rad) else Joints(pan, tilt, joints.sigma_rad)


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


def _shown(args: argparse.Namespace, rig: Rig, done: Handoff) -> Shown:
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
    sources = ["clicks"] + ["joints"] * bool(args.sigma_joint) + ["calibration"] * ("covariance" in rig.fit)
    notes.append(f"3-sigma half axes of where to search, from {', '.join(sources)}; angle from x towards y")
    return Shown(
        f"{rig.name}: from {args.source} to {args.to}",
        ("camera", "x px", "y px", "search px", "angle deg"),
        rows,
        notes,
    )

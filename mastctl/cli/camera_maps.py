"""``mastctl camera maps``: maps for cv2.remap that take the lens out, or lay a pair's rows side by side."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.chosen_camera import chosen_camera
from mastctl.cli.mast_files import read_mast_file, stereo_pair
from mastctl.cli.output import positive_number

if TYPE_CHECKING:
    import numpy as np

    from calib.geometry.cahvor import CameraModel


def add_action(actions: Any) -> None:
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
    maps.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the maps, the new camera's matrix and vectors, and for a pair OpenCV's Q."""
    from calib.geometry.maps import ideal_camera, maps_between, rectified_pair
    from mastctl.cli.places import check_file

    if args.out.suffix != ".npz":
        raise output.WrongUse(f"--out {args.out}: a name that ends with .npz is expected")
    check_file(args.out, "--out")
    held: dict[str, np.ndarray] = {}
    if args.pair is None:
        name, camera = chosen_camera(args.file, args.camera)
        new = ideal_camera(camera.model, args.focal_px)
        maps = maps_between(new, camera.model)
        held |= {"map_x": maps.map_x, "map_y": maps.map_y, **_told(new, "")}
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
            held |= {f"{side}_map_x": maps.map_x, f"{side}_map_y": maps.map_y, **_told(new, f"{side}_")}
        frame, shown = left.on, dict(zip(names, (pair.left_maps, pair.right_maps), strict=True))
    _save(args.out, held)
    seen = {name: float((maps.map_x >= 0.0).mean()) for name, maps in shown.items()}
    if args.json:
        output.print_json({"out": str(args.out), "frame": frame, "arrays": sorted(held), "shown": seen})
        return 0
    sys.stdout.write(output.one_line(f"{args.out}: {', '.join(held)}; vectors in '{frame}'") + "\n")
    for name, part in seen.items():
        words = f"{name}: {100 * part:.0f} % of the new picture is shown by the old one"
        sys.stdout.write(output.one_line(words) + "\n")
    return 0


def _told(camera: CameraModel, before: str) -> dict[str, np.ndarray]:
    """The new camera: K (3, 3), and C, A, H, V (3,)."""
    import numpy as np

    cx, cy = camera.H @ camera.A, camera.V @ camera.A
    fx, fy = camera.focal_px
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return {f"{before}K": matrix, **{f"{before}{letter}": getattr(camera, letter) for letter in "CAHV"}}


def _save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    import io

    import numpy as np

    from calib.files.atomic import save_bytes

    held = io.BytesIO()
    np.savez_compressed(held, **arrays)  # type: ignore[arg-type]  # names are names
    save_bytes(path, held.getvalue())

"""``camera mode``: a mast file for a crop, binning or flip of the pictures that it was calibrated with."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from mastctl.cli import output
from mastctl.cli.mast_files import camera_name, read_mast_file
from mastctl.cli.output import at_least


def add_action(actions: Any) -> None:
    """Add ``mode`` to the actions of ``camera``."""
    mode = actions.add_parser(
        "mode", help="write a mast file for a crop, binning or flip of the calibrated pictures of a camera"
    )
    mode.add_argument("file", type=Path, metavar="MAST.yaml", help="the mast file as it was calibrated")
    mode.add_argument("--camera", metavar="NAME", help="which camera, where the file holds several")
    mode.add_argument(
        "--crop", nargs=4, type=int, metavar=("X", "Y", "WIDTH", "HEIGHT"),
        help="the part of the calibrated picture that is read, in its pixels",
    )  # fmt: skip
    mode.add_argument(
        "--bin", nargs="+", type=at_least(1), metavar="N", default=[1],
        help="so many pixels make one: one number, or one across and one down; after the crop",
    )  # fmt: skip
    mode.add_argument(
        "--flip",
        choices=("none", "horizontal", "vertical", "both"),
        default="none",
        help="after crop and binning",
    )
    mode.add_argument(
        "--size", nargs=2, type=at_least(1), metavar=("WIDTH", "HEIGHT"),
        help="of the camera's pictures, to be compared with what comes out",
    )  # fmt: skip
    mode.add_argument("--out", required=True, type=Path, metavar="NEW.yaml", help="the mast file to write")
    mode.set_defaults(run=camera_mode)


def camera_mode(args: argparse.Namespace) -> int:
    """Write the mast file of another mode."""
    from calib.files.mast_file import save_rig
    from calib.geometry.covariance import rig_in_mode
    from calib.geometry.mode import FLIPS, Mode

    if len(args.bin) > 2:
        raise output.WrongUse(f"--bin has {len(args.bin)} numbers where one or two are expected")
    stored = read_mast_file(args.file)
    name = camera_name(stored, args.camera)
    crop_px = None if args.crop is None else (args.crop[0], args.crop[1], args.crop[2], args.crop[3])
    mode = Mode(crop_px, (args.bin[0], args.bin[-1]), FLIPS[args.flip])
    calibrated_px = stored.rig.cameras[name].model.size_px
    rig = rig_in_mode(stored.rig, name, mode)
    size_px = rig.cameras[name].model.size_px
    if args.size is not None and size_px != tuple(args.size):
        raise output.CommandError("bad_mode", _other_size(args.size, size_px, calibrated_px, str(mode)))
    if not str(mode):
        raise output.WrongUse("--crop, --bin or --flip is expected: the calibrated mode needs no other file")
    if args.out.exists() and args.out.samefile(args.file):
        raise output.WrongUse(f"--out {args.out} is MAST.yaml itself, which a second run would change again")
    before = rig.provenance.get("modes", [])  # a free place: anything may stand there
    before = before if isinstance(before, list) else [] if before is None else [before]
    noted = [*before, {"camera": name, "of": stored.digest, "mode": str(mode)}]
    if stored.rig.cameras[name].sensor_mode is not None and rig.cameras[name].sensor_mode is None:
        output.tell(f"which part of the sensor {name} then shows is not known: its sensor_mode is left out")
    written = save_rig(replace(rig, provenance={**rig.provenance, "modes": noted}), args.out)
    told = {"out": str(args.out), "camera": name, "size_px": list(size_px), "mode": str(mode)}
    if args.json:
        output.print_json(told | {"digest": written.digest})
        return 0
    width, height = size_px
    sys.stdout.write(output.one_line(f"{args.out}: {name} with {mode}: {width}x{height} px") + "\n")
    return 0


def _other_size(asked: list[int], size_px: tuple[int, int], full_px: tuple[int, int], words: str) -> str:
    """Why pictures of a size are not those of a mode."""
    told = "{}x{} px".format(*asked)
    comes = (
        f"{words or 'the calibrated mode'} gives {size_px[0]}x{size_px[1]} px where the pictures have {told}"
    )
    across, down = (full / now for full, now in zip(full_px, asked, strict=True))
    if across == down and across == int(across) and across > 1:
        return f"{comes}; they may be binned by {int(across)} or cropped: say which with --bin or --crop"
    if across != down:
        return f"{comes}; no binning alone changes {full_px[0]}x{full_px[1]} px to that shape: say its --crop"
    return f"{comes}; a scale of 1/{across:g} is no binning, and how the camera makes it is not known"

"""``mastctl sim new``: a simulated rig of one's own, from a few numbers or as the twin of a mast file."""

from __future__ import annotations

import argparse
import math
import re
import sys
from pathlib import Path
from typing import Any

from mastctl.cli import output
from mastctl.cli.output import WrongUse, check_folder

MOST_BOARDS = 12
HEADS = ("ptu_d46_70", "dynamixel_x", "ph42")
_OF_NUMBERS = ("height", "baseline", "focal_px", "view_deg", "size", "name")


def add_parser(kinds: Any) -> None:
    """Add ``new`` to the kinds of ``sim``."""
    new = kinds.add_parser(
        "new",
        help="a simulated rover of one's own: config.yaml, mast.yaml (what the service believes) and "
        "true_rig.yaml (what is simulated)",
    )
    new.add_argument("folder", type=folder_name, metavar="FOLDER", help="where the three files go")
    new.add_argument(
        "--from", dest="mast_file", type=Path, metavar="MAST.yaml",
        help="the twin of this mast file: the file is believed, the true rig drawn from its covariance",
    )  # fmt: skip
    number = output.positive_number
    new.add_argument("--height", type=number, metavar="M", help="of the axes over the ground (default 1.5)")
    new.add_argument("--baseline", type=number, metavar="M", help="between the two cameras (default 0.2)")
    lens = new.add_mutually_exclusive_group()
    lens.add_argument(
        "--focal-px", type=number, metavar="PX", help="focal length (default 1.26 times the width)"
    )
    lens.add_argument("--view-deg", type=number, metavar="DEG", help="or the view across the picture")
    new.add_argument("--size", type=_size, metavar="WxH", help="of the pictures (default 1024x768)")
    new.add_argument("--name", metavar="NAME", help="of the rig (default new_rig)")
    new.add_argument("--head", choices=HEADS, help="default ptu_d46_70, or that of --wire")
    new.add_argument("--wire", metavar="DRIVER", help="drive the head through bytes by its real driver")
    new.add_argument(
        "--boards",
        type=output.at_least(0),
        default=0,
        metavar="N",
        help="dot boards about, at most 12",
    )
    new.add_argument("--speed", metavar="1|N|max", help="of the rover's clock (default 1)")
    new.add_argument(
        "--seed", type=output.at_least(0), default=1, metavar="S", help="of all that is drawn (default 1)"
    )
    new.add_argument("--force", action="store_true", help="replace files of a rig that are there")
    new.set_defaults(run=run)


def folder_name(text: str) -> Path:
    """Read a folder's name; an empty one (a variable that is not set) would be the current folder."""
    if not text.strip():
        raise argparse.ArgumentTypeError("the name is empty, a folder is expected ('.' is the current one)")
    return Path(text)


def run(args: argparse.Namespace) -> int:
    """Write the folder and tell what is in it."""
    import numpy as np

    from drivers.hardware import DeviceSettings, HardwareSettings, clock_for
    from drivers.sim.heads import head_settings
    from drivers.sim.pan_tilt import DEFAULT_HEADS, check_head
    from mastctl.packaged import driver_of_hardware
    from mastctl.setup.new_rig import built_rig
    from mastctl.setup.rig_folder import boards_about, check_empty, write_built, write_twin

    if args.mast_file is not None:
        for option in _OF_NUMBERS:
            if getattr(args, option) is not None:
                raise WrongUse(f"--{option.replace('_', '-')} stands beside --from; the mast file says it")
    simulation: dict[str, Any] = {"seed": args.seed, "samples": 2}
    for key in ("head", "wire"):
        if getattr(args, key) is not None:
            simulation[key] = getattr(args, key)
    if args.boards > MOST_BOARDS:
        raise WrongUse(f"--boards is {args.boards} where {MOST_BOARDS} at most have room")
    if args.boards:
        simulation["scene"] = {"boards": boards_about(args.boards)}
    if args.speed is not None:
        simulation["speed"] = args.speed if args.speed == "max" else _number(args.speed)
    clock_for(
        HardwareSettings(DeviceSettings(driver_of_hardware("simulated")), {}, simulation)
    )  # refuses a speed that is none here
    if args.wire is not None:
        if args.wire not in DEFAULT_HEADS:
            raise WrongUse(f"--wire is '{args.wire}', expected one of {', '.join(DEFAULT_HEADS)}")
        check_head(args.wire, head_settings(args.head or DEFAULT_HEADS[args.wire]))
    check_folder(args.folder, "FOLDER")
    check_empty(args.folder, args.force)
    if args.mast_file is not None:
        made = write_twin(args.mast_file, args.folder, simulation, args.seed)
    else:
        rig = built_rig(_numbers(args), np.random.default_rng([args.seed, 1]))
        made = write_built(rig, args.folder, simulation, args.seed)
    config = made.folder / "config.yaml"
    if args.json:
        output.print_json(
            {
                "config": str(config),
                "cameras": list(made.believed.cameras),
                "drawn_by": made.twin.by,
                "apart_px": made.twin.apart_px,
            }
        )
        return 0
    rows = [(name, f"{px:.2f}") for name, px in made.twin.apart_px.items()]
    if rows:
        output.print_table(
            f"{made.believed.name}: what the mast file is off by", ("camera", "at most, px at 5 m"), rows
        )
    if made.twin.by != "fit.covariance":
        from mastctl.setup.true_twin import STATED

        where = "" if args.mast_file is None else ", the mast file has no covariance"
        sys.stdout.write(f"drawn by stated sigmas{where}: {STATED}\n")
    sys.stdout.write(f"run it: mastctl run --config {config}; or at once: mastctl demo --config {config}\n")
    return 0


def _numbers(args: argparse.Namespace) -> Any:
    """The numbers of the command line, where given."""
    from mastctl.setup.new_rig import RigNumbers, focal_of

    given = {key: getattr(args, key) for key in ("focal_px", "name") if getattr(args, key) is not None}
    for key, option in (("height_m", "height"), ("baseline_m", "baseline"), ("size_px", "size")):
        if getattr(args, option) is not None:
            given[key] = getattr(args, option)
    width_px = given.get("size_px", RigNumbers.size_px)[0]
    if args.view_deg is not None:
        if not args.view_deg <= 110.0:
            raise WrongUse(f"--view-deg is {args.view_deg:g} where 1 to 110 degrees are expected")
        given["focal_px"] = focal_of(math.radians(args.view_deg), width_px)
    given.setdefault("focal_px", RigNumbers.focal_px * width_px / RigNumbers.size_px[0])
    return RigNumbers(**given)


def _size(text: str) -> tuple[int, int]:
    """``WxH`` of --size."""
    found = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"'{text}' where WIDTHxHEIGHT in pixels is expected")
    return int(found[1]), int(found[2])


def _number(text: str) -> Any:
    """A number of --speed; what is none is left to the simulation's own sentence."""
    try:
        return float(text)
    except ValueError:
        return text

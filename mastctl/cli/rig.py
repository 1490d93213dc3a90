"""A rig of one's own: made (``rig new``, ``rig sim new``), examined, accepted (``conform``)."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.options import at_least, command, not_empty, one_of, option, positive_number
from mastctl.cli.output import Answer, CommandError, Shown, WrongUse, check_folder

if TYPE_CHECKING:
    from drivers.registry import ProbedHead
    from mastctl.answers import Status
    from mastctl.conform.rig import Check

HEADS = "ptu_d46_70|dynamixel_x|ph42"
OUTCOMES = {"passed": "ok", "failed": "FAILED", "skipped": "-"}
MARKS = {"good": "✓", "unsure": "?", "bad": "✗"}
TWIN = "no head and no camera is plugged in: this is the simulated twin, which runs"


@command(
    "rig new",
    option("FOLDER", "where the files go"),
    option(
        "--port PORT",
        "query this line only, a device or URL; may be repeated (default: all USB adapters)",
        type=not_empty,
        repeat=True,
    ),
    option("--pan-id ID", "the servo that turns pan", type=at_least(0)),
    option("--tilt-id ID", "the servo that turns tilt", type=at_least(0)),
    option("--pan-deg LOW HIGH", "how far pan may turn, degrees", default=[-85.0, 85.0]),
    option("--tilt-deg LOW HIGH", "how far tilt may turn, degrees", default=[-40.0, 30.0]),
    option("--height M", "of the axes over the ground", default=1.0),
    option("--baseline M", "between the two cameras", default=0.1),
    option("--view-deg DEG", "the cameras' view across", default=60.0),
    help="query serial lines and cameras; write configuration, drawing, udev rules and next "
    "commands. Moves nothing, replaces nothing; without hardware it writes a simulated twin",
    example="rig --pan-deg -90 90 --tilt-deg -40 30",
)
def _new(args: argparse.Namespace) -> Answer:
    from mastctl.setup.doctor import ExaminedMachine
    from mastctl.setup.new_folder import RIG_FILES, find_plugged, write_rig, write_simulated
    from mastctl.setup.simulated_rig import RigNumbers, check_free

    check_folder(args.folder, "FOLDER")
    check_free(args.folder, RIG_FILES)
    found = find_plugged(args.port, ExaminedMachine(), output.show_line)
    for line in (*(f"found {one}" for one in found.summaries), *found.unused):
        output.show_line(line)
    if len(found.heads) > 1:
        ports = " and ".join(one.port for one in found.heads)
        raise CommandError("two_heads", f"heads answer at {ports}; --port names the one of this rig")
    head = found.heads[0] if found.heads else None
    if args.port and head is None:
        raise CommandError("no_head", f"no head: {'; '.join(found.unused)}; nothing is written")
    pan_id, tilt_id = _axes(args, head)
    numbers = RigNumbers(
        args.height, args.baseline, args.view_deg,
        pan_deg=tuple(args.pan_deg), tilt_deg=tuple(args.tilt_deg), pan_id=pan_id, tilt_id=tilt_id,
    )  # fmt: skip
    simulated = head is None and not found.cameras
    if simulated:
        output.show_line(TWIN)
        made = write_simulated(args.folder, found, numbers)
    else:
        made = write_rig(args.folder, found, head, numbers)
    for note in made.notes:
        output.show_line(note)
    document = {
        "heads": [one.summary for one in found.heads],
        "cameras": [one.summary for one in found.cameras],
        "unused": list(found.unused),
        "notes": list(made.notes),
        "simulated": simulated,
        "written": [str(args.folder / name) for name in made.files],
        "next": list(made.next),
    }
    written = f"written in {args.folder}: {', '.join(made.files)}"
    return Answer(document, [written, "next:", *(f"  {one}" for one in made.next)])


def _axes(args: argparse.Namespace, head: ProbedHead | None) -> tuple[int, int]:
    """Which servo turns pan, and which tilt: as the options say, else the lower id first. Raises WrongUse."""
    from drivers.servo_bus.bench import ServosOnLine

    ids = list(head.driven) if isinstance(head, ServosOnLine) else []
    if isinstance(head, ServosOnLine) and len(head.bauds) > 1:
        rates = " and ".join(map(str, head.bauds))
        message = (
            f"servos answer at {rates} baud, where one rate is expected (`mastctl rig servo set-id` with "
        )
        raise CommandError("rates", f"{message}--new-baud changes a servo's); nothing is written")
    wanted = (args.pan_id, args.tilt_id)
    for name, number in zip(("--pan-id", "--tilt-id"), wanted, strict=True):
        if number is not None and len(ids) > 1 and number not in ids:
            raise WrongUse(f"{name} is {number} where one of {', '.join(map(str, ids))} is expected")
    free = [number for number in dict.fromkeys(ids if len(ids) > 1 else [*ids, 1, 2]) if number not in wanted]
    pan, tilt = (free.pop(0) if number is None else number for number in wanted)
    if pan == tilt:
        raise WrongUse(f"--pan-id and --tilt-id are both {pan} where two servos are expected")
    return pan, tilt


def _size(text: str) -> tuple[int, int]:
    """Read ``WxH`` (argparse ``type``)."""
    found = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"'{text}' where WIDTHxHEIGHT in pixels is expected")
    return int(found[1]), int(found[2])


def _speed(text: str) -> float | str:
    """Read a number; the configuration judges any other text (argparse ``type``)."""
    try:
        return float(text)
    except ValueError:
        return text


SPEED = option("--speed SPEED", "of the rover's clock: 1, N, or max: nothing waits", type=_speed)
WIRE = option("--wire DRIVER", "drive the head through bytes by its real driver")


@command(
    "rig sim new",
    option("FOLDER", "where the three files go"),
    option(
        "--from MAST.yaml",
        "the twin of this mast file, instead of one of the numbers below: the file is believed, the true rig "
        "drawn from its covariance",
        dest="mast_file",
    ),
    option("--height M", "of the axes over the ground", default=1.5),
    option("--baseline M", "between the two cameras", default=0.2),
    option("--view-deg DEG", "the view across the picture", default=43.3),
    option("--size WxH", "of the pictures (default 1024x768)", type=_size, default=(1024, 768)),
    option(f"--head {HEADS}", "default ptu_d46_70, or that of --wire"),
    WIRE,
    SPEED,
    option("--seed SEED", "of all that is drawn", default=1),
    help="a simulated rover of one's own: config.yaml, mast.yaml (what the service believes) and "
    "true_rig.yaml (what is simulated)",
    example="twin --height 1.9 --baseline 0.42",
)
def _new_simulated(args: argparse.Namespace) -> Answer:
    import numpy as np

    from calib.files.mast_file import load_rig
    from drivers.sim.settings import simulation_settings
    from mastctl.setup.simulated_rig import RigNumbers, built_rig, check_free, write_rover

    simulation: dict[str, Any] = {"seed": args.seed, "samples": 2}
    given = {key: getattr(args, key) for key in ("head", "wire", "speed")}
    simulation |= {key: value for key, value in given.items() if value is not None}
    simulation_settings({"rover": "true_rig.yaml", **simulation}, args.folder)  # or refuses it
    check_folder(args.folder, "FOLDER")
    check_free(args.folder)
    if args.mast_file is not None:
        rig = load_rig(args.mast_file).rig
    else:
        numbers = RigNumbers(args.height, args.baseline, args.view_deg, args.size)
        rig = built_rig(numbers, np.random.default_rng([args.seed, 1]))
    twin = write_rover(rig, args.folder, simulation, args.seed, mast_file=args.mast_file)
    config = args.folder / "config.yaml"
    document = {
        "config": str(config), "cameras": list(twin.apart_px), "drawn_by": twin.by, "apart_px": twin.apart_px
    }  # fmt: skip
    rows = [(name, f"{px:.2f}") for name, px in twin.apart_px.items()]
    shown: list[str | Shown] = [Shown("what the mast file is off by", ("camera", "at most, px at 5 m"), rows)]
    if twin.by != "fit.covariance":
        from mastctl.setup.simulated_rig import STATED

        shown.append(f"drawn by {twin.by}, since no covariance is known: {STATED}")
    shown.append(f"run it: mastctl run --config {config}; or at once: mastctl demo --config {config}")
    return Answer(document, shown)


@command(
    "rig doctor",
    option("--config FILE", "configuration (default: the packaged simulated rover)", type=str),
    help="find what this machine lacks for a configuration; opens and moves nothing",
    example="--config rover.yaml",
)
def _doctor(args: argparse.Namespace) -> Answer:
    from mastctl.client import Client, ClientError
    from mastctl.setup.doctor import examine, next_command

    def status_at(url: str) -> Status | None:
        with suppress(ClientError), Client(url) as client:
            return client.status()
        return None

    found = list(examine(args.config, status_at))
    bad, unsure = (sum(one.level == level for one in found) for level in ("bad", "unsure"))
    following = next_command(args.config, found)
    document = {
        "bad": bad, "unsure": unsure, "findings": [vars(one) for one in found], "next": following
    }  # fmt: skip
    lines = []
    for one in found:
        lines.append(f"{MARKS[one.level]} {one.what}: {one.sentence}")
        lines += [f"    {one.advice}"] if one.advice else []
    verdict = f"{bad} to be mended before the daemon can work" if bad else "nothing stands in the way"
    lines += [f"{verdict}{f'; {unsure} to think about' if unsure else ''}", f"next: {following}"]
    return Answer(document, lines, 1 if bad else 0)


@command("schema", option("[NAME]", "config, mast, board ... (default: their list)"), example="config")
def _schema(args: argparse.Namespace) -> Answer | int:
    from mastctl.packaged import schema_files

    files = schema_files()
    if args.name is None:
        titles = {name: json.loads(file.read_bytes())["title"] for name, file in files.items()}
        return Answer({"schemas": titles})
    if args.name not in files:
        raise WrongUse(f"'{args.name}' is not a valid schema; there are {', '.join(files)}")
    sys.stdout.write(files[args.name].read_text(encoding="utf-8"))
    return 0


@command(
    "conform",
    option("URL", "a running daemon's address"),
    one_of(
        option("--motion", "move the head, also a real one", default=None),
        option("--no-motion", "only checks that move nothing", dest="motion", action="store_false"),
    ),
    option(
        "--reach RAD",
        "how far from its present pose the head is moved (default 0.3 rad)",
        type=positive_number,
        default=0.3,
    ),
    option("--only CHECK", "a check, or all of a group; may be given often", repeat=True),
    example="http://127.0.0.1:8420",
)
def _conform(args: argparse.Namespace) -> Answer:
    from mastctl.conform.rig import check_rig, rig_under_test
    from mastctl.conform.rig_checks import RIG

    checks = _chosen(RIG, args.only)
    with rig_under_test(args.url, args.reach) as rig:
        motion = _may_move(args, checks, bool(rig.began.get("simulated")))
        report = check_rig(rig, checks, motion, (lambda outcome: None) if args.json else _show)
    counts = ", ".join(f"{report[state]} {state}" for state in OUTCOMES)
    verdict = "conforms" if report["conforms"] else "does not conform"
    return Answer(report, f"daemon {report['subject']} {verdict}: {counts}", int(not report["conforms"]))


def _may_move(args: argparse.Namespace, checks: Sequence[Check], simulated: bool) -> bool:
    """Whether the head may be moved: a simulated one may, any other by the options. Raises WrongUse."""
    if args.motion is not None:
        return bool(args.motion)
    if not simulated and any(check.moves for check in checks):
        moved = f"the head at {args.url} would be moved by up to {args.reach:g} rad from its present pose"
        raise WrongUse(f"{moved}: --motion allows it, --no-motion leaves those checks out")
    return True


def _chosen(checks: Sequence[Check], names: Sequence[str]) -> list[Check]:
    """The checks that --only names, by name or group; all without it. Raises WrongUse."""
    if not names:
        return list(checks)
    for name in names:
        if not any(name in (check.name, check.name.partition(".")[0]) for check in checks):
            groups = ", ".join(dict.fromkeys(check.name.partition(".")[0] for check in checks))
            raise WrongUse(f"--only {name}: no such check; groups are {groups}")
    return [c for c in checks if c.name in names or c.name.partition(".")[0] in names]


def _show(outcome: dict[str, Any]) -> None:
    """Show a check that has ended, in one line."""
    promise = outcome["promise"] if outcome["state"] == "passed" else ""
    measured = f" ({outcome['message']})" if promise and outcome["message"] else outcome["message"]
    line = output.one_line(f"{promise}{measured}")
    sys.stdout.write(f"{OUTCOMES[outcome['state']]:6} {outcome['name']:22} {line}\n")
    sys.stdout.flush()

"""A rig of one's own: ``rig new`` of what is plugged in, ``rig sim new``, ``rig doctor``, and ``schema``."""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.options import at_least, command, one_of, option
from mastctl.cli.output import Answer, CommandError, Shown, WrongUse, check_folder

if TYPE_CHECKING:
    from drivers.probes import ProbedHead
    from mastctl.answers import Status
    from mastctl.setup.drawing import RigAnswers
    from mastctl.setup.plugged import Plugged
    from mastctl.setup.questions import Prompts

NOTHING = "no head and no camera is plugged in; write a simulated twin, which runs"
TWIN_DEG = {"pan": 175.0, "tilt": 90.0}
"""The reach of the simulated head to each side."""
LEAST_DEG = 15.0
"""Between the ends of an axis: both keep a margin (`mastctl.setup.drawing.MARGIN_RAD`)."""
MOST_BOARDS = 12
HEADS = "ptu_d46_70|dynamixel_x|ph42"
OF_NUMBERS = ("height", "baseline", "focal_px", "view_deg", "size", "name")
MARKS = {"good": "✓", "unsure": "?", "bad": "✗"}


def _port(text: str) -> str:
    """Read a line's name; an empty one (a variable that is not set) would be the current folder."""
    if not text.strip():
        raise argparse.ArgumentTypeError("the name is empty, a device or URL is expected")
    return text


@command(
    "rig new",
    option("FOLDER", "where the files go"),
    option(
        "--port PORT",
        "query this line only, a device or URL; may be repeated (default: all USB adapters)",
        type=_port,
        repeat=True,
    ),
    option("--pan-id ID", "the servo that turns pan", type=at_least(0)),
    option("--tilt-id ID", "the servo that turns tilt", type=at_least(0)),
    option("--pan-deg LOW HIGH", "how far pan may turn, degrees (default -85 85)"),
    option("--tilt-deg LOW HIGH", "how far tilt may turn, degrees (default -40 30)"),
    option("--height M", "of the axes over the ground (default 1)"),
    option("--baseline M", "between the two cameras (default 0.1)"),
    option("--view-deg DEG", "the cameras' view across (default 60)"),
    help="query serial lines and cameras; write configuration, drawing, udev rules and next "
    "commands. Moves nothing, replaces nothing; without hardware it writes a simulated twin",
    example="rig --pan-deg -90 90 --tilt-deg -40 30",
)
def _new(args: argparse.Namespace) -> Answer:
    """Query, ask, write, and return the next commands."""
    from drivers.servo_bus.bench import ServosOnLine
    from mastctl.setup.machine import ExaminedMachine
    from mastctl.setup.new_folder import check_free, write_rig, write_simulated
    from mastctl.setup.plugged import find_plugged
    from mastctl.setup.questions import Prompts

    check_folder(args.folder, "FOLDER")
    check_free(args.folder)
    machine = ExaminedMachine()
    questions = Prompts(terminal=False if args.json else None)
    found = find_plugged(args.port, machine, output.tell)
    for line in (*(f"found {one}" for one in found.summaries), *found.unused):
        output.tell(line)
    head = _head(found, questions)
    if args.port and head is None:
        raise CommandError("no_head", f"no head: {'; '.join(found.unused)}; nothing is written")
    rates = head.bauds if isinstance(head, ServosOnLine) else []
    if len(rates) > 1:
        change = "`mastctl rig servo set-id` with --new-baud changes a servo's"
        answering = f"servos answer at {' and '.join(map(str, rates))} baud"
        message = f"{answering}, where one rate is expected ({change}); nothing is written"
        raise CommandError("rates", message)
    none = head is None and not found.cameras
    if none and questions.one_of(NOTHING, ("yes", "no"), "yes") == "no":
        return Answer({"written": []}, "nothing is written; plug the head in and try again")
    if none and (args.pan_id is not None or args.tilt_id is not None):
        output.tell("--pan-id and --tilt-id are not used: the simulated twin's servos are 1 and 2")
    answers = _answers(args, found, head, questions)
    if none:
        output.tell("no head and no camera is plugged in: this is the simulated twin, which runs")
        made = write_simulated(args.folder, found, answers)
    else:
        made = write_rig(args.folder, found, head, answers, machine)
    written = ", ".join(made.files)
    document = {
        "heads": [one.summary for one in found.heads],
        "cameras": [one.summary for one in found.cameras],
        "unused": list(found.unused),
        "notes": list(made.notes),
        "simulated": made.simulated,
        "written": [str(made.folder / name) for name in made.files],
        "next": list(made.next),
    }
    if not args.json:
        for note in made.notes:
            output.tell(note)
    return Answer(
        document, [f"written in {made.folder}: {written}", "next:", *(f"  {one}" for one in made.next)]
    )


def _head(found: Plugged, questions: Prompts) -> ProbedHead | None:
    """The head of the rig, of those that can be one."""
    heads = found.heads
    if len(heads) < 2:
        return heads[0] if heads else None
    ports = [one.port for one in heads]
    port = questions.one_of("which line is the head's", ports, ports[0])
    return heads[ports.index(port)]


def _answers(
    args: argparse.Namespace, found: Plugged, head: ProbedHead | None, questions: Prompts
) -> RigAnswers:
    """The values of the options, else of the person at the terminal, else the usual ones."""
    from drivers.servo_bus.bench import ServosOnLine
    from mastctl.setup.drawing import RigAnswers

    usual = RigAnswers()
    ids = list(head.driven) if isinstance(head, ServosOnLine) else []
    pan_id, tilt_id = _axes(args, ids, questions)
    ask = questions.number

    def number(option: float | None, question: str, value: float, low: float, high: float) -> float:
        if option is None:
            return ask(question, value, low, high)
        if not low <= option <= high:
            raise WrongUse(f"{question}: {option:g} where {low:g} to {high:g} is expected")
        return option

    none = head is None and not found.cameras
    ends = {}
    for axis, (low, high) in {"pan": usual.pan_deg, "tilt": usual.tilt_deg}.items():
        given = getattr(args, f"{axis}_deg")
        least, most = given if given is not None else (None, None)
        end = TWIN_DEG[axis] if none else 175.0
        from_deg = number(least, f"{axis} may turn from, degrees", low, -end, end - LEAST_DEG)
        lowest_deg = from_deg + LEAST_DEG
        to_deg = number(most, f"{axis} may turn to, degrees", max(high, lowest_deg), lowest_deg, end)
        ends[axis] = from_deg, to_deg
    return RigAnswers(
        height_m=number(args.height, "height of the axes over the ground, m", usual.height_m, 0.3, 5.0),
        baseline_m=number(args.baseline, "distance of the two cameras, m", usual.baseline_m, 0.02, 1.0)
        if none or len(found.cameras) > 1
        else usual.baseline_m,
        view_deg=number(args.view_deg, "the cameras' view across, degrees", usual.view_deg, 5.0, 110.0)
        if none or found.cameras
        else usual.view_deg,
        pan_deg=ends["pan"],
        tilt_deg=ends["tilt"],
        pan_id=pan_id,
        tilt_id=tilt_id,
    )


def _axes(args: argparse.Namespace, ids: list[int], questions: Prompts) -> tuple[int, int]:
    """Which servo turns pan, and which tilt."""
    usual = ids if len(ids) > 1 else [*ids, *(number for number in (1, 2) if number not in ids)]
    pan, tilt = args.pan_id, args.tilt_id
    for given, number in (("--pan-id", pan), ("--tilt-id", tilt)):
        if number is not None and len(ids) > 1 and number not in ids:
            raise WrongUse(f"{given} is {number} where one of {', '.join(map(str, ids))} is expected")
    if pan is None:
        pan = next(number for number in usual if number != tilt)
        if len(ids) > 1:
            pan = int(questions.one_of("which servo turns pan", [str(one) for one in ids], str(pan)))
    if tilt is None:
        rest = [number for number in usual if number != pan]
        tilt = rest[0]
        if len(rest) > 1:
            tilt = int(questions.one_of("which servo turns tilt", [str(one) for one in rest], str(tilt)))
    if pan == tilt:
        raise WrongUse(f"--pan-id and --tilt-id are both {pan} where two servos are expected")
    return pan, tilt


def _size(text: str) -> tuple[int, int]:
    """Read ``WxH`` (argparse ``type``)."""
    found = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"'{text}' where WIDTHxHEIGHT in pixels is expected")
    return int(found[1]), int(found[2])


@command(
    "rig sim new",
    option("FOLDER", "where the three files go"),
    option(
        "--from MAST.yaml",
        "the twin of this mast file: the file is believed, the true rig drawn from its covariance",
        dest="mast_file",
    ),
    option("--height M", "of the axes over the ground (default 1.5)"),
    option("--baseline M", "between the two cameras (default 0.2)"),
    one_of(
        option("--focal-px PX", "focal length (default 1.26 times the width)"),
        option("--view-deg DEG", "or the view across the picture"),
    ),
    option("--size WxH", "of the pictures (default 1024x768)", type=_size),
    option("--name NAME", "of the rig (default new_rig)"),
    option(f"--head {HEADS}", "default ptu_d46_70, or that of --wire"),
    option("--wire DRIVER", "drive the head through bytes by its real driver"),
    option("--boards N", "dot boards about, at most 12", type=at_least(0), default=0),
    option("--speed SPEED", "of the rover's clock: 1, N or max (default 1)"),
    option("--seed SEED", "of all that is drawn", default=1),
    option("--force", "replace files of a rig that are there"),
    help="a simulated rover of one's own: config.yaml, mast.yaml (what the service believes) and "
    "true_rig.yaml (what is simulated)",
    example="twin --height 1.9 --baseline 0.42",
)
def _new_simulated(args: argparse.Namespace) -> Answer:
    import numpy as np

    from drivers.hardware import DeviceSettings, HardwareSettings, clock_for
    from drivers.sim.heads import DEFAULT_HEADS, check_head, head_settings
    from mastctl.packaged import driver_of_hardware
    from mastctl.setup.new_rig import built_rig
    from mastctl.setup.rig_folder import boards_about, check_empty, write_built, write_twin

    if args.mast_file is not None:
        for name in OF_NUMBERS:
            if getattr(args, name) is not None:
                raise WrongUse(f"--{name.replace('_', '-')} is beside --from; the mast file has it")
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
    document = {
        "config": str(config),
        "cameras": list(made.believed.cameras),
        "drawn_by": made.twin.by,
        "apart_px": made.twin.apart_px,
    }
    rows = [(name, f"{px:.2f}") for name, px in made.twin.apart_px.items()]
    title = f"{made.believed.name}: what the mast file is off by"
    shown: list[str | Shown] = [Shown(title, ("camera", "at most, px at 5 m"), rows)] if rows else []
    if made.twin.by != "fit.covariance":
        from mastctl.setup.true_twin import STATED

        where = "" if args.mast_file is None else ", the mast file has no covariance"
        shown.append(f"drawn by stated sigmas{where}: {STATED}")
    shown.append(f"run it: mastctl run --config {config}; or at once: mastctl demo --config {config}")
    return Answer(document, shown)


def _numbers(args: argparse.Namespace) -> Any:
    """The numbers of the options that are given."""
    from mastctl.setup.new_rig import RigNumbers, focal_of

    given = {key: getattr(args, key) for key in ("focal_px", "name") if getattr(args, key) is not None}
    for key, name in (("height_m", "height"), ("baseline_m", "baseline"), ("size_px", "size")):
        if getattr(args, name) is not None:
            given[key] = getattr(args, name)
    width_px = given.get("size_px", RigNumbers.size_px)[0]
    if args.view_deg is not None:
        if not args.view_deg <= 110.0:
            raise WrongUse(f"--view-deg is {args.view_deg:g} where 1 to 110 degrees are expected")
        given["focal_px"] = focal_of(math.radians(args.view_deg), width_px)
    given.setdefault("focal_px", RigNumbers.focal_px * width_px / RigNumbers.size_px[0])
    return RigNumbers(**given)


def _number(text: str) -> Any:
    """A number of --speed; any other text is refused by the simulation itself."""
    try:
        return float(text)
    except ValueError:
        return text


@command(
    "rig doctor",
    option("--config FILE", "configuration (default: the packaged simulated rover)", type=str),
    help="find what this machine lacks for a configuration; opens and moves nothing",
    example="--config rover.yaml",
)
def _doctor(args: argparse.Namespace) -> Answer:
    from mastctl.setup.doctor import examine, next_command

    found = list(examine(args.config, _status))
    bad = sum(finding.level == "bad" for finding in found)
    unsure = sum(finding.level == "unsure" for finding in found)
    following = next_command(args.config, found)
    document = {
        "bad": bad,
        "unsure": unsure,
        "findings": [vars(finding) for finding in found],
        "next": following,
    }

    def lines() -> Iterator[str]:
        for finding in found:
            yield f"{MARKS[finding.level]} {finding.what}: {finding.sentence}"
            if finding.advice:
                yield f"    {finding.advice}"
        verdict = f"{bad} to be mended before the daemon can work" if bad else "nothing stands in the way"
        yield f"{verdict}{f'; {unsure} to think about' if unsure else ''}"
        yield f"next: {following}"

    return Answer(document, lines(), 1 if bad else 0)


def _status(url: str) -> Status | None:
    """The status of a daemon, if one answers."""
    from mastctl.client import Client, ClientError

    try:
        with Client(url) as client:
            return client.status()
    except ClientError:
        return None


@command("schema", option("[NAME]", "config, mast, board ... (default: their list)"), example="config")
def _schema(args: argparse.Namespace) -> Answer | int:
    from mastctl.packaged import schema_files

    files = schema_files()
    if args.name is None:
        return Answer(
            {"schemas": {name: json.loads(file.read_bytes())["title"] for name, file in files.items()}}
        )
    if args.name not in files:
        raise WrongUse(f"'{args.name}' is not a valid schema; there are {', '.join(files)}")
    sys.stdout.write(files[args.name].read_text(encoding="utf-8"))
    return 0

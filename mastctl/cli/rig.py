"""``mastctl rig new``: the files of a rig of one's own, of what is plugged in."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import CommandError, WrongUse, at_least, check_folder, finite_number, positive_number
from mastctl.cli.sim_new import folder_name

if TYPE_CHECKING:
    from drivers.probes import ProbedHead
    from mastctl.rig.drawing import RigAnswers
    from mastctl.rig.plugged import Plugged
    from mastctl.rig.questions import Prompts


NOTHING = "no head and no camera is plugged in; write a simulated twin, which runs"
TWIN_DEG = {"pan": 175.0, "tilt": 90.0}
"""The reach of the simulated head to each side."""
LEAST_DEG = 15.0
"""Between the ends of an axis: both keep a margin (`mastctl.rig.drawing.MARGIN_RAD`)."""


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add rig with new."""
    rig = subparsers.add_parser("rig", help="write the files of a rig of your own")
    verbs = rig.add_subparsers(dest="verb", metavar="VERB", required=True)
    new = verbs.add_parser(
        "new",
        help="ask serial lines and cameras what they are; write configuration, drawing, udev rules and next "
        "commands. Moves nothing, replaces nothing; without hardware it writes a simulated twin",
    )
    new.add_argument("folder", type=folder_name, metavar="FOLDER", help="where the files go")
    new.add_argument(
        "--port", action="append", default=[], type=_port, metavar="PORT",
        help="ask this line only, a device or URL; may be repeated (default: all USB adapters)",
    )  # fmt: skip
    number = at_least(0)
    new.add_argument("--pan-id", type=number, metavar="ID", help="the servo that turns pan")
    new.add_argument("--tilt-id", type=number, metavar="ID", help="the servo that turns tilt")
    for axis, usual in (("pan", "-85 85"), ("tilt", "-40 30")):
        new.add_argument(
            f"--{axis}-deg", nargs=2, type=finite_number, metavar=("LOW", "HIGH"),
            help=f"how far {axis} may turn, degrees (default {usual})",
        )  # fmt: skip
    new.add_argument(
        "--height", type=positive_number, metavar="M", help="of the axes over the ground (default 1)"
    )
    new.add_argument(
        "--baseline", type=positive_number, metavar="M", help="between the two cameras (default 0.1)"
    )
    new.add_argument(
        "--view-deg", type=positive_number, metavar="DEG", help="the cameras' view across (default 60)"
    )
    new.set_defaults(run=_new)


def _port(text: str) -> str:
    """Read a line's name; an empty one (a variable that is not set) would be the current folder."""
    if not text.strip():
        raise argparse.ArgumentTypeError("the name is empty, a device or URL is expected")
    return text


def _new(args: argparse.Namespace) -> int:
    """Look, ask, write, and say what is next."""
    from drivers.servo_bus.bench import ServosOnLine
    from mastctl.rig.folder import check_free, write_rig, write_simulated
    from mastctl.rig.plugged import look
    from mastctl.rig.questions import Prompts
    from mastctl.setup.machine import ExaminedMachine

    check_folder(args.folder, "FOLDER")
    check_free(args.folder)
    machine = ExaminedMachine()
    questions = Prompts(terminal=False if args.json else None)
    found = look(args.port, machine, output.tell)
    for words in found.words:
        output.tell(f"found {words}")
    for words in found.unused:
        output.tell(words)
    head = _head(found, questions)
    if args.port and head is None:
        raise CommandError("no_head", f"no head: {'; '.join(found.unused)}; nothing is written")
    rates = head.bauds if isinstance(head, ServosOnLine) else []
    if len(rates) > 1:
        told = " and ".join(map(str, rates))
        change = "`mastctl servo set-id` with --new-baud changes a servo's"
        words = f"servos answer at {told} baud, where one rate is expected ({change}); nothing is written"
        raise CommandError("rates", words)
    none = head is None and not found.cameras
    if none and questions.one_of(NOTHING, ("yes", "no"), "yes") == "no":
        output.tell("nothing is written; plug the head in and try again")
        return 0
    if none and (args.pan_id is not None or args.tilt_id is not None):
        output.tell("--pan-id and --tilt-id are not used: the simulated twin's servos are 1 and 2")
    answers = _answers(args, found, head, questions)
    if none:
        output.tell("no head and no camera is plugged in: this is the simulated twin, which runs")
        made = write_simulated(args.folder, found, answers)
    else:
        made = write_rig(args.folder, found, head, answers, machine)
    if args.json:
        output.print_json(
            {
                "heads": [one.summary for one in found.heads],
                "cameras": [one.summary for one in found.cameras],
                "unused": list(found.unused),
                "notes": list(made.notes),
                "simulated": made.simulated,
                "written": [str(made.folder / name) for name in made.files],
                "next": list(made.next),
            }
        )
        return 0
    for words in made.notes:
        output.tell(words)
    sys.stdout.write(output.one_line(f"written in {made.folder}: {', '.join(made.files)}") + "\n")
    sys.stdout.write("next:\n" + "".join(f"  {step}\n" for step in made.next))
    return 0


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
    """What the options say, else the person at the terminal, else what is usual."""
    from drivers.servo_bus.bench import ServosOnLine
    from mastctl.rig.drawing import RigAnswers

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
    for option, number in (("--pan-id", pan), ("--tilt-id", tilt)):
        if number is not None and len(ids) > 1 and number not in ids:
            raise WrongUse(f"{option} is {number} where one of {', '.join(map(str, ids))} is expected")
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

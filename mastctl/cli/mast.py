"""``mastctl mast``: the mast file of a running daemon; ``mastctl fault``: a simulated rover's faults."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import WrongUse, finite_number
from mastctl.cli.places import check_file
from mastctl.cli.service import add_daemon_options, client_of, tell_result

if TYPE_CHECKING:
    from mastctl.client.answers import FaultSet, MastsTold


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add mast and fault."""
    mast = subparsers.add_parser("mast", help="the mast file that a running daemon points by")
    acts = mast.add_subparsers(dest="act", required=True, metavar="ACT")
    show = acts.add_parser("show", help="show which is in use, and which was before")
    show.add_argument("--out", metavar="FILE", help="write it there too, byte for byte")
    show.set_defaults(run=_show)
    use = acts.add_parser("use", help="use another of the same folder; pictures taken before are refused")
    use.add_argument("file", metavar="NAME", help="its name, without a folder")
    use.set_defaults(run=_use)
    back = acts.add_parser("back", help="go back to the one that was in use before")
    back.set_defaults(run=_back)

    fault = subparsers.add_parser("fault", help="the faults of a simulated rover")
    switches = fault.add_subparsers(dest="act", required=True, metavar="ACT")
    every = switches.add_parser("list", help="show which are switched on")
    every.set_defaults(run=_faults)
    begin = switches.add_parser("set", help="switch one on")
    begin.add_argument("device", metavar="DEVICE", help="pan_tilt, a camera, ... (docs/how-to/simulation.md)")
    begin.add_argument("word", metavar="WORD", help="what goes wrong: off, stuck, dark, ...")
    begin.add_argument("parameters", nargs="*", metavar="NAME=VALUE", help="how much of it")
    begin.set_defaults(run=_set)
    clear = switches.add_parser("clear", help="switch those of a device off, or all")
    clear.add_argument("device", nargs="?", metavar="DEVICE")
    clear.set_defaults(run=_clear)
    for one in (show, use, back, every, begin, clear):
        add_daemon_options(one)


def _show(args: argparse.Namespace) -> int:
    if args.out is not None:
        check_file(Path(args.out), "--out")
    with client_of(args) as client:
        status = client.status()
        if args.out is not None:
            Path(args.out).write_bytes(client.mast_file())
    return _tell(args, {"mast": status["mast"], "former_mast": status["former_mast"]})


def _use(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        return _tell(args, client.use_mast(args.file))


def _back(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        return _tell(args, client.use_former_mast())


def _tell(args: argparse.Namespace, masts: MastsTold) -> int:
    now, former = masts["mast"], masts["former_mast"]
    words = f"{now['file']} ({now['name']}, {now['digest'][:8]}...)"
    if former is not None:
        words += f", before {former['file']} ({former['digest'][:8]}...)"
    tell_result(args, masts, words)
    return 0


def _faults(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        return _tell_faults(args, client.faults())


def _set(args: argparse.Namespace) -> int:
    parameters = dict(_parameter(words) for words in args.parameters)
    with client_of(args) as client:
        return _tell_faults(args, client.set_fault(args.device, args.word, **parameters))


def _clear(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        client.clear_faults(args.device)
        return _tell_faults(args, client.faults())


def _parameter(words: str) -> tuple[str, float]:
    """``NAME=VALUE``."""
    name, equals, value = words.partition("=")
    try:
        if equals and name.isidentifier():
            return name, finite_number(value)
    except argparse.ArgumentTypeError:
        pass
    raise WrongUse(f"'{words}' where NAME=VALUE with a finite number is expected, such as sigma=8")


def _tell_faults(args: argparse.Namespace, faults: list[FaultSet]) -> int:
    if args.json:
        output.print_json({"faults": faults})
        return 0
    lines = [" ".join((one["device"], one["word"], *_parameters(one))) for one in faults]
    tell_result(args, {}, "; ".join(lines) or "no fault is switched on")
    return 0


def _parameters(fault: FaultSet) -> list[str]:
    return [f"{name}={value:g}" for name, value in fault["parameters"].items()]

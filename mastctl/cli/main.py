"""The entry point of the command line: choose the command, run it, print its answer or a refusal in one line.

Exit codes: 0 success, 2 wrong use or bad input, 1 failure, 130 interrupted (128 and the number of the signal
that ended it), 141 where the reader of the output is gone.
Only the modules of the command that is wanted are imported; a module imports what is
slow (numpy, cv2, numba, fastapi) inside its functions.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import io
import logging
import os
import signal
import sys
import threading
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any, NoReturn

from mastctl import signals
from mastctl.cli import output
from mastctl.cli.options import DECLARED, GROUPS, CommandLine, Parser, add_options
from mastctl.logs import TEXT, QueuedHandler, queued

log = logging.getLogger(__name__)

OVERVIEW: Mapping[str, Mapping[str, tuple[str, str]]] = {
    "a running daemon and its mast": {
        "run": ("service", "run the daemon; its address is a line on stdout when it is ready"),
        "status": ("service", "show the state of a daemon, its operations or events"),
        "point": ("steering", "point a camera at something and measure the residual, or jog"),
        "track": ("steering requests", "follow a target while the rover moves"),
        "panorama": ("panorama requests", "take a panorama, any pixel of which points the mast"),
        "snapshot": ("service", "take a picture and write it to a file"),
        "record": ("service requests", "begin and end a recording; list, inspect, repair and replay them"),
        "stop": ("daemon", "stop the mast at once; --without-daemon if that is dead"),
        "estop": ("daemon", "stop the mast at once; nothing moves it until 'mastctl reset'"),
        "reset": ("daemon", "release an emergency stop; nothing moves by that"),
    },
    "geometry, on files": {
        "camera": ("geometry cameras requests", "camera files, and cameras on this machine"),
        "solve": ("geometry", "the true joint angles that bring a target onto a pixel"),
        "triangulate": ("geometry", "the point that a stereo pair sees, with covariance"),
        "handoff": ("geometry", "where a target seen by one stereo pair falls in another"),
        "budget": ("geometry", "the paper's error budget (Table I) from its formulas"),
    },
    "calibration and acceptance": {
        "board": ("board", "a board to calibrate with: make one, measure it, find it"),
        "calibrate": ("calibrate", "fit a mast file to a survey; 'calibrate bench': to a board"),
        "calibrate bench": ("calibrate", ""),
        "conform": ("rig", "accept a rig through its running daemon"),
    },
    "a rig of your own": {
        "rig": (
            "rig requests servos",
            "write a rig's files; its servos, lease, tokens, mast file, drift",
        ),
        "schema": ("rig", "print the JSON Schema of a file that people write"),
        "ros2": ("service", "a ROS 2 node of a running daemon, until Ctrl-C"),
    },
    "the paper's experiments": {
        "demo": ("experiment", "the pointing experiment on the packaged simulated rover"),
        "experiment": ("experiment", "pointing, handoff, approach or calibration"),
    },
}
"""Headings of ``mastctl --help``; each command with the modules that bring it, and what it does."""

EVERYWHERE = {
    "COMMAND -h": "show the options of a command and an example",
    "--url ADDRESS": "of a daemon (default: $MASTCTL_URL, else --config)",
    "--json": "print one JSON document on stdout and nothing else",
    "--version": "print the version",
}
COMMANDS = {name: entry for commands in OVERVIEW.values() for name, entry in commands.items()}


class _Overview(Parser):
    """The parser of ``mastctl`` alone, whose help shows the commands by their headings."""

    def format_help(self) -> str:
        """Return the usage, and the commands and options in one screen."""
        lines = [self.format_usage().rstrip(), ""]
        for heading, commands in OVERVIEW.items():
            shown = ((name, help) for name, (_, help) in commands.items() if help)
            lines += [f"{heading}:", *(f"  {name:<12} {help}" for name, help in shown)]
        lines += ["", *(f"{name:<25} {help}" for name, help in EVERYWHERE.items()), ""]
        return "\n".join(lines)


def build_parser(wanted: str | None = None) -> Parser:
    """Return the parser of all commands, or of those whose first word is ``wanted``."""
    chosen = {name: entry for name, entry in COMMANDS.items() if wanted in (None, name)}
    for modules, _ in chosen.values():
        for module in modules.split():
            importlib.import_module(f"mastctl.cli.{module}")
    parser = _Overview(prog="mastctl", usage="mastctl [-h] [--version] COMMAND ...")
    parser.add_argument("--version", action="store_true", help="print the version")
    inner = {"": parser.add_subparsers(parser_class=Parser, prog="mastctl", metavar="COMMAND", required=True)}
    for name in chosen:
        if name not in DECLARED:
            _group(inner, name, COMMANDS[name][1])
    for name, one in DECLARED.items():
        if name in chosen or name.split()[0] in chosen:
            _add(inner, one)
    return parser


def _group(inner: dict[str, Any], name: str, help: str) -> None:
    """Add a command that has commands."""
    above, _, last = name.rpartition(" ")
    made = inner[above].add_parser(last, help=help, description=_sentence(help))
    inner[name] = made.add_subparsers(
        parser_class=Parser, prog=f"mastctl {name}", metavar="COMMAND", required=True
    )


def _add(inner: dict[str, Any], one: CommandLine) -> None:
    """Add a command that does something; one below another such is joined with it, as ``calibrate bench``."""
    above, _, last = one.name.rpartition(" ")
    if one.name in COMMANDS:
        above, last = "", one.name
    elif above not in inner:
        _group(inner, above, GROUPS[above])
    help = one.help or COMMANDS[one.name][1]
    made = inner[above].add_parser(
        last, help=help, description=one.about or _sentence(help),
        epilog=f"example: mastctl {one.name} {one.example}".rstrip().replace("%", "%%"),
    )  # fmt: skip
    add_options(made, *one.options)
    made.set_defaults(run=one.run)


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}.".replace("%", "%%")


def process() -> NoReturn:
    """Run the command of this process, and end with its exit code."""
    # A second thread for matrices as small as ours waits busily: a fit takes half as much processor time
    # again, and no less time. NumPy reads it when it is loaded; what is set already stays.
    if "OMP_NUM_THREADS" not in os.environ:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    code = main()
    if threading.active_count() > 1:
        # The interpreter's own end would wait for a thread that a device blocks, and end daemon threads where
        # they are, on which C++ (OpenCV, SciPy) aborts.
        atexit._run_exitfuncs()
        with contextlib.suppress(OSError):
            sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command (``argv``: what follows ``mastctl``) and return its exit code; never raises."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed by the caller (>&-): nothing reads it
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115, PTH123  for as long as the process
        elif isinstance(stream, io.TextIOWrapper):
            # What the terminal's encoding, or none, can hold (a tick mark, a file's name) is escaped.
            stream.reconfigure(errors="backslashreplace")
    argv = list(sys.argv[1:] if argv is None else argv)
    if not logging.getLogger().handlers:
        # Through a queue: the logs of a driver or a daemon in this process never wait for a reader.
        handler = QueuedHandler(queued(sys.stderr.fileno()))
        logging.basicConfig(format=TEXT, level=logging.WARNING, handlers=[handler])
    try:
        with signals.raised():
            code = _finish(argv, "--json" in argv)
        sys.stdout.flush()
    except OSError as error:
        # The reader of stdout is gone (head, less), or its disk is full.
        _give_up_stdout()
        return 141 if isinstance(error, BrokenPipeError) else output.refuse(error, as_json=False)
    return code


def _finish(argv: Sequence[str], as_json: bool) -> int:
    """Run, and turn what is raised into one line and an exit code; only a broken stdout gets out."""
    refusal: BaseException
    try:
        return _run(argv)
    except BrokenPipeError:
        raise
    except KeyboardInterrupt as interrupt:
        number = getattr(interrupt, "number", signal.SIGINT)
        refusal = output.CommandError("interrupted", "interrupted", exit_code=128 + number)
    except Exception as error:  # the last place before the user: one line, never a traceback
        log.debug("refused", exc_info=True)
        refusal = error
    for handler in logging.getLogger().handlers:
        handler.flush()  # what was logged about it comes first
    return output.refuse(refusal, as_json)


def _give_up_stdout() -> None:
    """Let what is still buffered for stdout go nowhere, so that the interpreter can close it in peace."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.stdout.fileno())
    os.close(null)


def _run(argv: Sequence[str]) -> int:
    """Parse and run; --help and --version end here with their own code."""
    try:
        if argv[:1] == ["--version"]:
            from importlib.metadata import version  # slow to load

            sys.stdout.write(f"mastctl {version('mastctl')}\n")
            return 0
        argv, command = _joined(argv)
        if command == "experiment" and argv[1:]:
            from mastctl.cli.experiment import STUDIES, become_study

            if argv[1] in STUDIES:
                become_study(argv[1], argv[2:])
        args = build_parser(command).parse_args(argv)
    except SystemExit as done:
        return int(done.code or 0)
    args.json = getattr(args, "json", False)
    answer = args.run(args)
    return output.show(args, answer) if isinstance(answer, output.Answer) else int(answer)


def _joined(argv: Sequence[str]) -> tuple[list[str], str]:
    """Return the arguments with a leading --url last and a command of two words as one, and the command.

    Raises WrongUse for an unknown command, with the nearest known one; argparse would list them all.
    """
    if argv and argv[0].split("=")[0] == "--url":
        size = 2 if argv[0] == "--url" else 1
        argv = [*argv[size:], *argv[:size]]
    if not argv or argv[0].startswith("-"):
        return list(argv), ""
    command, *rest = argv
    if command not in COMMANDS:
        near = get_close_matches(command, COMMANDS, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known are {', '.join(COMMANDS)}"
        raise output.WrongUse(f"no command '{command}'; {hint}")
    if rest and f"{command} {rest[0]}" in COMMANDS:  # a folder of that name is ``./bench``
        command = f"{command} {rest.pop(0)}"
    return [command, *rest], command


if __name__ == "__main__":
    process()

"""The door of the command line: choose the command, run it, tell a refusal in one line with its exit code.

Exit codes: 0 success, 2 wrong use or bad input, 1 failure, 130 interrupted (128 and the number of the signal
that ended it), 141 nobody reads the output.
A command module offers ``add_commands(subparsers)`` and sets ``run=function(args) -> int`` on each of its
commands. Only the module of the command that was asked for is imported; a module imports what is
slow (numpy, cv2, numba, fastapi) inside its functions.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import importlib
import io
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any, NoReturn

from mastctl import signals
from mastctl.cli import output
from mastctl.logs import TEXT, QueuedHandler, writer_to

log = logging.getLogger(__name__)

# Which module brings which command, in the order in which the help shows them.
MODULES: dict[str, tuple[str, ...]] = {
    "mastctl.cli.service": ("run", "status", "point", "snapshot"),
    "mastctl.cli.stop": ("stop", "estop", "reset", "halt"),
    "mastctl.cli.steering": ("lease", "track", "jog"),
    "mastctl.cli.operations": ("reload", "operations", "events", "mast", "fault"),
    "mastctl.cli.setup": ("token", "completion", "doctor", "schema"),
    "mastctl.cli.camera_files": ("camera",),
    "mastctl.cli.geometry": ("solve", "triangulate", "budget", "handoff"),
    "mastctl.cli.board": ("board",),
    "mastctl.cli.calibrate": ("calibrate",),
    "mastctl.cli.calibrate_bench": ("calibrate bench",),
    "mastctl.cli.experiment": ("experiment", "demo"),
    "mastctl.cli.conform": ("conform",),
    "mastctl.cli.record": ("record", "replay"),
    "mastctl.cli.sim": ("sim",),
    "mastctl.cli.rig": ("rig",),
    "mastctl.cli.sentinel": ("sentinel",),
    "mastctl.cli.servos": ("servo", "ptu"),
    "mastctl.cli.ros2": ("ros2",),
}

# argparse's own pattern knows -1 and -1.5 but takes -1e-3 for an option; "not finite" words get our message.
_NEGATIVE_NUMBER = re.compile(r"^-(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?$|^-(?:inf|infinity|nan)$", re.IGNORECASE)


class _Commands(argparse._SubParsersAction):  # type: ignore[type-arg]
    """Commands whose own --help says what they do, in the words of the list that they stand in."""

    def add_parser(self, name: str, **options: Any) -> argparse.ArgumentParser:
        words = str(options.get("help", ""))
        options.setdefault("description", f"{words[:1].upper()}{words[1:]}." if words else None)
        parser: argparse.ArgumentParser = super().add_parser(name, **options)
        example = EXAMPLES.get(parser.prog)
        if example is not None:
            said = f"{parser.epilog} " if parser.epilog else ""
            parser.epilog = f"{said}example: {example}".replace("%", "%%")
        return parser


class Parser(argparse.ArgumentParser):
    """A parser that refuses in one line, reads any negative number, and gives each command --json."""

    def __init__(self, *args: Any, **options: Any) -> None:
        options.setdefault("allow_abbrev", False)
        super().__init__(*args, **options)
        self._negative_number_matcher = _NEGATIVE_NUMBER
        self.register("action", "parsers", _Commands)
        self.add_argument(
            "--json",
            action="store_true",
            default=argparse.SUPPRESS,
            help="print one JSON document on stdout and nothing else",
        )

    def error(self, message: str) -> NoReturn:
        """Refuse wrong use; the caller prints the one line."""
        raise output.WrongUse(f"{message} (see '{self.prog} --help')")


class _Version(argparse.Action):
    """Print the installed version; reading it is slow, so only when it is asked for."""

    def __init__(self, option_strings: Sequence[str], dest: str, **options: Any) -> None:
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, help="print the version")

    def __call__(self, parser: argparse.ArgumentParser, *ignored: Any) -> NoReturn:
        from importlib.metadata import version

        sys.stdout.write(f"mastctl {version('mastctl')}\n")
        parser.exit()


def build_parser(argv: Sequence[str]) -> Parser:
    """Return the parser; if ``argv`` names a known command, only that command's module is in it."""
    parser = Parser(
        prog="mastctl",
        description="Rover mast controller: camera geometry, exact pointing, the pointing service.",
        epilog="--url, the address of a running daemon, may stand before a command too; by default it is "
        "$MASTCTL_URL, else that of the configuration.",
    )
    parser.add_argument("--version", action=_Version)
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    wanted = next((word for word in argv if not word.startswith("-")), None)
    modules = [module for module, commands in MODULES.items() if wanted in commands] or list(MODULES)
    for module in modules:
        importlib.import_module(module).add_commands(subparsers)
    return parser


def process() -> NoReturn:
    """Be the process of one command: run it, and end with its exit code."""
    # A second thread for matrices as small as ours waits busily: a fit takes half as much processor time
    # again, and no less time. NumPy reads it when it is loaded; who has set either is obeyed.
    if "OMP_NUM_THREADS" not in os.environ:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    code = main()
    if threading.active_count() > 1:
        # The interpreter's own end would wait for a thread that a device holds, and end daemon threads where
        # they are, on which C++ (OpenCV, SciPy) aborts.
        atexit._run_exitfuncs()
        with contextlib.suppress(OSError):
            sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; never raises, never shows a traceback.

    Parameters
    ----------
    argv
        The words after ``mastctl``; those of the process by default.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed by whoever started us (>&-): then nobody reads
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115, PTH123  for as long as the process
        elif isinstance(stream, io.TextIOWrapper):
            # What the terminal's encoding, or none, can hold (a tick mark, a file's name) is escaped.
            stream.reconfigure(errors="backslashreplace")
    words = list(sys.argv[1:] if argv is None else argv)
    as_json = "--json" in words
    if not logging.getLogger().handlers:
        _log_to(sys.stderr.fileno())
    try:
        with signals.raised():
            code = _tell(words, as_json)
        sys.stdout.flush()
    except OSError as error:
        # Nobody reads stdout any more (head, less), or its disk is full.
        _give_up_stdout()
        return 141 if isinstance(error, BrokenPipeError) else output.refuse(error, as_json=False)
    return code


def _log_to(descriptor: int) -> None:
    """Log through a queue: what a driver or a daemon in this process has to say never waits for a reader."""
    handler = QueuedHandler(writer_to(descriptor))
    logging.basicConfig(format=TEXT, level=logging.WARNING, handlers=[handler])


def _refused(error: BaseException, as_json: bool) -> int:
    """Tell a refusal, after what was logged about it."""
    for handler in logging.getLogger().handlers:
        handler.flush()
    return output.refuse(error, as_json)


def _tell(words: Sequence[str], as_json: bool) -> int:
    """Run and turn what is raised into one line and an exit code; only a broken stdout gets out."""
    try:
        return _run(words)
    except BrokenPipeError:
        raise
    except KeyboardInterrupt as interrupt:
        number = getattr(interrupt, "number", signal.SIGINT)
        return _refused(output.CommandError("interrupted", "interrupted", exit_code=128 + number), as_json)
    except Exception as error:  # the last door before the user: one line, never a traceback
        log.debug("refused", exc_info=True)
        return _refused(error, as_json)


def _give_up_stdout() -> None:
    """Let what is still buffered for stdout go nowhere, so that the interpreter can close it in peace."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.stdout.fileno())
    os.close(null)


def _run(words: Sequence[str]) -> int:
    """Parse and run; --help and --version end here with their own code."""
    try:
        words = _as_one_word(_url_last(words))
        _check_command(words)
        if "experiment" in words:
            from mastctl.cli.experiment import become_study, study_of

            if (study := study_of(words)) is not None:
                become_study(*study)
        parser = build_parser(words)
        args = parser.parse_args(words)
    except SystemExit as done:
        return int(done.code or 0)
    args.json = getattr(args, "json", False)
    return int(args.run(args))


def _as_one_word(words: Sequence[str]) -> list[str]:
    """Join a command of two words whose first is one too; a survey named as the second is ``./bench``."""
    two = [command.split(" ") for commands in MODULES.values() for command in commands if " " in command]
    first = next((at for at, word in enumerate(words) if not word.startswith("-")), len(words))
    if list(words[first : first + 2]) in two:
        return [*words[:first], " ".join(words[first : first + 2]), *words[first + 2 :]]
    return list(words)


def _url_last(words: Sequence[str]) -> list[str]:
    """Put a --url that stands before the command after it. Raises WrongUse if there is one already."""
    first = next((at for at, word in enumerate(words) if word == "--url" or word.startswith("--url=")), None)
    if first is None or any(not word.startswith("-") for word in words[:first]):
        return list(words)
    size = 2 if words[first] == "--url" else 1
    url, others = words[first : first + size], [*words[:first], *words[first + size :]]
    if any(word == "--url" or word.startswith("--url=") for word in others):
        raise output.WrongUse("--url is there twice; one address is expected")
    return [*others, *url]


def _check_command(words: Sequence[str]) -> None:
    """Refuse an unknown command with the nearest known one; argparse would list them all."""
    known = [command for commands in MODULES.values() for command in commands]
    wanted = next((word for word in words if not word.startswith("-")), None)
    if wanted is None or wanted in known:
        return
    near = get_close_matches(wanted, known, n=1)
    hint = f"did you mean '{near[0]}'?" if near else f"known are {', '.join(known)}"
    raise output.WrongUse(f"no command '{wanted}'; {hint}")


if __name__ == "__main__":
    process()


_ALL = """
run --config rover.yaml
status --json
point --camera navcam_left --at 300 420
snapshot navcam_left --out left.png
stop
estop --name Ana --reason "sparks at the mast"
reset --name Ana --reason "cable mended"
halt --config rover.yaml
lease show
lease take --for 60
lease renew --lease 0f3c --for 60
lease release --lease 0f3c
token new --name wall --role view
token list
token revoke wall
track start --camera navcam_left --at 300 420
track status
track watch --count 10
track pose --position 4.1 0.2 0 --sigma 0.02 0.009
track look
track stop
jog --rates 0.2 0 --seconds 2
operations list
operations show 000012-9f3a
operations watch 000012-9f3a
mast show --out now.yaml
mast use rocky8-refined.yaml
mast back
reload
fault list
fault set navcam_left dark for_s=5
fault clear navcam_left
events state fault --count 5
camera project mast.yaml --camera navcam_left --pan 0.3 --tilt -0.2 --points points.csv
camera ray mast.yaml --camera navcam_left --pan 0.3 --tilt -0.2 --pixels pixels.csv
camera convert camera.yaml camera.cahvor
camera maps mast.yaml --pair navcam --out maps.npz
camera list
camera sync navcam_left navcam_right --config rover.yaml
camera check /dev/video0 --rate 30
camera grab /dev/video0 --out picture.png
camera focus /dev/video0 --seconds 30
camera settings navcam_left exposure_s=0.004 gain=20
camera mode mast.yaml --camera navcam_left --bin 2 --flip both --out binned.yaml
solve mast.yaml --camera navcam_left --target 6 1 0
triangulate mast.yaml --pair navcam --pan 0.3 --tilt -0.2 --left 300 420 --right 271 420
budget
handoff mast.yaml --from navcam --to hazcam --pan 0.3 --tilt -0.2 --left 300 420 --right 271 420
board make --kind charuco --paper A4 --out board.pdf
board measured board.yaml --across-mm 149.6 --down-mm 149.8
board find board.yaml picture.png
calibrate survey --out mast.yaml --report report
calibrate bench --config rig.yaml --board board.yaml --out mast.yaml --report report
experiment pointing --targets 20 --out pointing
experiment handoff
experiment approach
experiment calibration
demo --out demo
completion bash --install
schema config
conform http://127.0.0.1:8420
doctor --config rover.yaml
sentinel reference --folder sentinel --pose 0,-0.3
sentinel look --folder sentinel
sentinel watch --folder sentinel --every-s 86400
sentinel status --folder sentinel
record start afternoon
record stop
record list
record show afternoon.mcap
record repair broken.mcap --out whole.mcap
replay afternoon.mcap --mast other.yaml
sim new twin --height 1.9 --baseline 0.42
rig new rig --pan-deg -90 90 --tilt-deg -40 30
sim dynamixel --servo xl330_m288:1 --servo xl330_m288:2 --pty
sim ptu --pty
sim feetech --pty
servo scan /dev/ttyUSB0
servo info /dev/ttyUSB0 1
servo set-id /dev/ttyUSB0 1 2
ptu info /dev/ttyUSB0
ptu home /dev/ttyUSB0
ros2 --url http://127.0.0.1:8420
"""
_GROUPS = frozenset(
    (
        *("lease", "token", "track", "operations", "mast", "fault", "camera", "experiment", "record"),
        *("sim", "servo", "ptu", "board", "sentinel", "rig"),
    )
)


def _command_of(line: str) -> str:
    words = line.split()
    two = words[0] in _GROUPS or words[:2] == ["calibrate", "bench"]
    return " ".join(words[:2] if two else words[:1])


EXAMPLES: Mapping[str, str] = {
    f"mastctl {_command_of(line)}": f"mastctl {line}" for line in _ALL.strip().splitlines()
}
"""Of a command, ``mastctl lease take``, a line that a shell would take."""

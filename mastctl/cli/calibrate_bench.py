"""``mastctl calibrate bench``: a mast file from pictures of a board, the head driven for them."""

from __future__ import annotations

import argparse
import math
import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl import signals
from mastctl.cli import output
from mastctl.cli.calibrate import MODELS, families_of
from mastctl.cli.options import Group, at_least, command, finite_number, one_of, option
from mastctl.cli.output import Answer, CommandError, WrongUse, check_file, check_folder

if TYPE_CHECKING:
    from calib.plan.placements import Placement
    from mastctl.answers import BenchProgress, BenchStep
    from mastctl.bench.result import BenchDone
    from mastctl.bench.run import BenchRun, Reporter
    from mastctl.client import Client

COMMAND = "calibrate bench"


FRAME = Group(
    (
        one_of(
            option(
                "--mast-at X Y Z RX RY RZ",
                "the mast's place (metres, radians as in a mast file), as level and tape show it",
                type=finite_number,
            ),
            option("--mast-like MAST.yaml", "the mast's place as in this mast file"),
        ),
    ),
    title="where the rover frame is, which pictures cannot show (default: where the mast file in use has it; "
    "of a FOLDER: as its run had it)",
)


@command(
    "calibrate bench",
    option("[FOLDER]", "a bench's folder to fit again"),
    option("--config RIG.yaml", "the head's configuration (default: packaged bench)"),
    option("--url ADDRESS", "a running daemon, instead of one that is started"),
    option("--board BOARD.yaml", "the board ('mastctl board make')"),
    option("--out MAST.yaml", "the mast file to write", required=True),
    option("--report DIR", "folder for bench.html"),
    option("--survey DIR", "folder for what is seen (default: MAST.bench beside --out)"),
    option("--pictures N", "of each camera, at most", type=at_least(12), default=60),
    option(
        "--wanted-px PX", "wanted error of a first pointing from the calibration, rms an axis", default=0.2
    ),
    option("--cameras NAME...", "which cameras (default: all that the daemon has)"),
    option("--by-hand", "of a simulated bench: wait for Enter at each placement as at a real one"),
    FRAME,
    Group(MODELS, title="with FOLDER"),
    help="fit cameras, axes and joints to pictures of a board that stands anywhere; drives the head",
    example="--config rig.yaml --board board.yaml --out mast.yaml --report report",
    about="Turns the head to find a board, chooses each next pose by its expected information, "
    "and asks for two to four placements of the board. It ends by itself when the wanted pointing error "
    "is met (docs/how-to/calibrate.md). Everything seen is kept in a folder: a run that ended "
    "goes on with the same command. With FOLDER such a folder is fitted again, and nothing moves.",
)
def _run(args: argparse.Namespace) -> Answer:
    """Drive the head, or fit a folder again."""
    check_file(args.out, "--out")
    check_folder(args.report, "--report")
    if args.folder is not None:
        for name in ("config", "url", "board", "survey", "cameras", "by_hand"):
            if getattr(args, name) not in (None, False):
                raise WrongUse(f"--{name.replace('_', '-')} drives a head; with FOLDER nothing is driven")
        return _again(args)
    if args.model is not None or args.compare_models:
        raise WrongUse("--model and --compare-models are for fitting a folder again; name a bench's FOLDER")
    if args.board is None:
        raise WrongUse("--board is missing; the BOARD.yaml that 'mastctl board make' wrote is expected")
    return _drive(args)


def survey_folder(out: Path) -> Path:
    """Return where a run keeps its images by default."""
    return out.with_name(f"{out.stem}.bench")


def _again(args: argparse.Namespace) -> Answer:
    from calib.survey.reader import read_survey
    from mastctl.bench.result import fit_again
    from mastctl.bench.survey import former_rig, moved_placements, read_notes, stated_mast

    survey = read_survey(args.folder)
    if not survey.boards:
        raise CommandError(
            "no_bench",
            f"{args.folder} is a survey with a station; 'mastctl calibrate {args.folder}' fits it",
            2,
        )
    notes = read_notes(args.folder)
    mast_at = _mast_at(args) or stated_mast(notes)
    if args.model is not None:
        survey = survey.as_model(args.model)
    with output.waiting(args.json, f"fitting {len(survey.images)} images"):
        former, moved = former_rig(args.folder), moved_placements(notes)
        done = fit_again(survey, args.out, args.report, mast_at, former, moved)
    models, lines = families_of(args, survey)
    return _answer(done, models, lines)


def _mast_at(args: argparse.Namespace) -> list[float] | None:
    """Where the mast stands, as far as it was stated."""
    from calib.files.mast_file import load_rig

    if args.mast_like is None:
        return args.mast_at  # type: ignore[no-any-return]
    mast = load_rig(args.mast_like).rig.mast
    return [*mast.translation_m.tolist(), *mast.rotation_rad.tolist()]


def _drive(args: argparse.Namespace) -> Answer:
    from calib.calibrate.starts.bench import BenchNotFitted
    from calib.survey.writer import NotWritten
    from calib.targets.board_file import load_board
    from mastctl.bench.mast import BenchInterrupted
    from mastctl.bench.result import finish

    board = load_board(args.board)
    folder = args.survey or survey_folder(args.out)
    kept = f"everything seen is kept in {folder}: the same command goes on"
    try:
        with _bench(args, board, folder) as (bench, reporter):
            done = finish(bench, reporter, args.out, args.report)
    except BenchInterrupted as reason:
        raise CommandError(reason.code, f"{reason}; {kept}") from None
    except (BenchNotFitted, NotWritten) as reason:
        error = output.as_command_error(reason)
        if isinstance(reason, BenchNotFitted):
            kept += " with it, and --survey NEW begins anew"
        raise CommandError(error.code, f"{reason}; {kept}", error.exit_code, error.detail) from None
    except KeyboardInterrupt as interrupt:
        number = getattr(interrupt, "number", signal.SIGINT)
        sentence = f"interrupted; {kept}" if folder.exists() else "interrupted"
        raise CommandError("interrupted", sentence, 128 + number) from None
    return _answer(done, {}, [])


def _answer(done: BenchDone, models: dict[str, Any], lines: list[str]) -> Answer:
    return Answer(done.as_json() | models, [*done.lines(), *lines, done.verdict_line()])


class Terminal:
    """Shows a run line by line on stderr, and has an operator place the board; see `Reporter`.

    ``by_hand``: whether the operator does; the board of a simulated bench goes by itself. ``most``: pictures
    of a camera.
    """

    def __init__(self, by_hand: bool, most: int) -> None:
        self._by_hand, self._most = by_hand, most

    def say(self, sentence: str) -> None:
        """Write a line."""
        sys.stderr.write(sentence + "\n")
        sys.stderr.flush()

    def step(self, step: BenchStep) -> None:
        """Write nothing: sentences and progress show it."""

    def progress(self, now: BenchProgress) -> None:
        """Write a line."""
        from mastctl.bench.result import px

        seen = ", ".join(
            f"{name} {100 * sum(map(bool, image['cells'])) / len(image['cells']):.0f} %"
            for name, image in now["cameras"].items()
        )
        line = (
            f"p{now['placements']}: {now['pictures']} of {self._most} pictures a camera; seen over {seen}; "
            f"pointing to {px(now['predicted_px'])} (wanted {px(now['target_px'])})"
        )
        if now["next_rad"] is not None:
            pan, tilt = (math.degrees(angle) for angle in now["next_rad"])
            line += f"; most helps pan {pan:+.0f}, tilt {tilt:+.0f} degrees: to {px(now['expected_px'])}"
        self.say(line)

    def place(self, name: str, placement: Placement) -> None:
        """Request the placement, and wait for Enter. Raises BenchInterrupted ``no_operator``."""
        from mastctl.bench.mast import BenchInterrupted

        if not self._by_hand:
            self.say(f"placement {name}: the board {placement}")
            return
        if not signals.may_read_stdin():
            raise BenchInterrupted(
                "no operator can place the board: the command runs in its terminal's background",
                "no_operator",
            )
        self.say(f"\nPlacement {name}: put the board {placement}.")
        sys.stderr.write("It need not be exact. Enter when it stands still (Ctrl-C: later). ")
        sys.stderr.flush()
        if not sys.stdin.readline():
            raise BenchInterrupted("no operator can place the board: standard input has ended", "no_operator")


@contextmanager
def _bench(args: argparse.Namespace, board: Any, folder: Path) -> Iterator[tuple[BenchRun, Reporter]]:
    """A run on a daemon that runs, or on one that is started for it, under a lease."""
    from mastctl.bench.mast import BenchInterrupted
    from mastctl.bench.run import BenchGoal, open_run
    from mastctl.client import ClientError

    with ExitStack() as stack:
        client = stack.enter_context(_daemon(args))
        try:
            stack.enter_context(client.lease(name=COMMAND, ends_with_stop=True))
        except ClientError as error:
            raise BenchInterrupted(f"the head cannot be steered: {error}") from None
        status = client.status()
        served = list(status["cameras"])
        for name in args.cameras or ():
            if name not in served:
                raise WrongUse(f"--cameras names {name}; the daemon has {', '.join(served)}")
        if args.by_hand and not status["simulated"]:
            raise WrongUse("--by-hand is of a simulated bench, and this one is real")
        reporter = Terminal(args.by_hand or not status["simulated"], args.pictures)
        wanted = BenchGoal(args.wanted_px, args.pictures)
        yield (
            open_run(client, board, folder, reporter, wanted, args.cameras or served, _mast_at(args)),
            reporter,
        )


@contextmanager
def _daemon(args: argparse.Namespace) -> Iterator[Client]:
    """A client of the daemon named, of one that runs with this configuration, or of one that is started."""
    from dataclasses import replace

    from calib.files import digest_of
    from mastctl.client import Client, ClientError
    from mastctl.config import Listen, load_config
    from mastctl.daemon import RunningDaemon
    from mastctl.packaged import config_folder

    if args.url is not None:
        with Client(args.url, name=COMMAND) as client:
            client.status()
            yield client
        return
    config = load_config(args.config or config_folder() / "bench.yaml")
    listen = config.listen
    if listen.socket is not None or listen.port:
        with Client(listen.url, timeout_s=5.0, name=COMMAND) as client:
            try:
                running = client.status()
            except ClientError:
                running = None
            if running is not None:
                if running["mast"]["digest"] != digest_of(config.mast_file.read_bytes()):
                    raise CommandError(
                        "other_daemon",
                        f"the daemon at {listen.url} uses a {running['mast']['file']} that differs from "
                        f"{config.mast_file}; end it, give --url, or a --config with another listen.port",
                    )
                yield client
                return
    if config.hardware.simulation and "speed" not in config.hardware.simulation:
        simulation = {**config.hardware.simulation, "speed": "max"}
        config = replace(config, hardware=replace(config.hardware, simulation=simulation))
    with output.waiting(args.json, "starting the daemon"):
        daemon = RunningDaemon(replace(config, listen=Listen(port=0)))
    with daemon, Client(daemon.url, name=COMMAND) as client:
        yield client

"""``mastctl calibrate``: a mast file of a survey, refined by hand-offs, or of pictures of a board."""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl import signals
from mastctl.cli import output
from mastctl.cli.geometry import read_mast_file
from mastctl.cli.options import at_least, command, finite_number, one_of, option
from mastctl.cli.output import (
    Answer,
    CommandError,
    Shown,
    WrongUse,
    check_file,
    check_folder,
    tables_at,
)

if TYPE_CHECKING:
    from calib.files.mast_file import StoredRig
    from calib.survey.records import Survey
    from mastctl.answers import BenchRunRecord
    from mastctl.calibration.run import Calibrated, Method
    from mastctl.client import Client

BENCH = "calibrate bench"
REFINED = (
    "corrections.*.significant corrections.*.significance_sigmas corrections.*.shift_m "
    "corrections.*.turn_rad corrections.*.handoffs corrections.*.rms_px corrections.*.unseen "
    "corrections.*.outliers refusals.*.message other_mast"
)
FITTED = "rms_px check_rms_px check.pointing_rms_px calibrated_px counts_px placements pictures"
"""What people see of a correction, and of a bench."""


def _model(text: str) -> str:
    """Read a camera model's name (argparse ``type``)."""
    from calib.geometry.cahvor import KINDS

    if text.upper() not in KINDS:
        known = ", ".join(kind.lower() for kind in KINDS)
        raise argparse.ArgumentTypeError(f"'{text}' is not a camera model; known are {known}")
    return text.upper()


MODELS = (
    option(
        "--model MODEL",
        "camera model of all cameras: cahv, cahvor, cahvore, opencv4, opencv5, opencv8, opencv12, "
        "opencv14 or opencv_fisheye (default: as survey.yaml says); of a bench with FOLDER",
        type=_model,
    ),
    option(
        "--compare-models",
        "also fit each camera as other models, compare them by pictures left out of the fit, and name "
        "the one that earns its parameters",
    ),
)


@command(
    "calibrate",
    option("SURVEY", "the survey folder; with --refine the mast file"),
    option(
        "--refine HANDOFFS.jsonl",
        "record of hand-offs to correct the body cameras by; may be repeated",
        repeat=True,
    ),
    option("--out MAST.yaml", "the mast file to write", required=True),
    option("--report DIR", "folder for calibration.html"),
    option("--method paper|joint", "paper: cameras first; joint (default): all together, weighted"),
    option("--mast 4|6|8", "mast parameters: 4 upright, 6 as in the paper (default), 8 two skew axes"),
    *MODELS,
    example="survey --out mast.yaml --report report",
    about="Reads a survey folder (docs/how-to/calibrate.md), checks it, finds dots where "
    "there are none, fits cameras and mast, and writes the mast file with its uncertainty. Every former "
    "version is kept: the last as NAME.previous.yaml, those before as NAME.previous-1.yaml and so on. "
    "With --refine it corrects the body cameras of a mast file by hand-offs instead, as a new mast file. "
    "If they show no significant correction, it writes nothing and exits with 1.",
)
def _calibrate(args: argparse.Namespace) -> Answer:
    return _refine(args) if args.refine else _from_survey(args)


def _refine(args: argparse.Namespace) -> Answer:
    """Propose a correction by hand-offs as a new mast file; 1, and no file, if they show none."""
    from calib.errors import NoCorrection
    from mastctl.calibration.run import refine, save_new
    from mastctl.drift.handoffs import read_log

    for name in ("model", "report", "method", "mast"):
        if getattr(args, name) is not None:
            option = f"--{name.replace('_', '-')}"
            raise WrongUse(f"{option} belongs to a survey; --refine corrects by hand-offs alone")
    if args.out.resolve() in {path.resolve() for path in (args.survey, *args.refine)}:
        raise WrongUse(f"--out {args.out} is what is read; name another file, for the proposal")
    check_file(args.out, "--out")
    mast = read_mast_file(args.survey)
    document, found = refine(mast, [read_log(path) for path in args.refine])
    shown: list[str | Shown] = [
        *tables_at(document, REFINED),
        *(one["sentence"] for one in document["bias"]),
    ]
    if isinstance(found, NoCorrection):
        if not args.json:
            output.show(args, Answer(document, shown))
        raise CommandError(found.code, f"{found}; nothing was written", detail=document)
    saved, previous = save_new(found, args.out)
    kept = None if previous is None else str(previous)
    document["mast_file"] = {"path": str(saved.path), "digest": saved.digest, "previous": kept}
    after = f"{mast.path} is as it was; a daemon uses the new one after 'mastctl rig mast use'"
    return Answer(document, [*tables_at(document["mast_file"], "", "proposed mast file"), *shown, after])


def _from_survey(args: argparse.Namespace) -> Answer:
    """Read, check, find dots, fit, save, report; nothing is written before the fit is good."""
    from calib.survey.reader import read_survey
    from mastctl.calibration.run import (
        SurveyRefused,
        calibrate,
        checked_survey,
        sentence_of,
        with_dots,
        without_dots,
    )
    from mastctl.experiment.tasks import open_executor

    method: Method = args.method or "joint"
    survey = read_survey(args.survey)
    if args.model is not None:
        survey = survey.as_model(args.model)
    try:
        checked_survey(survey, method)
    except SurveyRefused as refusal:
        for finding in refusal.findings[1:]:
            output.show_line(str(finding))  # the first comes last, as the reason
        raise
    check_file(args.out, "--out")  # before the minutes of the search, not after them
    if args.out.is_file() and args.out.resolve().is_relative_to(survey.folder.resolve()):
        raise WrongUse(f"--out {args.out}: is a file of the survey itself; name another one")
    check_folder(args.report, "--report")
    in_use = _in_use(args)
    undetected: tuple[tuple[str, str], ...] = ()
    if count := len(without_dots(survey)):
        workers = min(count, os.cpu_count() or 1)
        with (
            output.waiting(args.json, f"finding dots in {count} images"),
            open_executor("local", workers) as executor,
        ):
            survey, undetected = with_dots(survey, executor)
    warnings = checked_survey(survey, method)  # once more, with the dots that were found
    for sentence in (
        *(f"no dots in image {name}: {reason}" for name, reason in undetected),
        *map(sentence_of, warnings),
    ):
        output.show_line(f"warning: {sentence}")
    with output.waiting(args.json, f"fitting {len(survey.images)} images ({method})"):
        former = None if in_use is None else in_use.rig
        done = calibrate(survey, args.out, method, args.mast or 6, warnings, undetected, args.report, former)
    models, lines = _compared(args, survey)
    document = _document(done, in_use)
    return Answer(document | models, [*_shown(done, document), *lines])


def _compared(args: argparse.Namespace, survey: Survey) -> tuple[dict[str, Any], list[str]]:
    """What ``--compare-models`` adds for programs and for people."""
    if not args.compare_models:
        return {}, []
    from mastctl.calibration.run import compared_models

    with output.waiting(args.json, "comparing camera models"):
        models = compared_models(survey)
    return {"models": models}, [f"{name}: {one['sentence']}" for name, one in models.items()]


def _in_use(args: argparse.Namespace) -> StoredRig | None:
    """What --out was before, to compare with; one that cannot be read is no reason to stop."""
    from calib.errors import BadFile
    from calib.files.mast_file import load_rig

    try:
        return load_rig(args.out) if args.out.exists() else None
    except BadFile as error:
        output.show_line(f"warning: nothing to compare with: {error}")
        return None


def _document(done: Calibrated, in_use: StoredRig | None) -> dict[str, Any]:
    """The document that ``--json`` prints."""
    from calib.adjust.result import HELD_FIXED
    from mastctl.as_json import as_json
    from mastctl.calibration.landing import pointing_change
    from mastctl.calibration.run import findings_as_json, mast_document, picked

    fit = done.calibration
    document = mast_document(done.saved)
    document["mast_file"]["previous"] = None if done.previous is None else str(done.previous)
    document |= {
        **picked(fit, "seconds", "chi2_probability", "notes"),
        "survey_digest": done.survey.digest,
        "wider_models": findings_as_json(fit.wider),
        "cross_validation": findings_as_json(fit.contradictions),
        "outliers": [picked(one, "kind", "name", "sentence", "size") for one in fit.outliers],
        "held_fixed": list(HELD_FIXED),
        "warnings": as_json(done.warnings),
        "undetected": [{"image": name, "reason": reason} for name, reason in done.undetected],
        "report": None if done.page is None else str(done.page),
    }
    if in_use is not None:
        document["in_use"] = {
            "path": str(in_use.path),
            "digest": in_use.digest,
            "pointing_change": pointing_change(fit.rig, in_use.rig),
        }
    return document


def _shown(done: Calibrated, document: Mapping[str, Any]) -> Iterator[str | Shown]:
    """A survey's result for people; the report and ``--json`` have the tests behind the verdict."""
    from mastctl.calibration.report import camera_table, mast_table

    fit = done.calibration
    yield Shown(
        f"Mast ({fit.method}, {fit.mast_parameters} parameters, {fit.seconds:.1f} s)", *mast_table(fit)
    )
    yield Shown("Cameras", *camera_table(fit), fit.notes)
    yield from tables_at(
        document, "outliers.name outliers.sentence degenerate in_use.pointing_change", "more"
    )
    yield from _verdict(document)


def _verdict(document: Mapping[str, Any]) -> Iterator[str]:
    """The files that were written, the reasons, and the verdict."""
    verdict, file = document["verdict"], document["mast_file"]
    yield f"mast file: {file['path']} ({file['digest'][:12]})"
    if file.get("previous") is not None:
        yield f"kept from before: {file['previous']}"
    if document["report"] is not None:
        yield f"report: {document['report']}"
    yield from (f"{one['grade']}: {one['sentence']}" for one in verdict["reasons"])
    yield f"verdict: {verdict['words']}"


@command(
    "calibrate bench",
    option("[FOLDER]", "a bench's folder to fit again"),
    option("--config RIG.yaml", "the head's configuration (default: packaged bench)"),
    option("--url ADDRESS", "a running daemon, instead of one that is started"),
    option("--board BOARD.yaml", "the board ('mastctl board make')"),
    option("--out MAST.yaml", "the mast file to write", required=True),
    option("--report DIR", "folder for bench.html"),
    option("--pictures N", "of each camera, at most", type=at_least(12), default=60),
    option("--wanted-px PX", "wanted error of a first pointing by the calibration alone, rms", default=0.2),
    option("--by-hand", "of a simulated bench: wait for Enter at each placement as at a real one"),
    option("--resume RUN", "go on with a run, by the name that it ended with"),
    *MODELS,
    one_of(
        option(
            "--mast-at X Y Z RX RY RZ",
            "with FOLDER: the mast's place (metres, radians as in a mast file) by level and tape "
            "(default: as the mast file of the run has it)",
            type=finite_number,
        ),
        option("--mast-like MAST.yaml", "with FOLDER: the mast's place as in this mast file"),
    ),
    help="fit cameras, axes and joints to pictures of a board that stands anywhere; drives the head",
    example="--config rig.yaml --board board.yaml --out mast.yaml --report report",
    about="Has a daemon turn the head to find a board, choose each next pose by its expected information, "
    "and request two to four placements of the board. It ends by itself when the wanted pointing error "
    "is met (docs/how-to/calibrate.md). Everything seen is kept in the daemon's state folder, which is "
    "MAST.bench beside --out where the command starts one. With FOLDER a run is fitted again; nothing moves.",
)
def _bench(args: argparse.Namespace) -> Answer:
    check_file(args.out, "--out")
    check_folder(args.report, "--report")
    driven, fitted = ("config", "url", "board", "by_hand", "resume"), ("mast_at", "mast_like", "model")
    for name in driven if args.folder is not None else (*fitted, "compare_models"):
        if getattr(args, name) not in (None, False):
            only = "drives a head; with FOLDER nothing is driven" if args.folder else "goes with FOLDER"
            raise WrongUse(f"--{name.replace('_', '-')} {only}")
    if args.folder is not None:
        return _again(args)
    if (args.board is None) == (args.resume is None):
        raise WrongUse("--board BOARD.yaml ('mastctl board make') is expected, or --resume RUN")
    with _daemon(args) as client:
        return _driven(args, client)


def _again(args: argparse.Namespace) -> Answer:
    from calib.files.mast_file import load_rig
    from calib.survey.reader import read_survey
    from mastctl.bench.survey import former_rig
    from mastctl.bench.worker import fit_again

    seen = args.folder / "seen"
    folder = seen if seen.is_dir() else args.folder
    survey = read_survey(folder)
    if not survey.boards:
        message = f"{folder} is a survey with a station; 'mastctl calibrate {folder}' fits it"
        raise CommandError("no_bench", message, 2)
    mast_at = args.mast_at
    if args.mast_like is not None:
        mast = load_rig(args.mast_like).rig.mast
        mast_at = [*mast.translation_m.tolist(), *mast.rotation_rad.tolist()]
    if args.model is not None:
        survey = survey.as_model(args.model)
    with output.waiting(args.json, f"fitting {len(survey.images)} images"):
        document = fit_again(survey, args.out, args.report, mast_at, former_rig(folder))
    models, lines = _compared(args, survey)
    return Answer(document | models, [*_bench_shown(document), *lines])


def _bench_shown(document: Mapping[str, Any]) -> Iterator[str | Shown]:
    yield from tables_at(document, FITTED, "bench")
    yield from (one["sentence"] for one in document["terms"])
    yield from (f"fixed: {sentence}" for sentence in document["gauges"])
    yield from (f"note: {sentence}" for sentence in document.get("notes", ()))
    yield f"run: {document['survey']['folder']}"
    yield from _verdict(document)


def _driven(args: argparse.Namespace, client: Client) -> Answer:
    """Have the daemon carry a run out, and bring its mast file and report here."""
    from calib.files.mast_file import load_rig
    from calib.targets.board_file import load_board
    from mastctl.calibration.run import mast_document, save_new
    from mastctl.client import ClientError

    began_s = time.monotonic()
    wanted = {"wanted_px": args.wanted_px, "pictures": args.pictures, "by_hand": args.by_hand or None}
    if args.resume is None:
        load_board(args.board)  # or says what is wrong with it, and where
        wanted["board_file"] = args.board.read_text(encoding="utf-8")
    name = client.begin_bench(resume=args.resume, **wanted)["name"]
    goes_on = f"'mastctl calibrate bench' with --resume {name} in place of --board goes on"
    try:
        run = _watched(client)
    except BaseException as error:
        with suppress(ClientError):
            client.leave_bench()
        if not isinstance(error, KeyboardInterrupt):
            raise
        number = getattr(error, "number", signal.SIGINT)
        raise CommandError("interrupted", f"interrupted; {goes_on}", 128 + number) from None
    if run["state"] != "done" or run["mast_file"] is None:
        raise CommandError(run["code"] or "interrupted", f"{run['sentence']}; {goes_on}")
    kept = client.bench()
    made = Path(kept["masts_folder"], run["mast_file"])
    if not made.is_file():
        raise CommandError(
            "elsewhere", f"the mast file is {made} on the daemon's machine; copy it from there"
        )
    saved, previous = save_new(load_rig(made).rig, args.out)
    page = None
    if args.report is not None and run["report"] is not None:
        args.report.mkdir(parents=True, exist_ok=True)
        page = args.report / "bench.html"
        page.write_bytes(client.report(run["report"]))
    document: dict[str, Any] = {
        "terms": [], "gauges": [], **mast_document(saved), **(run["result"] or {}),
        "seconds": time.monotonic() - began_s,
        "survey": {"folder": str(Path(kept["folder"], name))},
        "report": None if page is None else str(page),
    }  # fmt: skip
    document["mast_file"]["previous"] = previous and str(previous)
    return Answer(document, _bench_shown(document))


def _watched(client: Client) -> BenchRunRecord:
    """Show a run on stderr until it is over, and have an operator place the board; return the run."""
    from mastctl.client import ClientError

    sentences: list[str] = []
    placement, pictures = "", 0
    for event in client.events("bench"):
        run: BenchRunRecord = event["value"]
        both = min(len(sentences), len(run["sentences"]))
        known = max(n for n in range(both + 1) if sentences[len(sentences) - n :] == run["sentences"][:n])
        for sentence in run["sentences"][known:]:
            output.show_line(sentence)
        sentences = run["sentences"]
        if run["step"] == "over":
            return run
        requested = run["requested"]
        if requested is not None and requested["name"] != placement:
            placement = requested["name"]
            output.show_line(f"placement {placement}: the board {requested['description']}")
        if run["step"] == "pictures" and run["pictures"] > pictures:
            pictures = run["pictures"]
            output.show_line(_progress(run))
        if run["state"] == "waiting":
            if not signals.may_read_stdin():
                raise CommandError(
                    "no_operator",
                    "no operator can place the board: the command runs in its terminal's background",
                )
            sys.stderr.write("It need not be exact. Enter when it stands still (Ctrl-C: later). ")
            sys.stderr.flush()
            if not sys.stdin.readline():
                raise CommandError("no_operator", "no operator can place the board: standard input has ended")
            try:
                client.board_stands()
            except ClientError as error:
                if error.code not in ("bench_idle", "nothing_requested"):  # it has ended meanwhile
                    raise
    raise CommandError("no_daemon", f"the daemon at {client.url} has ended")


def _progress(run: BenchRunRecord) -> str:
    from mastctl.bench.worker import px

    seen = ", ".join(
        f"{name} {100 * sum(map(bool, image['cells'])) / len(image['cells']):.0f} %"
        for name, image in run["cameras"].items()
    )
    line = (
        f"p{run['placements']}: {run['pictures']} of {run['most']} pictures a camera; seen over {seen}; "
        f"pointing to {px(run['predicted_px'])} (wanted {px(run['target_px'])})"
    )
    if run["next_rad"] is not None:
        pan, tilt = (math.degrees(angle) for angle in run["next_rad"])
        line += f"; most helps pan {pan:+.0f}, tilt {tilt:+.0f} degrees: to {px(run['expected_px'])}"
    return line


@contextmanager
def _daemon(args: argparse.Namespace) -> Iterator[Client]:
    """A client of the daemon named, of one that runs with this configuration, or of one that is started.

    That one keeps its state in MAST.bench beside --out, its mast files too.
    """
    from calib.files import digest_of, save_bytes
    from mastctl.client import Client, ClientError
    from mastctl.config import Listen, load_config
    from mastctl.daemon import RunningDaemon
    from mastctl.packaged import config_folder

    if args.url is not None:
        with Client(args.url, name=BENCH) as client:
            yield client
        return
    config = load_config(args.config or config_folder() / "bench.yaml")
    listen, data = config.listen, config.mast_file.read_bytes()
    if listen.socket is not None or listen.port:
        with Client(listen.url, name=BENCH) as client:
            try:
                running = client.status(5.0)
            except ClientError:
                running = None
            if running is not None:
                if running["mast"]["digest"] != digest_of(data):
                    raise CommandError(
                        "other_daemon",
                        f"the daemon at {listen.url} uses a {running['mast']['file']} that differs from "
                        f"{config.mast_file}; end it, give --url, or a --config with another listen.port",
                    )
                yield client
                return
    hardware = config.hardware
    if hardware.simulation and "speed" not in hardware.simulation:
        hardware = replace(hardware, simulation={**hardware.simulation, "speed": "max"})
    state = args.out.with_name(f"{args.out.stem}.bench").absolute()
    mast_file = state / "masts" / config.mast_file.name
    mast_file.parent.mkdir(parents=True, exist_ok=True)
    save_bytes(mast_file, data)
    config = replace(
        config, hardware=hardware, listen=Listen(port=0), state_folder=state, mast_file=mast_file
    )
    with output.waiting(args.json, "starting the daemon"):
        daemon = RunningDaemon(config)
    with daemon, Client(daemon.url, name=BENCH) as client:
        yield client

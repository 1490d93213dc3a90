"""Provoke surveys or benches, calibrate by them, and show what the verdict says.

    .venv/bin/python -m tools.campaigns.provocations survey --cases 200 --seed 1 [--only KIND]
    .venv/bin/python -m tools.campaigns.provocations bench [--only NAME ...]

A survey is simulated with one thing wrong, a fifth of them with none; what is wrong and how much is drawn
(`tools.campaigns.provoked`). It is checked, fitted and judged as `mastctl calibrate` does it. The verdict is
compared with the simulator's rig: pixels that the new mast file predicts for points at 2 to 10 m, each camera
by itself, three directions; where a target lands that was clicked in a stereo pair of the head and pointed
at; and the mast's parameters together, unless its model is another one. The truth is *beyond 3 sigma* if
errors of one camera or pair, rms over its places and in sigmas that the calibration states, exceed 3, or the
mast's squared distance what chance makes of it once in 370. Trusted is "trust it", doubted "use it with
care", rejected "do not trust it"; a refusal to calibrate counts by itself. *Named* are the surveys whose
cause a sentence, or a measurement that was left out, names.

A bench is run by a daemon on the packaged simulated bench, one run a case. Boards
are rendered where and as they are wrong; darkness and cables are the simulator's faults; what a camera would
do to a picture (mirrored print, focus, blur) is done to its pixels by OpenCV on the path to the command.
Printed are the exit code, the pictures in the folder afterwards, and the sentence.
"""

from __future__ import annotations

import argparse
import math
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from calib.adjust.result import Calibration
from calib.adjust.uncertainty import pixel_covariance, pointing_covariance
from calib.calibrate.survey import fit_joint
from calib.errors import CalibError
from calib.files.mast_file import load_rig
from calib.geometry.pointing import solve
from calib.geometry.rig import MAST_NAMES, Rig, numbers_of
from calib.geometry.rigid import FloatArray
from calib.geometry.significance import Level
from calib.geometry.stereo import triangulate
from calib.survey.records import Sigma
from calib.targets.board_file import document_of, save_board
from calib.targets.boards import AnyBoard, AprilGrid, Charuco
from drivers.interfaces import Image
from hil_tests.support.sim_survey.plan import SurveyPlan, rover_from_head
from mastctl.bench.mast import BOARD
from mastctl.bench.operation import carry_out
from mastctl.bench.runs import BenchJob
from mastctl.calibration.run import SurveyRefused, checked_survey
from mastctl.calibration.verdict import judge
from mastctl.client import Client, Snapshot
from mastctl.config import Listen, load_config
from mastctl.daemon import RunningDaemon
from mastctl.packaged import config_folder
from tools.campaigns.provoked import PROVOCATIONS, Provoked
from tools.command import end, heading, line, options, results_of, rms

DIRECTIONS_RAD = ((-0.8, -0.2), (0.0, -0.4), (0.7, -0.7))
RANGES_M = (2.0, 6.0, 10.0)
PLACES = ((0.5, 0.5), (0.25, 0.7))
"""Where points are seen, as parts of the picture's width and height."""

RIG = config_folder() / "sim" / "rocky8.yaml"
PAIRS = ("navcam", "hazcam")
"""Pairs of the rig that are surveyed: four of its cameras are enough, and quicker."""

SIGMAS = 3.0
CLEAN = 5
"""One case in so many has nothing wrong."""

SIGMA = Sigma(station_m=0.001, dot_px=0.1)
COUNTED_RAD = 1e-4
"""What every other survey states of its joints, and what their readings err by."""


FAR = ("beyond", "within")
"""Where the truth is, against three of the stated sigmas."""

SAID = {"good": "trusted", "care": "doubted", "bad": "rejected"}


class ProvokedTask(NamedTuple):
    """One survey of a true rig."""

    rig: Rig
    kind: str
    seed: int


class ProvokedOutcome(NamedTuple):
    """What came of a survey: what was wrong, the grade or '' if refused, the worst error in sigmas and of
    what, the reasons that were not good, and whether the cause is named."""

    kind: str
    summary: str
    grade: str
    sigmas: float
    worst: str
    reasons: tuple[str, ...]
    named: bool

    @property
    def cell(self) -> str:
        """The column of the table that it belongs to."""
        return f"{FAR[self.sigmas <= SIGMAS]}: {SAID[self.grade]}" if self.grade else "refused"


def judged(task: ProvokedTask) -> ProvokedOutcome:
    """Return what the verdict on one provoked survey is, and how far the truth is."""
    joint_rad = COUNTED_RAD if task.seed % 2 else 0.0
    plan = SurveyPlan(sigma=replace(SIGMA, joint_rad=joint_rad))
    rng = np.random.default_rng([task.seed, 7])
    made = PROVOCATIONS[task.kind](task.rig, task.seed, plan, rng)
    try:
        warnings = checked_survey(made.survey)
        fit = fit_joint(made.survey, made.mast_parameters)
    except (SurveyRefused, CalibError) as refused:
        reasons: tuple[str, ...] = (str(refused),)
        return ProvokedOutcome(
            task.kind, made.summary, "", float("nan"), "", reasons, _names_cause(made, reasons)
        )
    verdict = judge(made.survey, fit, warnings)
    errors = errors_in_sigmas(made, fit)
    worst = max(errors, key=errors.__getitem__)
    reasons = tuple(r.sentence for r in verdict.reasons if r.grade != "good")
    reasons += tuple(str(warning) for warning in warnings)
    named = _names_cause(made, [*reasons, *(outlier.name for outlier in fit.outliers)])
    return ProvokedOutcome(task.kind, made.summary, verdict.grade, errors[worst], worst, reasons, named)


def _names_cause(made: Provoked, sentences: Sequence[str]) -> bool:
    return bool(made.cause) and any(re.search(made.cause, sentence) for sentence in sentences)


def errors_in_sigmas(made: Provoked, fit: Calibration) -> dict[str, float]:
    """Return how far a fit is from the truth, by what it is good for, in its own sigmas."""
    found = {f"pixels of {name}": rms(_pixels(made, fit, name)) for name in made.rig.cameras}
    for pair, names in made.rig.stereo.items():
        if made.rig.cameras[names[0]].on == "head":
            landed = _pointing(made, fit, names)
            found[f"pointing by {pair}"] = rms(landed) if len(landed) else 0.0
    fitted = fit.part("mast.")
    if not made.waves and not (made.rig.mast.axis_offset_m or made.rig.mast.axis_twist_rad):
        numbers = [fit.parameter_names[i].removeprefix("mast.") for i in fitted]
        truth = dict(zip(MAST_NAMES, numbers_of(made.rig.mast), strict=True))
        off = fit.estimate[fitted] - np.array([truth[name] for name in numbers])
        covariance = fit.covariance[np.ix_(fitted, fitted)]
        distance = float(off @ np.linalg.solve(covariance, off))
        # The distance at which chance is that of three sigma of one number counts as three.
        found["mast"] = SIGMAS * float(np.sqrt(distance / chi2.isf(Level.THREE_SIGMAS, len(off))))
    return found


def _seen(made: Provoked, name: str, true_rad: FloatArray, points_m: FloatArray) -> FloatArray:
    """True pixels (n, 2) of rover-frame points (n, 3), the kinematics SciPy's."""
    camera = made.rig.cameras[name]
    if camera.on == "head":
        points_m = rover_from_head(made.rig.mast, *true_rad).inverse.points(points_m)
    return camera.model.project(points_m)[0]


def _points(made: Provoked, name: str, true_rad: FloatArray) -> FloatArray:
    """Rover-frame points (n, 3) that a camera sees at its places and ranges."""
    camera = made.rig.cameras[name]
    rays = camera.model.ray(np.array(PLACES) * camera.model.size_px)
    points = np.concatenate([rays.origins_m + r * rays.directions for r in RANGES_M])
    return rover_from_head(made.rig.mast, *true_rad).points(points) if camera.on == "head" else points


def _pixels(made: Provoked, fit: Calibration, name: str) -> FloatArray:
    """Predicted less true pixels over their sigmas."""
    errors = []
    for angles in DIRECTIONS_RAD if made.rig.cameras[name].on == "head" else DIRECTIONS_RAD[:1]:
        true_rad = np.array(angles)
        points = _points(made, name, true_rad)
        read_rad = made.read_rad(true_rad)
        predicted, covariance = pixel_covariance(fit, name, float(read_rad[0]), float(read_rad[1]), points)
        off = predicted - _seen(made, name, true_rad, points)
        errors.append(off / np.sqrt(np.einsum("nii->ni", covariance)))
    return np.concatenate(errors)


def _pointing(made: Provoked, fit: Calibration, pair: tuple[str, str]) -> FloatArray:
    """Where targets land less where they should, over the stated sigmas; exact clicks."""
    errors = []
    wanted = np.array(fit.rig.cameras[pair[0]].model.image_center_px)
    for angles in DIRECTIONS_RAD:
        true_rad = np.array(angles)
        pan, tilt = made.read_rad(true_rad)
        for target in _points(made, pair[0], true_rad)[:: len(PLACES)]:
            clicks = [_seen(made, name, true_rad, target[None])[0] for name in pair]
            sizes = [np.array(made.rig.cameras[name].model.size_px) for name in pair]
            if any((c < 0).any() or (c > s - 1).any() for c, s in zip(clicks, sizes, strict=True)):
                continue
            range_m = float(np.linalg.norm(target - fit.rig.camera_in_rover(pair[0], pan, tilt).C))
            try:
                one, other = (fit.rig.camera_in_rover(name, pan, tilt) for name in pair)
                position = triangulate(one, other, clicks[0], clicks[1]).position_m
                then = solve(fit.rig.mast, fit.rig.cameras[pair[0]].model, position, from_pan_rad=pan,
                             from_tilt_rad=tilt)[0]  # fmt: skip
                covariance = pointing_covariance(fit, pair, pan, tilt, clicks[0], range_m)
            except CalibError:
                continue
            there = made.true_rad(np.array([then.pan_rad, then.tilt_rad]))
            off = _seen(made, pair[0], there, target[None])[0] - wanted
            errors.append(off / np.sqrt(np.diag(covariance)))
    return np.array(errors)


def tasks_of(rig: Rig, cases: int, seed: int) -> list[ProvokedTask]:
    """The cases: one kind after the other, the clean ones a fifth of all."""
    wrong = [kind for kind in PROVOCATIONS if kind != "nothing wrong"]
    kinds = [
        "nothing wrong" if n % CLEAN == 0 else wrong[(n - n // CLEAN - 1) % len(wrong)] for n in range(cases)
    ]
    return [ProvokedTask(rig, kind, seed + number) for number, kind in enumerate(kinds)]


PRINTED = Charuco(10, 6, 0.055, 0.04125)
LEFT, RIGHT = "navcam_left", "navcam_right"
PAN_AXIS_M = (0.3443, -0.0043)
"""x and y in the rover, of configs/sim/rocky8.yaml."""

HALF_WAY = 6
"""Looks after which something happens."""

Act = Callable[[Client], object]
Change = Callable[[str, Image], Image]


@dataclass(frozen=True)
class BenchCase:
    """Something wrong: from which look on, what is done to the rover, once or before each picture, what to
    pictures, which board it is that stands there, and how far to the right of where it was asked for."""

    name: str
    after: int = 0
    act: Act = lambda client: None
    change: Change = lambda camera, image: image
    stands: AnyBoard = PRINTED
    aside_deg: float = 0.0
    always: bool = False


def board_aside(client: Client) -> None:
    """Push the board by 2 cm."""
    stands = client.boards()[BOARD]
    x, y, z = stands["position_m"]
    client.put_board(BOARD, [x, y + 0.02, z], quaternion=stands["quaternion"])


def twin_board(client: Client) -> None:
    """Hold a second board of the same markers up, half a metre beside the first."""
    stands = client.boards()[BOARD]
    x, y, z = stands["position_m"]
    client.put_board("twin", [x, y + 0.62, z], document_of(PRINTED), quaternion=stands["quaternion"])


def turned(client: Client) -> None:
    """The whole rover turns by 10 mrad about its pan axis, and so the head, which reads what it read."""
    turn_rad, (ahead_m, aside_m) = 0.01, PAN_AXIS_M
    client.stand(turn_rad * aside_m, -turn_rad * ahead_m, turn_rad)


def all_off(client: Client) -> None:
    """Both cables are pulled."""
    for camera in (LEFT, RIGHT):
        client.set_fault(camera, "off")


def dark(client: Client) -> None:
    """The lamp is off."""
    for camera in (LEFT, RIGHT):
        client.set_fault(camera, "dark")


def night(client: Client) -> None:
    """Light falls on the board only: where it is out of the picture nothing is seen."""
    x, y, _ = client.boards()[BOARD]["position_m"]
    joints = client.status()["joints"]
    pan_rad = joints["pan_rad"] if joints else 0.0
    client.clear_faults()
    if abs(math.atan2(y - PAN_AXIS_M[1], x - PAN_AXIS_M[0]) - pan_rad) > math.radians(32.0):
        dark(client)


def longer(camera: str, image: Image) -> Image:
    """Half a per cent more focal length, of the left camera."""
    if camera != LEFT:
        return image
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), 0.0, 1.005)
    return np.asarray(cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_CUBIC), dtype=np.uint8)


def knocked(camera: str, image: Image) -> Image:
    """Two pixels to the right, of the left camera."""
    return np.roll(image, 2, axis=1) if camera == LEFT else image


def blurred(camera: str, image: Image) -> Image:
    """Moved by 25 pixels while the shutter was open."""
    line = np.full((1, 25), 1 / 25.0)
    return np.asarray(cv2.filter2D(image, -1, line), dtype=np.uint8)


def mirrored(camera: str, image: Image) -> Image:
    """As of a board that was printed from behind."""
    return np.ascontiguousarray(image[:, ::-1])


CASES = (
    BenchCase("nothing"),
    BenchCase("other columns and rows", stands=Charuco(8, 5, 0.065, 0.049)),
    BenchCase("other ids", stands=Charuco(10, 6, 0.055, 0.04125, first_id=40)),
    BenchCase("another kind of board", stands=AprilGrid(6, 4, 0.061, 0.0183)),
    BenchCase("half a per cent larger than stated", stands=Charuco(10, 6, 0.055275, 0.04145625)),
    BenchCase("mirrored print", change=mirrored),
    BenchCase("34 degrees aside, and night but there", act=night, always=True, aside_deg=34.0),
    BenchCase("100 degrees aside, and night but there", act=night, always=True, aside_deg=100.0),
    BenchCase("two boards of the same ids", 1, twin_board),
    BenchCase("board moved 2 cm in a placement", HALF_WAY, board_aside),
    BenchCase("pan slipped by 10 mrad", HALF_WAY, turned),
    BenchCase("left camera refocused by 0.5 %", HALF_WAY, change=longer),
    BenchCase("left camera knocked by 2 px", HALF_WAY, change=knocked),
    BenchCase("too dark from the first", 0, dark),
    BenchCase("too dark half-way", HALF_WAY, dark),
    BenchCase("motion blur of 25 px from the first", change=blurred),
    BenchCase("motion blur of 25 px half-way", HALF_WAY, change=blurred),
    BenchCase("one camera's cable pulled half-way", HALF_WAY, lambda client: client.set_fault(RIGHT, "off")),
    BenchCase("both cables pulled half-way", HALF_WAY, all_off),
)


@contextmanager
def provoked(case: BenchCase) -> Iterator[None]:
    """Have it happen to every picture that a client takes."""
    snapshot, put_board = Client.snapshot, Client.put_board
    looks, acted = 0, False

    def look(client: Client, camera: str, *args: Any, **options: Any) -> Snapshot:
        nonlocal looks, acted
        if looks >= case.after and (case.always or not acted):
            acted = True
            case.act(client)
        shot = snapshot(client, camera, *args, **options)
        looks += camera == LEFT
        if looks <= case.after:
            return shot
        image = case.change(camera, shot.image)
        if image is shot.image:
            return shot
        return replace(shot, data=cv2.imencode(".png", image)[1].tobytes())

    def put(client: Client, name: str, position_m: Any, board: Any = None, **options: Any) -> Any:
        printed = document_of(case.stands) if board is not None and name == BOARD else board
        if case.aside_deg and name == BOARD:
            turn = Rotation.from_euler("z", case.aside_deg, degrees=True)
            axis_m = np.array([*PAN_AXIS_M, 0.0])
            position_m = (axis_m + turn.apply(np.subtract(position_m, axis_m))).tolist()
            stood = Rotation.from_quat(options["quaternion"], scalar_first=True)
            options["quaternion"] = (turn * stood).as_quat(scalar_first=True).tolist()
        return put_board(client, name, position_m, printed, **options)

    Client.snapshot, Client.put_board = look, put  # type: ignore[assignment,method-assign]
    try:
        yield
    finally:
        Client.snapshot, Client.put_board = snapshot, put_board  # type: ignore[method-assign]


def provoked_work(name: str, job: BenchJob, link: Connection) -> None:
    """Carry a bench out in its worker, with a case of this name."""
    with provoked(next(one for one in CASES if one.name == name)):
        carry_out(job, link)


def bench_row(name: str) -> tuple[str, str, int, str]:
    """Name, state, pictures kept, and the sentence: a refusal, else the verdict and what is not well."""
    config = load_config(config_folder() / "bench.yaml")
    simulation = {**config.hardware.simulation, "speed": "max", "samples": 1}
    hardware = replace(config.hardware, simulation=simulation)
    with tempfile.TemporaryDirectory() as folder:
        mast_file = Path(shutil.copy(config.mast_file, folder))  # the run's own goes beside it
        config = replace(config, listen=Listen(port=0), hardware=hardware, mast_file=mast_file)
        save_board(board := Path(folder, "board.yaml"), PRINTED)
        with RunningDaemon(config) as daemon, Client(daemon.url) as client:
            daemon.service.bench.work = partial(provoked_work, name)
            client.begin_bench(board_file=board.read_text())
            runs: Any = (event["value"] for event in client.events("bench"))
            run = next(one for one in runs if one["step"] == "over")
            kept = client.bench()["runs"][0]["pictures"]
    if run["result"] is None:
        return name, run["state"], kept, run["sentence"]
    bad = [one["sentence"] for one in run["result"]["verdict"]["reasons"] if one["grade"] != "good"]
    return name, run["state"], kept, f"{run['sentence']}: " + ("; ".join(bad) or "all is well")


def rig_of_pairs(file: Path, pairs: Sequence[str]) -> Rig:
    """Return the rig of a file with some of its pairs."""
    rig = load_rig(file).rig
    names = {name for pair in pairs for name in rig.stereo[pair]}
    cameras = {name: camera for name, camera in rig.cameras.items() if name in names}
    return replace(rig, cameras=cameras, stereo={pair: rig.stereo[pair] for pair in pairs})


def surveys(args: argparse.Namespace) -> int:
    """Print the table of surveys, and every case in which the verdict erred."""
    tasks = tasks_of(rig_of_pairs(RIG, PAIRS), args.cases, args.seed)
    if args.only:
        tasks = [task._replace(kind=args.only[0]) for task in tasks]
    outcomes = results_of(args, "surveys", judged, tasks, "seed {0.seed}, {0.kind}".format)
    columns = ("refused", *(f"{far}: {said}" for far in FAR for said in SAID.values()))
    print(heading(("wrong", "cases", "named", *columns)))
    for kind in [*PROVOCATIONS, "all"]:
        mine = [one for one in outcomes if kind in (one.kind, "all")]
        count = Counter(one.cell for one in mine)
        if mine:
            print(
                line(kind, len(mine), sum(one.named for one in mine), *(count[column] for column in columns))
            )
    for one in outcomes:
        trusted = one.cell == f"{FAR[0]}: {SAID['good']}"
        if trusted or (one.kind == "nothing wrong" and one.grade != "good"):
            print(f"{one.cell}: {one.summary}: {one.worst} {one.sigmas:.1f} sigma; {' | '.join(one.reasons)}")
    return 0


def benches(args: argparse.Namespace) -> int:
    """Print the table of benches."""
    names = [case.name for case in CASES if not args.only or any(part in case.name for part in args.only)]
    rows = results_of(args, "benches", bench_row, names)
    print(heading(("provoked", "state", "pictures kept", "message")))
    for row in rows:
        print(line(*row))
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = options(__doc__, 200, "surveys")
    parser.add_argument("of", choices=("survey", "bench"))
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", help="this kind of survey; benches whose names contain one"
    )
    args = parser.parse_args(words)
    if args.of == "survey" and args.only and args.only[0] not in PROVOCATIONS:
        parser.error(f"--only {args.only[0]}: one of {', '.join(PROVOCATIONS)} is expected")
    return surveys(args) if args.of == "survey" else benches(args)


if __name__ == "__main__":
    end(main)

"""What a driven bench says when something is wrong, each provoked through the command on the simulated bench.

    .venv/bin/python -m tools.campaigns.bench_provoked [--only NAME ...]

One daemon of the packaged bench, one run of `mastctl calibrate bench` a case. Boards are rendered where and
as they are wrong; darkness and cables are the simulator's faults; what a camera would do to a picture
(mirrored print, focus, blur) is done to its pixels by OpenCV on the way to the command. Told are the exit
code, the pictures that are in the folder afterwards, whether it can be read, and the sentence.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import CalibError
from calib.survey.reader import read_survey
from calib.targets.board_file import document_of, save_board
from calib.targets.boards import AnyBoard, AprilGrid, Charuco
from drivers.interfaces import Image
from mastctl.bench.simulated import BOARD
from mastctl.cli.main import main as mastctl
from mastctl.client import Client, Snapshot
from mastctl.config import Listen, load_config
from mastctl.daemon import RunningDaemon
from mastctl.packaged import config_folder
from tools.command import end, heading, line, options

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


def slipped(client: Client) -> None:
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
    pan_rad = (client.status()["joints"] or {})["pan_rad"]
    client.clear_faults()
    if abs(math.atan2(y - PAN_AXIS_M[1], x - PAN_AXIS_M[0]) - pan_rad) > math.radians(32.0):
        dark(client)


def refocused(camera: str, image: Image) -> Image:
    """Half a per cent more focal length, of the left camera."""
    if camera != LEFT:
        return image
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), 0.0, 1.005)
    return np.asarray(cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_CUBIC), dtype=np.uint8)


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
    BenchCase("pan slipped by 10 mrad", HALF_WAY, slipped),
    BenchCase("left camera refocused by 0.5 %", HALF_WAY, change=refocused),
    BenchCase("too dark from the first", 0, dark),
    BenchCase("too dark half-way", HALF_WAY, dark),
    BenchCase("motion blur of 25 px from the first", change=blurred),
    BenchCase("motion blur of 25 px half-way", HALF_WAY, change=blurred),
    BenchCase("one camera's cable pulled half-way", HALF_WAY, lambda client: client.set_fault(RIGHT, "off")),
    BenchCase("both cables pulled half-way", HALF_WAY, all_off),
)


@contextmanager
def provoked(case: BenchCase) -> Iterator[None]:
    """Have it happen to whoever looks through a client."""
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
        return replace(shot, image=image, data=cv2.imencode(".png", image)[1].tobytes())

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


def told(case: BenchCase, url: str, folder: Path) -> tuple[int, int, str]:
    """Exit code, pictures kept, and the sentence: a refusal, else the verdict and what is not well."""
    board, out = folder / "board.yaml", folder / "mast.yaml"
    save_board(board, PRINTED)
    words = ["calibrate", "bench", "--url", url, "--board", board, "--out", out, "--json"]
    printed = io.StringIO()
    with provoked(case), contextlib.redirect_stdout(printed):
        code = mastctl([str(word) for word in words])
    document = json.loads(printed.getvalue())
    try:
        kept = len(read_survey(folder / "mast.bench").images)
    except CalibError as error:
        return code, -1, f"THE FOLDER CANNOT BE READ: {error}"
    if "error" in document:
        return code, kept, document["error"]["message"].replace(str(folder), "FOLDER")
    bad = [one["sentence"] for one in document["verdict"]["reasons"] if one["grade"] != "good"]
    return code, kept, f"{document['verdict']['words']}: " + ("; ".join(bad) or "all is well")


def clean(url: str) -> None:
    """Put everything in order again."""
    with Client(url) as client:
        client.clear_faults()
        client.stand(0.0, 0.0, 0.0)
        for name in client.boards():
            client.take_board(name)


def main(words: Sequence[str] | None = None) -> int:
    """Provoke all, and print a table."""
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="cases whose names contain one of these")
    args = parser.parse_args(words)
    config = load_config(config_folder() / "bench.yaml")
    simulation = {**config.hardware.simulation, "speed": "max", "samples": 1}
    config = replace(config, listen=Listen(port=0), hardware=replace(config.hardware, simulation=simulation))
    print(heading(("provoked", "exit", "pictures kept", "said")), flush=True)
    with RunningDaemon(config) as daemon:
        for case in CASES:
            if args.only and not any(part in case.name for part in args.only):
                continue
            with tempfile.TemporaryDirectory() as folder:
                code, kept, sentence = told(case, daemon.url, Path(folder))
            print(line(case.name, code, kept, sentence), flush=True)
            clean(daemon.url)
    return 0


if __name__ == "__main__":
    end(main)

"""Who places the board of a simulated bench: the program itself, where it was asked for or as a file says."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from calib.errors import BadFile
from calib.files import read_bytes
from calib.files.yaml_text import MAX_BYTES, Section, parse_mapping
from calib.geometry.rig import Rig
from calib.plan.placements import Placement
from calib.targets.board_file import document_of
from calib.targets.boards import AnyBoard
from mastctl.bench.events import BenchProgress, Step
from mastctl.bench.eyes import BenchHead
from mastctl.bench.teller import NobodyThere, Teller
from mastctl.client import Client

BOARD = "bench"
"""What the board is called in the simulation."""

SCHEMA = "mastctl/placements/1"
_BOUNDS: Mapping[str, tuple[float, float]] = {
    "range_m": (0.2, 20.0),
    "bearing_deg": (-180.0, 180.0),
    "height_deg": (-80.0, 80.0),
}


class SimulatedPerson:
    """Moves the board of a simulated rover; see `mastctl.bench.teller.Teller`.

    Parameters
    ----------
    client
        Of the simulated rover's daemon.
    board, rig
        What is placed, and where the head is believed to be.
    told
        Who is told how it goes.
    file
        Where the board stands in turn; None: where it is asked for.
    asks
        Whether who is told is asked for each placement too, as at a real bench.
    """

    def __init__(
        self,
        client: Client,
        board: AnyBoard,
        rig: Rig,
        told: Teller,
        file: Path | None,
        asks: bool = False,
    ) -> None:
        self._client, self._board, self._rig, self._told = client, board, rig, told
        self._asks = asks
        self._places = None if file is None else read_placements(file)
        self._file = file

    def say(self, sentence: str) -> None:
        """Pass it on."""
        self._told.say(sentence)

    def step(self, step: Step) -> None:
        """Pass it on."""
        self._told.step(step)

    def progress(self, now: BenchProgress) -> None:
        """Pass it on."""
        self._told.progress(now)

    def place(self, name: str, placement: Placement, head: BenchHead) -> None:
        """Put the board there, or where the file has it.

        Raises
        ------
        NobodyThere
            If the file has no more places.
        """
        asked, placement = placement, self._where(name, placement)
        said = "" if placement == asked else f" (asked for: {asked.words()})"
        if self._asks:
            self._told.place(name, asked, head)
        if not self._asks or said:
            self._told.say(f"placement {name}: the board {placement.words()}{said}")
        self.stand(placement)

    def stands(self, name: str, placement: Placement | None, head: BenchHead) -> None:
        """Put a board back that the simulation has forgotten with a daemon that ended."""
        if placement is not None and BOARD not in self._client.boards():
            self.stand(self._where(name, placement))

    def _where(self, name: str, placement: Placement) -> Placement:
        """Where a placement truly is.

        Raises
        ------
        NobodyThere
            If the file has no more places.
        """
        if self._places is not None:
            number = int(name.removeprefix("p")) - 1
            if number >= len(self._places):
                raise NobodyThere(
                    f"{self._file} has {len(self._places)} placements, and one more is asked for: "
                    f"{placement.words()}"
                )
            return self._places[number]
        return placement

    def stand(self, placement: Placement) -> None:
        """Put the simulated board somewhere."""
        pose = placement.rover_from_board(self._rig.mast.rover_from_head(0.0, 0.0))
        quaternion = Rotation.from_matrix(pose.rotation).as_quat(scalar_first=True)
        self._client.put_board(
            BOARD, pose.translation_m.tolist(), document_of(self._board), quaternion=quaternion.tolist()
        )


def read_placements(file: Path) -> tuple[Placement, ...]:
    """Return the places of a file, in turn.

    Raises
    ------
    BadFile
        With the place, what it holds and what is expected.
    """
    top = Section(file, "", parse_mapping(read_bytes(file, MAX_BYTES), file), ("schema", "placements"), ())
    if top.values["schema"] != SCHEMA:
        raise top.bad("schema", f"'{SCHEMA}' is expected")
    rows = top.values["placements"]
    if not isinstance(rows, list) or not rows:
        raise top.bad("placements", "a list of places is expected")
    return tuple(_placement(file, f"placements[{k}]", row) for k, row in enumerate(rows))


def _placement(file: Path, place: str, row: Any) -> Placement:
    if not isinstance(row, dict):
        raise BadFile(file, place, "keys and values are expected, as {range_m: 1.2, bearing_deg: -30}")
    section = Section(file, place, row, ("range_m",), ("bearing_deg", "height_deg", "turned_deg"))
    numbers = {key: section.between(key, low, high, 0.0) for key, (low, high) in _BOUNDS.items()}
    turned: Sequence[float] = (0.0, 0.0)
    if "turned_deg" in section:
        turned = section.values["turned_deg"]
        if not isinstance(turned, list) or len(turned) != 2 or not all(_angle(one) for one in turned):
            raise section.bad(
                "turned_deg", "two angles within 80 degrees are expected, to the right and upwards"
            )
    return Placement(**numbers, turned_deg=(float(turned[0]), float(turned[1])))


def _angle(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.fabs(value) <= 80.0

"""Who places the board of a simulated bench: the program itself, where it was asked for or as a file says."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from scipy.spatial.transform import Rotation

from calib.files import read_bytes
from calib.files.records import Record, parse_record
from calib.files.yaml_text import MAX_BYTES
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
_Turn = Annotated[float, Field(ge=-80.0, le=80.0)]


class PlacementRecord(Record):
    """A place of the board; it is turned to the right and upwards."""

    range_m: Annotated[float, Field(ge=0.2, le=20.0)]
    bearing_deg: Annotated[float, Field(ge=-180.0, le=180.0)] = 0.0
    height_deg: _Turn = 0.0
    turned_deg: Annotated[list[_Turn], Field(min_length=2, max_length=2)] = Field(default=[0.0, 0.0])

    @property
    def placement(self) -> Placement:
        """The place."""
        turned_deg = self.turned_deg[0], self.turned_deg[1]
        return Placement(self.range_m, self.bearing_deg, self.height_deg, turned_deg)


class PlacementsRecord(Record):
    """A file of places."""

    schema_: Literal["mastctl/placements/1"] = Field(alias="schema")
    placements: Annotated[list[PlacementRecord], Field(min_length=1)]


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
    record = parse_record(PlacementsRecord, read_bytes(file, MAX_BYTES), file, SCHEMA)
    return tuple(one.placement for one in record.placements)

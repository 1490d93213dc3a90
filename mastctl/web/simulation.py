"""Routes of a simulated rover: its fault switches, and where it truly stands."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, Self, cast

import numpy as np
from fastapi import FastAPI, Path, Query
from pydantic import Field, model_validator

from calib.errors import BadFile
from calib.geometry.rigid import Rigid, quaternion_of, rotation_of
from calib.targets.board_file import board_of, document_of
from drivers.faults import BOUNDS, WHEN, FaultPanel, Word
from drivers.simulation_clock import MAX, SimulationClock
from mastctl import answers
from mastctl.as_json import as_json
from mastctl.control.entry import Command
from mastctl.errors import BadRequest, NoLonger, NotKnown, NotNow
from mastctl.http import PREFIX
from mastctl.motion.requests import LARGEST_M, LARGEST_PX, Angle, Metres, Name, Place, StrictBody
from mastctl.service.service import Service
from mastctl.web.commands import Here, StrictQuery, command

if TYPE_CHECKING:
    from drivers.sim.bench_boards import BenchBoard
    from drivers.sim.rover import RoverModel

BoardName = Annotated[
    str,
    Path(
        pattern="^[A-Za-z0-9][A-Za-z0-9_-]{0,39}$",
        description="1 to 40 letters a to z, digits, '_' and '-', the first a letter or digit,",
    ),
]

Slope = Annotated[float, Field(ge=-1.0, le=1.0)]
Turn = Annotated[float, Field(ge=-1e9, le=1e9)]
QueryPixel = Annotated[float, Field(ge=-LARGEST_PX, le=LARGEST_PX)]
QueryMetres = Annotated[float, Field(ge=-LARGEST_M, le=LARGEST_M)]


class StandBody(StrictBody):
    """``POST /simulation/pose``: where the simulated rover truly stands on its ground."""

    x_m: Metres
    y_m: Metres
    heading_rad: Angle
    pitch_rad: Slope = 0.0
    roll_rad: Slope = 0.0


class BoardBody(StrictBody):
    """``POST /simulation/boards/{name}``: where a board is held up before a simulated rover.

    ``board`` holds what a BOARD.yaml does (its ``schema`` may be left out); without it a board of this name
    is moved that is there already. The place is in the rover frame as the rover stands now. Without
    ``quaternion`` (w, x, y, z; rover_from_board) it faces the mast upright.
    """

    position_m: Place
    board: dict[str, Any] | None = None
    quaternion: Annotated[list[Turn], Field(min_length=4, max_length=4)] | None = None
    bow_m: Annotated[list[Metres], Field(min_length=2, max_length=2)] | None = None

    @model_validator(mode="after")
    def _turned(self) -> Self:
        if self.quaternion is not None and math.hypot(*self.quaternion) < 1e-6:
            raise ValueError(f"quaternion: {self.quaternion} where one that is not zero is expected")
        return self


class TimeBody(StrictBody):
    """``POST /simulation/time``: let time pass where it does not pass by itself."""

    advance_s: Annotated[float, Field(ge=0.0, le=3600.0)]


class FaultBody(StrictBody):
    """``POST /simulation/faults``: a fault of a simulated device, with its parameters."""

    device: Name
    word: Name
    parameters: dict[str, float] = Field(default_factory=dict)


class TruthQuery(StrictQuery):
    """``GET /simulation/truth``: a frame, and a pixel of it or a point of the site, metres."""

    frame_id: Name
    x_px: QueryPixel | None = None
    y_px: QueryPixel | None = None
    x_m: QueryMetres | None = None
    y_m: QueryMetres | None = None
    z_m: QueryMetres | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.model_fields_set - {"frame_id"} not in ({"x_px", "y_px"}, {"x_m", "y_m", "z_m"}):
            raise ValueError("x_px and y_px, or x_m, y_m and z_m, are expected, and not both")
        return self


class FaultsQuery(StrictQuery):
    """``DELETE /simulation/faults``; without a device all faults are taken back."""

    device: Name | None = None


def add_simulation(app: FastAPI) -> None:
    """The fault switches of a simulated rover, and where it truly stands."""

    @app.get(f"{PREFIX}/simulation/pose", summary="Where the simulated rover truly stands")
    async def true_pose(here: Here) -> answers.TruePose:
        return await here.waiting.run(lambda: _pose(_rover(here.service, "true poses").site_from_rover))

    @command(app, "POST /simulation/pose", Command("simulation.pose"))
    def stand(body: StandBody, here: Here) -> answers.TruePose:
        """Put the simulated rover somewhere on its ground."""
        rover = _rover(here.service, "true poses")
        rover.stand(body.x_m, body.y_m, body.heading_rad, body.pitch_rad, body.roll_rad)
        return _pose(rover.site_from_rover)

    @app.get(f"{PREFIX}/simulation/boards", summary="The boards held up before the simulated rover")
    async def boards(here: Here) -> answers.BoardList:
        return await here.waiting.run(lambda: _boards(_rover(here.service, "boards")))

    @command(app, "POST /simulation/boards/{name}", Command("simulation.board"))
    def put_board(name: BoardName, body: BoardBody, here: Here) -> answers.BoardPose:
        """Hold up a board, or move it."""
        rover = _rover(here.service, "boards")
        printed = None
        if body.board is not None:
            document = {key: value for key, value in body.board.items() if key != "schema"}
            try:
                printed = board_of(name, "board", document)
            except BadFile as error:
                raise BadRequest("bad_board", f"{error.place}: {error.reason}") from None
        stands = rover.put_board(
            name,
            printed,
            body.position_m,
            rotation=None if body.quaternion is None else rotation_of(body.quaternion),
            bow_m=(body.bow_m[0], body.bow_m[1]) if body.bow_m is not None else None,
        )
        return _board(rover, stands)

    @command(app, "DELETE /simulation/boards/{name}", Command("simulation.board_gone"))
    def take_board(name: BoardName, here: Here) -> answers.BoardList:
        """Take a board away from the simulated rover."""
        rover = _rover(here.service, "boards")
        rover.take_board(name)
        return _boards(rover)

    @app.get(f"{PREFIX}/simulation/time", summary="The simulated rover's time, and how fast it goes")
    async def time(here: Here) -> answers.SimulationTime:
        return await here.waiting.run(lambda: _time(here.service))

    @command(app, "POST /simulation/time", Command("simulation.time"))
    def advance(body: TimeBody, here: Here) -> answers.SimulationTime:
        """Let time pass where it does not pass by itself."""
        speed = _time(here.service)["speed"]
        if speed != MAX:
            message = f"at simulation.speed {speed:g} time passes by itself; it is let pass only at {MAX}"
            raise NotNow("time_passes", message)
        here.service.clock.sleep(body.advance_s)
        return _time(here.service)

    @app.get(
        f"{PREFIX}/simulation/truth",
        summary="The true point at a pixel of a frame, or the true pixel of a point",
    )
    async def truth(query: Annotated[TruthQuery, Query()], here: Here) -> answers.PointTruth:
        return await here.waiting.run(lambda: _truth(here.service, query))

    @app.get(f"{PREFIX}/simulation/words", summary="The fault words of each device, with their parameters")
    async def words(here: Here) -> answers.FaultKinds:
        known = _panel(here.service).words.items()
        return {"devices": {device: {name: _kind(kinds[name]) for name in kinds} for device, kinds in known}}

    @app.get(f"{PREFIX}/simulation/faults", summary="The faults that are switched on")
    async def faults(here: Here) -> answers.FaultsSet:
        return await here.waiting.run(lambda: _faults(_panel(here.service)))

    @command(app, "POST /simulation/faults", Command("simulation.fault"))
    def set_fault(body: FaultBody, here: Here) -> answers.FaultsSet:
        """Switch a fault on."""
        panel = _panel(here.service)
        panel.set(body.device, body.word, **body.parameters)
        return _faults(panel)

    @command(app, "DELETE /simulation/faults", Command("simulation.faults_off"))
    def clear_faults(query: Annotated[FaultsQuery, Query()], here: Here) -> answers.FaultsSet:
        """Switch the faults of one device, or all, off."""
        panel = _panel(here.service)
        panel.clear(query.device)
        return _faults(panel)


def _rover(service: Service, what: str) -> RoverModel:
    """The simulated rover, whose ``what`` are requested. Raises NotKnown."""
    if service.hardware.simulation is None:
        kind = service.hardware.kind
        message = f"{what} are for this program's own simulated rover only; the hardware is {kind}"
        raise NotKnown("not_simulated", message)
    return service.hardware.simulation


def _panel(service: Service) -> FaultPanel:
    return _rover(service, "faults").faults


def _pose(frame: Rigid) -> answers.TruePose:
    return {"position_m": frame.translation_m.tolist(), "quaternion": quaternion_of(frame.rotation)}


def _board(rover: RoverModel, one: BenchBoard) -> answers.BoardPose:
    rover_from_board = rover.site_from_rover.inverse @ one.site_from_board
    return {"board": document_of(one.board), "bow_m": list(one.bow_m), **_pose(rover_from_board)}


def _boards(rover: RoverModel) -> answers.BoardList:
    return {"boards": {name: _board(rover, one) for name, one in rover.boards.items()}}


def _time(service: Service) -> answers.SimulationTime:
    _rover(service, "clocks")
    clock = service.clock
    speed = clock.speed if isinstance(clock, SimulationClock) else 1.0
    return {"now_s": clock.now_s(), "speed": "max" if speed == math.inf else speed}


def _truth(service: Service, query: TruthQuery) -> answers.PointTruth:
    """The truth requested. Raises NoLonger and as `frame_by_id`."""
    rover = _rover(service, "truths")
    frame = service.devices.store.by_id(query.frame_id)
    try:
        site_from_rover = rover.frame_truth(frame.camera, frame.sequence).site_from_rover
        if query.x_px is not None:
            pixel = np.array([query.x_px, query.y_px])
            point = rover.true_point(frame.camera, frame.sequence, pixel)
            if point is None:  # the sky
                return {"position_in_site_m": None, "position_m": None, "pixel_px": None}
        else:
            point = site_from_rover.inverse.points(np.array([query.x_m, query.y_m, query.z_m]))
            pixel = np.asarray(rover.true_pixel(frame.camera, frame.sequence, point))
    except LookupError as error:
        raise NoLonger("frame_too_old", str(error.args[0])) from None
    return {
        "position_in_site_m": site_from_rover.points(point).tolist(),
        "position_m": point.tolist(),
        "pixel_px": pixel.tolist() if np.isfinite(pixel).all() else None,
    }


def _kind(one: Word) -> answers.FaultKind:
    """A fault that can be set; a bound that is not there is null."""
    parameters: dict[str, answers.FaultParameter] = {
        name: {"default": as_json(usual), "least": BOUNDS[name][0], "most": as_json(BOUNDS[name][1])}
        for name, usual in {**one.parameters, **WHEN}.items()
    }
    return {"effect": one.does, "parameters": parameters}


def _faults(panel: FaultPanel) -> answers.FaultsSet:
    """The faults that are set; one without an end has ``end_s`` null."""
    faults = []
    for one in panel.active():
        finite = {name: value for name, value in one.parameters.items() if math.isfinite(value)}
        faults.append(cast(answers.FaultSet, as_json(one) | {"parameters": finite}))
    return {"faults": faults}

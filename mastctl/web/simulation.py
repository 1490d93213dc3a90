"""Routes of a simulated rover: its fault switches, and where it truly stands."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from fastapi import FastAPI, Path, Query
from scipy.spatial.transform import Rotation

from calib.boards.board_file import board_of, document_of
from calib.errors import BadFile
from calib.rigid import FloatArray, Rigid
from drivers.faults import BOUNDS, WHEN, FaultPanel
from drivers.faults import Fault as SetFault
from drivers.simulation_clock import MAX, SimulationClock
from mastctl.as_json import as_json
from mastctl.commands.entry import (
    SIMULATION_BOARD,
    SIMULATION_BOARD_GONE,
    SIMULATION_FAULT,
    SIMULATION_FAULTS_OFF,
    SIMULATION_POSE,
    SIMULATION_TIME,
)
from mastctl.errors import BadRequest, NoLonger, NotKnown, NotNow
from mastctl.service.service import Service
from mastctl.tracking.pose import RoverPose
from mastctl.web import PREFIX
from mastctl.web.commands import Commands, Headers
from mastctl.web.models import BoardBody, FaultBody, FaultsQuery, StandBody, TimeBody, TruthQuery
from mastctl.web.waiting import Waiting

if TYPE_CHECKING:
    from drivers.sim.bench_boards import BenchBoard
    from drivers.sim.rover import SimulatedRover

BoardName = Annotated[str, Path(pattern="^[A-Za-z0-9][A-Za-z0-9_-]{0,39}$")]


def add_simulation(app: FastAPI, service: Service, waiting: Waiting, commands: Commands) -> None:
    """The fault switches of a simulated rover, and where it truly stands."""

    def simulated(what: str) -> SimulatedRover:
        if service.hardware.simulation is None:
            kind = service.hardware.kind
            words = f"{what} are for this program's own simulated rover only; the hardware is {kind}"
            raise NotKnown("not_simulated", words)
        return service.hardware.simulation

    def panel() -> FaultPanel:
        return simulated("faults").faults

    def stands() -> dict[str, Any]:
        pose = RoverPose(simulated("true poses").site_from_rover).told(0.0)
        return {"position_m": pose["position_m"], "quaternion": pose["quaternion"]}

    @app.get(f"{PREFIX}/simulation/pose", summary="Where the simulated rover truly stands")
    async def true_pose() -> dict[str, Any]:
        return await waiting.run(stands)

    @app.post(f"{PREFIX}/simulation/pose", summary="Put the simulated rover somewhere on its ground")
    async def stand(body: StandBody, came: Headers) -> dict[str, Any]:
        def put() -> dict[str, Any]:
            rover = simulated("true poses")
            rover.stand(body.x_m, body.y_m, body.heading_rad, body.pitch_rad, body.roll_rad)
            return stands()

        return await commands.run(SIMULATION_POSE, came, body.model_dump(), put)

    def board_told(stands: BenchBoard) -> dict[str, Any]:
        pose = simulated("boards").site_from_rover.inverse @ stands.site_from_board
        return {
            "board": document_of(stands.board),
            "position_m": pose.translation_m.tolist(),
            "quaternion": Rotation.from_matrix(pose.rotation).as_quat(scalar_first=True).tolist(),
            "bow_m": list(stands.bow_m),
        }

    def boards_told() -> dict[str, Any]:
        return {"boards": {name: board_told(one) for name, one in simulated("boards").boards.items()}}

    @app.get(f"{PREFIX}/simulation/boards", summary="The boards held up before the simulated rover")
    async def boards() -> dict[str, Any]:
        return await waiting.run(boards_told)

    @app.post(f"{PREFIX}/simulation/boards/{{name}}", summary="Hold up a board, or move it")
    async def put_board(name: BoardName, body: BoardBody, came: Headers) -> dict[str, Any]:
        def put() -> dict[str, Any]:
            rover = simulated("boards")
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
                turned_rad=body.turned_rad or (0.0, 0.0, 0.0),
                rotation=body.rotation,
                bow_m=(body.bow_m[0], body.bow_m[1]) if body.bow_m is not None else None,
            )
            return board_told(stands)

        return await commands.run(SIMULATION_BOARD, came, {"name": name, **body.model_dump()}, put)

    @app.delete(f"{PREFIX}/simulation/boards/{{name}}", summary="Take a board away from the simulated rover")
    async def take_board(name: BoardName, came: Headers) -> dict[str, Any]:
        def take() -> dict[str, Any]:
            simulated("boards").take_board(name)
            return boards_told()

        return await commands.run(SIMULATION_BOARD_GONE, came, {"name": name}, take)

    def time_now() -> dict[str, Any]:
        simulated("clocks")
        clock = service.clock
        speed = clock.speed if isinstance(clock, SimulationClock) else 1.0
        return {"now_s": clock.now_s(), "speed": MAX if speed == math.inf else speed}

    @app.get(f"{PREFIX}/simulation/time", summary="The simulated rover's time, and how fast it goes")
    async def time() -> dict[str, Any]:
        return await waiting.run(time_now)

    @app.post(f"{PREFIX}/simulation/time", summary="Let time pass where it does not pass by itself")
    async def advance(body: TimeBody, came: Headers) -> dict[str, Any]:
        def pass_by() -> dict[str, Any]:
            speed = time_now()["speed"]
            if speed != MAX:
                words = f"at simulation.speed {speed:g} time passes by itself; it is let pass only at {MAX}"
                raise NotNow("time_passes", words)
            service.clock.sleep(body.advance_s)
            return time_now()

        return await commands.run(SIMULATION_TIME, came, body.model_dump(), pass_by)

    def truth_told(query: TruthQuery) -> dict[str, Any]:
        rover = simulated("truths")
        frame = service.devices.frame_by_id(query.frame_id)
        try:
            site_from_rover = rover.frame_truth(frame.camera, frame.sequence).site_from_rover
            if query.pixel_px is not None:
                point = rover.true_point(frame.camera, frame.sequence, query.pixel_px)
                return _truth_told(site_from_rover, point, query.pixel_px)
            point = site_from_rover.inverse.points(np.array(query.position_in_site_m))
            return _truth_told(site_from_rover, point, rover.true_pixel(frame.camera, frame.sequence, point))
        except LookupError as error:
            raise NoLonger("frame_too_old", str(error.args[0])) from None

    @app.get(f"{PREFIX}/simulation/truth", summary="What a pixel of a frame truly shows, or where a point is")
    async def truth(query: Annotated[TruthQuery, Query()]) -> dict[str, Any]:
        return await waiting.run(lambda: truth_told(query))

    @app.get(f"{PREFIX}/simulation/words", summary="The fault words of each device, with their parameters")
    async def words() -> dict[str, Any]:
        return await waiting.run(lambda: {"devices": _words_told(panel())})

    def told() -> dict[str, Any]:
        return {"faults": [_fault_told(fault) for fault in panel().active()]}

    @app.get(f"{PREFIX}/simulation/faults", summary="The faults that are switched on")
    async def faults() -> dict[str, Any]:
        return await waiting.run(told)

    @app.post(f"{PREFIX}/simulation/faults", summary="Switch a fault on")
    async def set_fault(body: FaultBody, came: Headers) -> dict[str, Any]:
        def act() -> dict[str, Any]:
            panel().set(body.device, body.word, **body.parameters)
            return told()

        return await commands.run(SIMULATION_FAULT, came, body.model_dump(), act)

    @app.delete(f"{PREFIX}/simulation/faults", summary="Switch the faults of one device, or all, off")
    async def clear_faults(query: Annotated[FaultsQuery, Query()], came: Headers) -> dict[str, Any]:
        def act() -> dict[str, Any]:
            panel().clear(query.device)
            return told()

        return await commands.run(SIMULATION_FAULTS_OFF, came, query.model_dump(exclude_none=True), act)


def _truth_told(site_from_rover: Rigid, point_m: FloatArray | None, pixel_px: Any) -> dict[str, Any]:
    """A point of the rover frame and its pixel as JSON; without a point nothing is known."""
    if point_m is None:
        return {"position_in_site_m": None, "position_m": None, "pixel_px": None}
    pixel = np.asarray(pixel_px, dtype=np.float64)
    return {
        "position_in_site_m": site_from_rover.points(point_m).tolist(),
        "position_m": point_m.tolist(),
        "pixel_px": pixel.tolist() if np.isfinite(pixel).all() else None,
    }


def _words_told(panel: FaultPanel) -> dict[str, Any]:
    """What each device takes as JSON; what has no end is null."""

    def parameter(name: str, usual: float) -> dict[str, float | None]:
        least, most = BOUNDS[name]
        return {"usual": as_json(usual), "least": least, "most": as_json(most)}

    return {
        device: {
            name: {
                "does": word.does,
                "parameters": {
                    one: parameter(one, usual) for one, usual in {**word.parameters, **WHEN}.items()
                },
            }
            for name, word in words.items()
        }
        for device, words in panel.words.items()
    }


def _fault_told(fault: SetFault) -> dict[str, Any]:
    """A set fault as JSON; one without an end has ``end_s`` null."""
    finite = {name: value for name, value in fault.parameters.items() if math.isfinite(value)}
    told = {"device": fault.device, "word": fault.word, "parameters": finite}
    return {**told, "begin_s": fault.begin_s, "end_s": as_json(fault.end_s)}

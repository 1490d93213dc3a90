"""Routes of a simulated rover: its fault switches, and where it truly stands."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import FastAPI, Query

from drivers.faults import Fault as SetFault
from drivers.faults import FaultPanel
from drivers.simulation_clock import MAX, SimulationClock
from mastctl.as_json import as_json
from mastctl.commands.entry import (
    SIMULATION_FAULT,
    SIMULATION_FAULTS_OFF,
    SIMULATION_POSE,
    SIMULATION_TIME,
)
from mastctl.errors import NotKnown, NotNow
from mastctl.service.service import Service
from mastctl.tracking.pose import RoverPose
from mastctl.web import PREFIX
from mastctl.web.commands import Commands, Headers
from mastctl.web.models import FaultBody, FaultsQuery, StandBody, TimeBody
from mastctl.web.waiting import Waiting

if TYPE_CHECKING:
    from drivers.sim.rover import SimulatedRover


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


def _fault_told(fault: SetFault) -> dict[str, Any]:
    """A set fault as JSON; one without an end has ``end_s`` null."""
    finite = {name: value for name, value in fault.parameters.items() if math.isfinite(value)}
    told = {"device": fault.device, "word": fault.word, "parameters": finite}
    return {**told, "begin_s": fault.begin_s, "end_s": as_json(fault.end_s)}

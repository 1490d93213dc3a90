"""Routes of what moves the head, and of what stops it: operations, jog, track, lease, limits, stops."""

from __future__ import annotations

import asyncio
import math
import threading
from functools import partial
from typing import Annotated, Any, Literal, Self

import numpy as np
from fastapi import FastAPI, Request
from pydantic import BaseModel, Field, StringConstraints, model_validator

from calib.geometry.rigid import Rigid, rotation_of
from mastctl import answers
from mastctl.control.entry import ESTOP, STOP, Command
from mastctl.control.lease import LONGEST_S, SHORTEST_S, USUAL_S, Lease, client_name
from mastctl.devices.judge import LEAST_CONE_RAD, WIDEST_CONE_RAD, SunDirection, direction_of
from mastctl.errors import BadRequest, NotNow, Unable, one_line
from mastctl.http import PREFIX
from mastctl.motion.jog import JogBeat
from mastctl.motion.requests import (
    LARGEST_M,
    Angle,
    Name,
    Place,
    PointingError,
    PointRequest,
    StrictBody,
    TrackRequest,
)
from mastctl.motion.track import RoverPose
from mastctl.safety.latch import LONGEST
from mastctl.service.service import Service
from mastctl.service.steering import usual_s
from mastctl.service.stopping import StopsHang
from mastctl.web.commands import Here, Parts, command, stop_first

BODY_S = 0.02  # how long an emergency stop waits for a reason that did not come with its request

Person = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1, max_length=LONGEST)]
Sigma = Annotated[float, Field(ge=0.0, le=LARGEST_M)]
Part = Annotated[float, Field(ge=-1e9, le=1e9)]
LeaseS = Annotated[float, Field(ge=SHORTEST_S, le=LONGEST_S)]
CovarianceRow = Annotated[list[Part], Field(min_length=6, max_length=6)]


class EstopBody(BaseModel):
    """``POST /estop``: why and by whom, if they are given."""

    reason: str | None = None
    name: str | None = None


class ResetBody(StrictBody):
    """``POST /reset``: why and by whom the stop is released."""

    reason: Person
    name: Person


class LeaseBody(StrictBody):
    """``POST /lease``: how long, and whose it is, if not the caller's.

    ``ends_with_stop``: it ends with the next stop of the head.
    """

    name: Name | None = None
    for_s: LeaseS = USUAL_S
    ends_with_stop: bool = False


class RenewBody(StrictBody):
    """``POST /lease/renew``: how long from now on; as long as at first when left out."""

    for_s: LeaseS | None = None


class TakeBody(LeaseBody):
    """``POST /lease/take``: why, beside what goes with a lease."""

    reason: Person


class SigmaBody(StrictBody):
    """One sigma of each axis of a motion: of its translation, metres, and of its rotation, radians."""

    position_m: Sigma
    rotation_rad: Annotated[float, Field(ge=0.0, le=math.pi)]


class PoseBody(StrictBody):
    """``POST /pose``: site_from_rover, and how well the motion since the pose before is known.

    ``covariance`` (6, 6) has the order x, y, z, turn about x, about y, about z: metres and radians along the
    rover's axes of this pose.
    """

    position_m: Place
    quaternion: Annotated[list[Part], Field(min_length=4, max_length=4)]
    covariance: Annotated[list[CovarianceRow], Field(min_length=6, max_length=6)] | None = None
    sigma: SigmaBody | None = None
    time_s: Annotated[float, Field(ge=-1e12, le=1e12)] | None = None
    look: bool = True

    @model_validator(mode="after")
    def _sound(self) -> Self:
        length = math.hypot(*self.quaternion)
        if abs(length - 1.0) > 1e-3:
            raise ValueError(f"quaternion (w, x, y, z) has the length {length:g} where 1 is expected")
        if self.covariance is not None and self.sigma is not None:
            raise ValueError("covariance and sigma say the same; one of them is expected")
        if self.covariance is not None:
            _check_covariance(self.covariance)
        return self

    def pose(self, received_s: float) -> RoverPose:
        """Return it as the tracker takes it."""
        covariance = None
        if self.covariance is not None:
            order = [3, 4, 5, 0, 1, 2]  # rotation first, as calib.matching.track has it
            covariance = np.array(self.covariance)[np.ix_(order, order)]
        elif self.sigma is not None:
            covariance = np.diag([self.sigma.rotation_rad**2] * 3 + [self.sigma.position_m**2] * 3)
        frame = Rigid(rotation_of(self.quaternion), np.array(self.position_m))
        return RoverPose(frame, covariance, self.time_s, received_s)


def _check_covariance(rows: list[list[float]]) -> None:
    """Pass a matrix that can be a covariance. Raises ValueError."""
    matrix = np.array(rows)
    # Each axis by its own sigma: a large one in metres hides nothing that is wrong with a small one.
    sigma = np.sqrt(np.abs(np.diag(matrix)))
    sigma[sigma == 0] = 1.0
    correlation = matrix / sigma / sigma[:, None]
    if not np.abs(correlation - correlation.T).max() <= 1e-6:
        raise ValueError("covariance is not symmetric")
    if np.linalg.eigvalsh(correlation)[0] < -1e-6:
        raise ValueError("covariance has a negative variance in some direction")


class SunBody(StrictBody):
    """``POST /limits/sun``: a direction by azimuth and elevation, and the cone around it.

    Azimuth goes from x over y, elevation up; in the site frame x is north and y east, in the rover's forward
    and right. ``valid_s`` is how long it holds; left out: until another is given.
    """

    azimuth_rad: Angle
    elevation_rad: Annotated[float, Field(ge=-math.pi / 2, le=math.pi / 2)]
    frame: Literal["site", "rover"] = "site"
    half_angle_rad: Annotated[float, Field(ge=LEAST_CONE_RAD, le=WIDEST_CONE_RAD)]
    valid_s: Annotated[float, Field(gt=0.0, le=1e6)] | None = None

    def sun(self, now_s: float) -> SunDirection:
        """Return it as the judge of moves takes it."""
        until_s = None if self.valid_s is None else now_s + self.valid_s
        direction = direction_of(self.azimuth_rad, self.elevation_rad)
        return SunDirection(direction, self.frame, self.half_angle_rad, until_s)


def add_pointing(app: FastAPI) -> None:
    """State, operations and the stop."""

    @app.get(f"{PREFIX}/status", summary="The present state of daemon, head, cameras and calibration")
    async def status(here: Here) -> answers.Status:
        return here.service.status()

    @command(
        app,
        "POST /point",
        Command("point", steers=True, need="motion"),
        status_code=202,
        usual_s=lambda here, body: usual_s(here.service.config.limits, body.captures),
    )
    def point(body: PointRequest, here: Here) -> answers.Started:
        """Point at a pixel, a position, or joint angles."""
        return {"id": here.service.steering.point(body).id}

    @app.post(f"{PREFIX}/point/preview", summary="The point at a pixel, before anything moves")
    async def preview(body: PointRequest, here: Here) -> answers.Preview:
        service = here.service
        if body.pixel is not None:
            camera = body.pixel.camera
        elif body.panorama is not None:  # the disk is read
            name = body.panorama.id
            camera = (await here.waiting.run(lambda: service.panoramas.open(name))).index.cameras[0]
        else:
            message = "pixel is missing; a preview is of a named frame's or a panorama's"
            raise BadRequest("bad_request", message)
        service.check_camera(camera)
        cancelled = threading.Event()
        try:
            seen: answers.Preview = await here.waiting.image(
                camera, lambda: service.steering.preview(body, cancelled)
            )
        except PointingError as error:
            kind = NotNow if error.code in ("head_moving", "stopped") else BadRequest
            raise kind(error.code, str(error)) from None
        finally:
            cancelled.set()
        return seen

    @app.get(f"{PREFIX}/operations", summary="The newest operations, without their steps")
    async def operations(here: Here) -> answers.Operations:
        return {"operations": [one.listed() for one in here.service.operations.all()]}

    @app.get(f"{PREFIX}/operations/{{operation_id}}", summary="One operation's record")
    async def operation(operation_id: str, here: Here) -> answers.OperationAnswer:
        return here.service.operations.get(operation_id).as_json()

    @command(app, "POST /operations/{operation_id}/stop", Command("operation.stop"), beside=True)
    def stop_one(operation_id: str, here: Here) -> answers.OperationAnswer:
        """Stop the mast and one operation, if it still runs; what another client began goes on."""
        here.service.operations.stop_one(operation_id)
        return here.service.operations.get(operation_id).as_json()

    @app.post(f"{PREFIX}/stop", summary="Stop the mast and the running operation, at once")
    async def stop(request: Request, here: Here) -> answers.StopAnswer:
        return await stop_first(here, STOP, request, here.service.stopping.stop_answer)


def add_estop(app: FastAPI) -> None:
    """The emergency stop, which needs no body that makes sense, and the reset, which does."""
    any_body = {"anyOf": [EstopBody.model_json_schema(), {}]}  # a stop is refused for no body

    @app.post(
        f"{PREFIX}/estop",
        summary="Stop the mast and let nothing move it until it is reset, across restarts too",
        openapi_extra={"requestBody": {"content": {"application/json": {"schema": any_body}}}},
    )
    async def estop(request: Request, here: Here) -> answers.EstopAnswer:
        stopping = here.service.stopping
        given = await _reason_and_name(request)
        try:
            return await stop_first(here, ESTOP, request, partial(stopping.estop, **given), given)
        except StopsHang as error:
            await here.waiting.run(lambda: stopping.latch_estop(**given))
            raise Unable("stop_unconfirmed", f"the emergency stop is latched, but {error}") from None

    @command(app, "POST /reset", Command("reset", need="latch"))
    def reset(body: ResetBody, here: Here) -> answers.ResetAnswer:
        """Release an emergency stop; nothing moves before the next command."""
        return here.service.stopping.reset(body.reason, body.name)


async def _reason_and_name(request: Request) -> dict[str, str | None]:
    """The reason and the name in a body, None where it has none, or does not come in time."""
    given: dict[str, str | None] = {"reason": None, "name": None}
    try:
        async with asyncio.timeout(BODY_S):
            found = await request.json()
    except Exception:  # late, too long, broken off, no JSON: a stop is not refused for its body
        return given
    for key in given if isinstance(found, dict) else ():
        if isinstance(found.get(key), str):
            given[key] = one_line(found[key], LONGEST)
    return given


def add_tracking(app: FastAPI) -> None:
    """The rover's pose, and the track."""

    def one_look_s(here: Parts, **_: Any) -> float:
        return usual_s(here.service.config.limits, 1)

    @command(app, "POST /pose", Command("pose"), usual_s=one_look_s)
    def pose(body: PoseBody, here: Here) -> answers.PoseTaken:
        """Say where the rover stands; a track is carried over and looked for."""
        operation = here.service.steering.take_pose(body.pose(here.requested.came_s), body.look)
        stop_before_keep_outs(here.service)  # a sun of the site frame turns with the rover
        return {"operation": operation, "track": here.service.track_answer()}

    @app.get(f"{PREFIX}/track", summary="The track at this moment")
    async def track(here: Here) -> answers.TrackAnswer:
        return here.service.track_answer()

    @command(
        app, "POST /track", Command("track", steers=True, need="track"), status_code=202, usual_s=one_look_s
    )
    def start(body: TrackRequest, here: Here) -> answers.Started:
        """Follow what a pixel shows, or is at a position."""
        return {"id": here.service.steering.start_track(body).id}

    @command(
        app,
        "POST /track/look",
        Command("track.look", steers=True, need="motion"),
        status_code=202,
        usual_s=one_look_s,
    )
    def look(here: Here) -> answers.Started:
        """Look for the target once more."""
        return {"id": here.service.steering.look().id}

    @command(app, "POST /track/stop", Command("track.stop", steers=True), beside=True)
    def stop(here: Here) -> answers.TrackAnswer:
        """End the track; the head stops if it moves for it."""
        here.service.stopping.stop_track()
        return here.service.track_answer()


def add_limits(app: FastAPI) -> None:
    """The jog, and the sun."""

    @command(app, "POST /jog", Command("jog", steers=True, goes_on=True))
    def jog(body: JogBeat, here: Here) -> answers.JogAnswer:
        """A heartbeat: turn the head at a rate, for half a second."""
        return here.service.jogs.beat(body)

    @app.get(f"{PREFIX}/limits/sun", summary="The direction that no head camera looks into")
    async def sun(here: Here) -> answers.SunAnswer:
        return here.service.devices.judge.sun_as_json()

    @command(app, "POST /limits/sun", Command("limits.sun"))
    def tell(body: SunBody, here: Here) -> answers.SunAnswer:
        """Say where the sun stands; the head keeps off it."""
        judge = here.service.devices.judge
        judge.use_sun(body.sun(here.requested.came_s))
        stop_before_keep_outs(here.service)
        return judge.sun_as_json()

    @command(app, "DELETE /limits/sun", Command("limits.sun.forget"))
    def forget(here: Here) -> answers.SunAnswer:
        """Keep the head off no sun any more."""
        judge = here.service.devices.judge
        judge.use_sun(None)
        return judge.sun_as_json()


def stop_before_keep_outs(service: Service) -> None:
    """Stop a head that is under way into what has come to be kept out. Raises DriverError."""
    name = service.devices.judge.in_the_way(service.devices.last_reading)
    if name is not None:
        service.operations.stop(f"the keep-out {name} came to lie in the head's way")


def add_lease(app: FastAPI) -> None:
    """Who steers: acquired, renewed, released, taken over."""

    @app.get(f"{PREFIX}/lease", summary="Who steers")
    async def control(here: Here) -> answers.LeaseAnswer:
        return {"control": here.service.leases.control()}

    @command(app, "POST /lease", Command("lease", grants=True))
    def acquire(body: LeaseBody, here: Here) -> answers.LeaseGranted:
        """Acquire the lease, if no other client steers."""
        leases, caller = here.service.leases, here.requested.caller
        return _granted(here, leases.acquire(caller, **_terms(body, here)))

    @command(app, "POST /lease/renew", Command("lease.renew", grants=True))
    def renew(here: Here, body: RenewBody | None = None) -> answers.LeaseGranted:
        """Have the lease run for its time from now on."""
        return _granted(
            here, here.service.leases.renew(_lease_of(here), None if body is None else body.for_s)
        )

    @command(app, "DELETE /lease", Command("lease.release"))
    def release(here: Here) -> answers.LeaseAnswer:
        """Release the lease."""
        leases = here.service.leases
        leases.release(_lease_of(here))
        return {"control": leases.control()}

    @command(app, "POST /lease/take", Command("lease.take", grants=True))
    def take(body: TakeBody, here: Here) -> answers.LeaseGranted:
        """Take the lease from its holder; what runs under it is stopped."""
        leases, caller = here.service.leases, here.requested.caller
        return _granted(here, leases.take(caller, body.reason, **_terms(body, here)))


def _terms(body: LeaseBody, here: Parts) -> dict[str, Any]:
    """What a lease is granted with, by the names of `LeaseTable.acquire`."""
    name = None if body.name is None else client_name(body.name)
    last_stop = here.requested.last_stop if body.ends_with_stop else None
    return {"name": name, "for_s": body.for_s, "last_stop": last_stop}


def _granted(here: Parts, lease: Lease) -> answers.LeaseGranted:
    return {"lease_id": lease.id, **here.service.leases.lease_as_json(lease)}


def _lease_of(here: Parts) -> str:
    """The lease that a request speaks of. Raises BadRequest."""
    if here.requested.lease is None:
        sentence = "no lease is named; its id is expected, by the header Mastctl-Lease or --lease"
        raise BadRequest("bad_request", sentence)
    return here.requested.lease

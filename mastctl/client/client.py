"""The client of a running daemon; each method waits for the daemon's answer."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, cast

from mastctl import answers
from mastctl.client.calls import Calls
from mastctl.client.connection import PASSING, ClientError, DaemonHttp, escaped, given, polled
from mastctl.client.steering import ANSWER_S, Jog, LeaseCalls
from mastctl.frame_facts import FrameFacts, facts_in

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

ENDED = ("done", "failed", "stopped")
STOP_ANSWER_S = 5.0  # the daemon answers a stop within 3 s
DEFAULT_URL = "http://127.0.0.1:8420"


@dataclass(frozen=True, eq=False)
class Snapshot(FrameFacts):
    """A picture and its facts; ``data`` is the file as it came."""

    data: bytes

    @cached_property
    def image(self) -> NDArray[np.uint8]:
        """The decoded picture, uint8 of (h, w) or (h, w, 3) in the order blue, green, red.

        Raises ImportError without OpenCV, which ``mastctl-client`` leaves to you, ValueError if it cannot be
        decoded.
        """
        try:
            import cv2
            import numpy as np
        except ImportError as missing:
            raise ImportError(
                "decoding a picture needs opencv-python-headless (pip install opencv-python-headless); "
                "`data` has the picture's file without it",
                name=missing.name,
            ) from None
        image = cv2.imdecode(np.frombuffer(self.data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise ValueError("the picture cannot be decoded")
        return np.asarray(image, dtype=np.uint8)

    @property
    def facts(self) -> dict[str, Any]:
        """Everything but the picture, as JSON."""
        height, width = self.image.shape[:2]
        names = (one.name for one in fields(FrameFacts))
        return {name: getattr(self, name) for name in names} | {"size_px": [width, height]}


class Client(LeaseCalls, Calls):
    """A connection to one daemon. A context manager; usable from one thread at a time.

    ``url``: ``http://127.0.0.1:8420``, or ``unix:/path/of/socket``. ``timeout_s``: longest time of each
    request. ``name`` of this program, for the daemon's record and for other clients that want to steer, is by
    default ``program@host:pid``; clients of one name are one party. ``token``: expected by a daemon from
    other machines; by default ``$MASTCTL_TOKEN``. Others can read it on the way without TLS, of
    which ``$SSL_CERT_FILE`` may name the certificates.

    Where the connection breaks, the client sends a command again; its key lets the daemon execute it once.
    Every method raises ClientError for whatever goes wrong.
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        timeout_s: float = 30.0,
        name: str | None = None,
        token: str | None = None,
    ) -> None:
        self.url = url
        self.daemon = DaemonHttp(url, timeout_s, name, token)

    def request(self, method: str, path: str, **body: Any) -> dict[str, Any]:
        """Send a request that no other method sends, as ``request("POST", "/mast/back")``; return the answer.

        The reference of the HTTP interface has paths and bodies; the query of GET goes into ``body`` too.
        """
        if method == "GET":
            return self.daemon.json(dict[str, Any], method, path, params=given(**body))
        return self.daemon.command(dict[str, Any], method, path, given(**body) or None)

    def status(self, timeout_s: float | None = None) -> answers.Status:
        """Return what the daemon knows now; ``timeout_s`` shortens the longest time of this request.

        Another program's answer is ``bad_answer``.
        """
        status = self.daemon.json(answers.Status, "GET", "/status", within_s=timeout_s)
        if not isinstance(status.get("state"), str) or "mast" not in status:
            raise self.daemon.bad_answer("its status has no state, or no mast")
        return status

    def point(
        self,
        *,
        pixel: tuple[str, str, float, float] | None = None,
        position_m: Sequence[float] | None = None,
        frame: Literal["rover", "site"] | None = None,
        panorama: Mapping[str, Any] | None = None,
        pan_rad: float | None = None,
        tilt_rad: float | None = None,
        aim: tuple[str, float, float] | None = None,
        pointings: int | None = None,
        range_m: float | None = None,
        plane: Mapping[str, Sequence[float]] | None = None,
        deadline_s: float | None = None,
    ) -> str:
        """Start a pointing operation and return its id.

        The target is one of: ``pixel`` (camera, frame id, x, y); ``position_m`` (x, y, z) in the ``rover``
        (default) or ``site`` frame; ``panorama``, a pixel of one: ``id``, ``x_px``, ``y_px``, perhaps
        ``recompute``, ``by_direction``; the joint angles.

        ``aim`` (camera, x, y): where the target shall come; the daemon's default when left out.
        ``pointings``: 1 (default) or 2. ``range_m``: how far what the pixel shows is from its camera, or
        ``plane`` of the rover frame in which it lies, ``{"point_m": (x, y, z), "normal": (x, y, z)}``, level
        without ``normal``; the pair's other camera is not used then. ``deadline_s``: how long it is given,
        seconds of the daemon's clock; then the head is stopped and the operation fails with
        ``deadline_passed``. By default from the longest move and the speed.
        """
        body = given(
            **_target(pixel, position_m, frame, aim, range_m, plane),
            panorama=panorama,
            pan_rad=pan_rad,
            tilt_rad=tilt_rad,
            pointings=pointings,
        )
        return self._started("/point", body, deadline_s)

    def _started(self, path: str, body: dict[str, Any] | None, deadline_s: float | None) -> str:
        return self.daemon.command(answers.Started, "POST", path, body, deadline_s=deadline_s)["id"]

    def turn(self, pan_rad: float, tilt_rad: float, timeout_s: float = 90.0) -> answers.OperationAnswer:
        """Turn to joint angles as the head reads them; return the operation's record when it has ended.

        A turn that this program cannot follow any more, or whose time is over, is stopped. ``timeout_s`` is
        what the daemon gives it, seconds of the daemon's clock, and how long it is waited for.
        """
        operation = None
        try:
            operation = self.point(pan_rad=pan_rad, tilt_rad=tilt_rad, deadline_s=timeout_s)
            return self.wait(operation, timeout_s + STOP_ANSWER_S)
        except BaseException as error:
            refused = operation is None and isinstance(error, ClientError) and error.code not in PASSING
            if not refused:  # over a connection of its own; the mast where the operation is not known
                daemon = self.daemon.beside(STOP_ANSWER_S)
                path = "/stop" if operation is None else f"/operations/{escaped(operation)}/stop"
                with contextlib.suppress(ClientError):  # what ended the turn is reported
                    daemon.json(dict[str, Any], "POST", path)
                daemon.close()
            raise

    def operation(self, operation_id: str) -> answers.OperationAnswer:
        """Return an operation's record."""
        return self.daemon.json(answers.OperationAnswer, "GET", f"/operations/{escaped(operation_id)}")

    def operations(self) -> list[answers.OperationListed]:
        """Return the newest operations, newest first, without their steps."""
        return self.daemon.json(answers.Operations, "GET", "/operations")["operations"]

    def stop_operation(self, operation_id: str) -> answers.OperationAnswer:
        """Stop the mast and one operation, if it still runs; what another client began goes on.

        Returns its record, which may not have ended yet.
        """
        return self.daemon.json(answers.OperationAnswer, "POST", f"/operations/{escaped(operation_id)}/stop")

    def wait(
        self,
        operation_id: str,
        timeout_s: float = 60.0,
        on_step: Callable[[answers.Step], None] | None = None,
    ) -> answers.OperationAnswer:
        """Wait until an operation has ended (done, failed or stopped) and return its record.

        ``on_step`` is called with each step as it comes. Raises ClientError ``timeout`` if it has not ended
        in time; it goes on.
        """
        seen = 0
        path = f"/operations/{escaped(operation_id)}"
        for record in polled(
            lambda within_s: self.daemon.json(answers.OperationAnswer, "GET", path, within_s), timeout_s
        ):
            for step in record["steps"][seen:]:
                seen += 1
                if on_step is not None:
                    on_step(step)
            if record["state"] in ENDED:
                return record
        raise ClientError("timeout", f"operation {operation_id} has not ended after {timeout_s:g} s")

    def events(self, *topics: str, keys: Sequence[str] = ()) -> Generator[answers.Event, None, None]:
        """Yield each change of some topics (all without any) and keys, beginning with what is known, until
        the daemon ends: ``topic``, ``key``, ``sequence``, ``lost``, ``value``.
        """
        query = given(key=list(keys) or None, topics=",".join(topics) or None)
        for event in self.daemon.events(query):
            yield cast(answers.Event, event)

    def stop(self) -> answers.StopAnswer:
        """Stop the mast and the running operation."""
        return self.daemon.json(answers.StopAnswer, "POST", "/stop")

    def estop(self, *, reason: str | None = None, name: str | None = None) -> answers.EstopAnswer:
        """Stop the mast and let nothing move it until `reset`; ``kept`` says whether a restart would know."""
        return self.daemon.json(answers.EstopAnswer, "POST", "/estop", json=given(reason=reason, name=name))

    def reset(self, *, reason: str, name: str) -> answers.ResetAnswer:
        """Release the emergency stop; a later command moves again."""
        return self.daemon.json(answers.ResetAnswer, "POST", "/reset", json={"reason": reason, "name": name})

    def pose(
        self,
        position_m: Sequence[float],
        quaternion: Sequence[float],
        *,
        covariance: Sequence[Sequence[float]] | None = None,
        sigma: tuple[float, float] | None = None,
        time_s: float | None = None,
        look: bool = True,
    ) -> answers.PoseTaken:
        """Say where the rover stands; return the track as it is then, and the ``operation`` of a look.

        ``position_m`` (x, y, z) and ``quaternion`` (w, x, y, z) are site_from_rover. How well the motion
        since the pose before is known: ``covariance``, (6, 6) along the rover's axes of this pose, x, y, z in
        metres and the turns about them in radians; or ``sigma`` (metres, radians) of each axis of its
        translation and of its rotation. ``time_s`` is by the sender's clock; ``look``: whether a track's
        target shall be looked for.
        """
        body = given(
            position_m=position_m,
            quaternion=quaternion,
            covariance=covariance,
            sigma=None if sigma is None else {"position_m": sigma[0], "rotation_rad": sigma[1]},
            time_s=time_s,
            look=look,
        )
        return self.daemon.json(answers.PoseTaken, "POST", "/pose", json=body)

    def track(self) -> answers.TrackAnswer:
        """Return the track as it is."""
        return self.daemon.json(answers.TrackAnswer, "GET", "/track")

    def start_track(
        self,
        *,
        pixel: tuple[str, str, float, float] | None = None,
        position_m: Sequence[float] | None = None,
        frame: Literal["rover", "site"] | None = None,
        deadline_s: float | None = None,
    ) -> str:
        """Start to follow a target and return the operation's id; arguments as for `point`."""
        return self._started("/track", _target(pixel, position_m, frame), deadline_s)

    def look(self, *, deadline_s: float | None = None) -> str:
        """Look for the track's target once more; return the operation's id."""
        return self._started("/track/look", None, deadline_s)

    def wait_track(
        self,
        operation_id: str | None,
        timeout_s: float = 60.0,
        on_step: Callable[[answers.Step], None] | None = None,
    ) -> answers.TrackAnswer:
        """Wait until a start or a look of the track has ended; return the track after it.

        ``None`` for the operation returns the track as it is. Raises ClientError as `wait`.
        """
        if operation_id is not None:
            self.wait(operation_id, timeout_s, on_step)
        for track in polled(
            lambda within_s: self.daemon.json(answers.TrackAnswer, "GET", "/track", within_s), timeout_s
        ):
            if operation_id is None or track["operation"] != operation_id:
                return track
        raise ClientError("timeout", f"the track did not take up operation {operation_id}")

    def stop_track(self) -> answers.TrackAnswer:
        """End the track; return it as it is then."""
        return self.daemon.json(answers.TrackAnswer, "POST", "/track/stop")

    def jog(self) -> Jog:
        """Return a context in which the head turns at the `Jog.rates` set; it sends the heartbeats itself."""
        return Jog(lambda: self.daemon.beside(ANSWER_S))

    def snapshot(
        self,
        camera: str,
        *,
        fresh: bool = True,
        frame_id: str | None = None,
        format: Literal["png", "jpeg"] = "png",
    ) -> Snapshot:
        """Return a picture with its facts; ``png`` is lossless.

        ``fresh``: it is exposed after the daemon got the request, else it is at most a second old.
        ``frame_id`` names a frame that the daemon still keeps, instead of a new one.
        """
        kept = {"fresh": "true" if fresh else "false"} if frame_id is None else {"frame_id": frame_id}
        answer = self.daemon.request("GET", f"/snapshot/{escaped(camera)}", params={"format": format, **kept})
        try:
            return Snapshot(data=answer.content, **facts_in(answer.headers))
        except (KeyError, ValueError) as reason:
            raise self.daemon.bad_answer(f"the picture's facts are wrong: {reason}") from None

    def close(self) -> None:
        """Close the connection."""
        self.daemon.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *ignored: object) -> None:
        self.close()


def _target(
    pixel: tuple[str, str, float, float] | None,
    position_m: Sequence[float] | None,
    frame: Literal["rover", "site"] | None,
    aim: tuple[str, float, float] | None = None,
    range_m: float | None = None,
    plane: Mapping[str, Sequence[float]] | None = None,
) -> dict[str, Any]:
    """A target as a body has it: a pixel of a frame, or a point; without what was left out."""
    names = ("camera", "frame_id", "x_px", "y_px")
    return given(
        pixel=None if pixel is None else dict(zip(names, pixel, strict=True)),
        position_m=position_m,
        frame=frame,
        aim=None if aim is None else dict(zip(("camera", "x_px", "y_px"), aim, strict=True)),
        range_m=range_m,
        plane=plane,
    )

"""A small client of a running daemon: what the command line and the experiments use."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal, cast
from urllib.parse import quote

from mastctl.client.connection import ClientError, DaemonHttp, plain_name
from mastctl.client.following import followed
from mastctl.client.jog import ANSWER_S, Jog
from mastctl.client.lease import HeldLease

if TYPE_CHECKING:
    from mastctl.client.answers import (
        BenchBegun,
        BenchRunTold,
        BenchTold,
        BoardStands,
        BoardsTold,
        CalibrationHealthTold,
        ControlTold,
        EstopTold,
        Event,
        FaultSet,
        HistoryTold,
        LeaseGranted,
        MastsTold,
        OperationListed,
        OperationTold,
        PlacesTold,
        PlaceTold,
        PoseTaken,
        PreviewTold,
        RecorderTold,
        RecordingDeleted,
        RecordingEnded,
        Recordings,
        ReloadTold,
        ReportsTold,
        ResetTold,
        RigTold,
        SentinelTold,
        SessionTold,
        StandTold,
        StateTold,
        Status,
        StepTold,
        StopTold,
        SunTold,
        TimeTold,
        TrackTold,
        TruthTold,
        WordsTold,
        WordTold,
    )
    from mastctl.client.snapshot import Snapshot

DEFAULT_URL = "http://127.0.0.1:8420"
ENDED = ("done", "failed", "stopped")


class Client:
    """A connection to one daemon. A context manager; usable from one thread at a time.

    Parameters
    ----------
    url
        ``http://127.0.0.1:8420``, or ``unix:/path/of/socket``.
    timeout_s
        What each request is given, seconds.
    name
        What this program calls itself, for the daemon's record and for who else wants to steer; by default
        ``program@host:pid``. Clients of one name are one party.

    A command goes out again where the connection breaks, with a key by which the daemon carries it out once.
    token
        What a daemon asks for that is reached from other machines; by default that of ``$MASTCTL_TOKEN``.
        Without TLS it can be read on the way. The certificates that are trusted beside the system's may
        stand in the file ``$MASTCTL_CA_FILE``.

    Raises
    ------
    ClientError
        ``bad_url``, if the address is of neither form. Every method raises it for whatever goes wrong.
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        timeout_s: float = 30.0,
        name: str | None = None,
        token: str | None = None,
    ) -> None:
        self.url = url
        self._daemon = DaemonHttp(url, timeout_s, name, token)

    @contextmanager
    def lease(
        self,
        name: str | None = None,
        for_s: float = 30.0,
        take_over: str | None = None,
        gives_way: bool = False,
        ends_with_stop: bool = False,
    ) -> Iterator[HeldLease]:
        """Steer alone inside the block: a thread renews the lease, and this client's commands carry it.

        Parameters
        ----------
        name
            The holder's, by default this client's.
        for_s
            How long it outlives a holder that falls silent, 1 to 3600 s.
        take_over
            Why it is taken from whoever steers; None waits for nobody and takes nothing away.
        gives_way
            Whether it ends as soon as anybody else wants to steer, or stops the head: for what is done when
            nobody needs the head.
        ends_with_stop
            Whether it ends as soon as anybody stops the head: for a program that would go on with its next
            move otherwise.

        Yields
        ------
        lease
            Whose ``lost`` says if somebody took over meanwhile.

        Raises
        ------
        ClientError
            ``leased`` if somebody else steers.
        """
        granted = self.acquire_lease(name, for_s, take_over, gives_way, ends_with_stop)
        before, held = self._daemon.lease_id, HeldLease(self._daemon, granted, for_s)
        self._daemon.lease_id = held.id
        try:
            yield held
        finally:
            self._daemon.lease_id = before
            held.end()

    def control(self) -> ControlTold | None:
        """Return who steers, or None: ``holder``, ``kind`` (lease, operation), ``for_s``, ``until``."""
        found = self._daemon.json("GET", "/lease")["control"]
        return cast("ControlTold | None", found)

    def acquire_lease(
        self,
        name: str | None = None,
        for_s: float = 30.0,
        take_over: str | None = None,
        gives_way: bool = False,
        ends_with_stop: bool = False,
    ) -> LeaseGranted:
        """Acquire or take over a lease that nobody renews; arguments as for `lease`.

        Returns ``lease_id``, ``holder``, ``for_s`` and ``until``; `use_lease` has commands carry it.
        """
        body: dict[str, Any] = {"for_s": float(for_s)}
        if name is not None:
            body["name"] = name
        if take_over is not None:
            return cast(
                "LeaseGranted", self._daemon.command("POST", "/lease/take", body | {"reason": take_over})
            )
        if gives_way:
            body["gives_way"] = True
        if ends_with_stop:
            body["ends_with_stop"] = True
        return cast("LeaseGranted", self._daemon.command("POST", "/lease", body))

    def use_lease(self, lease_id: str | None) -> None:
        """Have each command carry a lease from now on, or none."""
        self._daemon.lease_id = None if lease_id is None else plain_name(lease_id)

    def renew_lease(self, for_s: float | None = None) -> LeaseGranted:
        """Have the lease in use run for ``for_s`` seconds from now on, by default as long as at first."""
        return cast(
            "LeaseGranted",
            self._daemon.command("POST", "/lease/renew", {} if for_s is None else {"for_s": float(for_s)}),
        )

    def release_lease(self) -> None:
        """Release the lease in use."""
        self._daemon.command("DELETE", "/lease")

    def status(self) -> Status:
        """Return what the daemon knows at this moment."""
        return cast("Status", self._daemon.json("GET", "/status"))

    def reload(self) -> ReloadTold:
        """Have the daemon read its configuration again; return ``changed``, ``mast`` and ``notes``.

        All of what it says comes into use while the head rests, or nothing (``restart_needed``,
        ``bad_config``, ``bad_mast_file``, ``busy``, ``moving``).
        """
        return cast("ReloadTold", self._daemon.command("POST", "/reload"))

    def calibration_health(self) -> CalibrationHealthTold:
        """Return whether residuals of the last days are as the mast file predicts, with the figures."""
        return cast("CalibrationHealthTold", self._daemon.json("GET", "/calibration/health"))

    def sentinel(self) -> SentinelTold:
        """Return what the drift sentinel in the daemon's state folder has found, and how long ago."""
        return cast("SentinelTold", self._daemon.json("GET", "/sentinel"))

    def point(
        self,
        *,
        pixel: tuple[str, str, float, float] | None = None,
        position_m: Sequence[float] | None = None,
        frame: Literal["rover", "site"] | None = None,
        pan_rad: float | None = None,
        tilt_rad: float | None = None,
        aim: tuple[str, float, float] | None = None,
        pointings: int | None = None,
        range_m: float | None = None,
        plane: Mapping[str, Sequence[float]] | None = None,
        deadline_s: float | None = None,
        idempotency_key: str | None = None,
    ) -> str:
        """Start a pointing operation and return its id.

        Parameters
        ----------
        pixel
            (camera, frame id, x, y), pixels; or
        position_m, frame
            a point, metres, in the ``rover`` (default) or ``site`` frame; or
        pan_rad, tilt_rad
            joint angles.
        aim
            (camera, x, y): where the target shall come; the daemon's default when left out.
        pointings
            1 (default) or 2.
        range_m, plane
            How far what the pixel shows is from its camera, metres, or a plane of the rover frame in which it
            lies: ``{"point_m": (x, y, z), "normal": (x, y, z)}``, level without ``normal``. The pair's other
            eye is not asked then.
        deadline_s
            How long it is given, seconds of the daemon's clock; then the head is stopped and the operation
            fails with ``deadline_passed``. By default from the longest way and the speed.
        idempotency_key
            The same for each try of one command; a new one by default.
        """
        body = _target(pixel, position_m, frame)
        if aim is not None:
            body["aim"] = dict(zip(("camera", "x_px", "y_px"), aim, strict=True))
        others = {"pan_rad": pan_rad, "tilt_rad": tilt_rad, "pointings": pointings}
        body |= _how_far(range_m, plane)
        body |= {key: value for key, value in others.items() if value is not None}
        return str(
            self._daemon.command("POST", "/point", body, key=idempotency_key, deadline_s=deadline_s)["id"]
        )

    def preview(
        self,
        pixel: tuple[str, str, float, float],
        *,
        aim: tuple[str, float, float] | None = None,
        range_m: float | None = None,
        plane: Mapping[str, Sequence[float]] | None = None,
    ) -> PreviewTold:
        """Return what a pixel (camera, frame id, x, y) shows and where `point` would send the head.

        Nothing moves. ``position_m`` with ``sigma_m``, ``range_m``, the match in the other eye, ``goal_rad``,
        and ``refused`` where the head would not be sent. ``range_m`` and ``plane`` as for `point`.
        """
        body = _target(pixel, None, None) | _how_far(range_m, plane)
        if aim is not None:
            body["aim"] = dict(zip(("camera", "x_px", "y_px"), aim, strict=True))
        return cast("PreviewTold", self._daemon.json("POST", "/point/preview", json=body))

    def rig(self) -> RigTold:
        """Return the configured cameras by the mast file in use: where each looks and how much it sees."""
        return cast("RigTold", self._daemon.json("GET", "/rig"))

    def operation(self, operation_id: str) -> OperationTold:
        """Return an operation's record."""
        return cast("OperationTold", self._daemon.json("GET", f"/operations/{quote(operation_id, safe='')}"))

    def operations(self) -> list[OperationListed]:
        """Return the newest operations, newest first, without their steps."""
        return cast("list[OperationListed]", self._daemon.json("GET", "/operations")["operations"])

    def wait(
        self,
        operation_id: str,
        timeout_s: float = 60.0,
        on_step: Callable[[StepTold], None] | None = None,
    ) -> OperationTold:
        """Wait until an operation has ended (done, failed or stopped) and return its record.

        Parameters
        ----------
        on_step
            Called with each step as it comes.

        Raises
        ------
        ClientError
            ``timeout``, if it has not ended in time; it goes on.
        """
        told = 0
        query = {"topics": "operation", "key": operation_id}
        for record in followed(self._daemon, query, lambda: self.operation(operation_id), timeout_s):
            for step in record["steps"][told:]:
                told += 1
                if on_step is not None:
                    on_step(step)
            if record["state"] in ENDED:
                return record
        raise ClientError("timeout", f"operation {operation_id} has not ended after {timeout_s:g} s")

    def wait_state(
        self,
        *states: str,
        timeout_s: float = 60.0,
        on_change: Callable[[Status | StateTold], None] | None = None,
    ) -> Status | StateTold:
        """Wait until the daemon's state is one of some words; return ``state``, ``reason`` and what goes with
        them in the status.

        Parameters
        ----------
        on_change
            Called with the same at the beginning and at each change.

        Raises
        ------
        ClientError
            ``timeout``, if it was none of them in time.
        """
        word = ""
        for told in followed(self._daemon, {"topics": "state"}, self.status, timeout_s):
            word = told["state"]
            if on_change is not None:
                on_change(told)
            if word in states:
                return told
        wanted = " or ".join(states)
        raise ClientError("timeout", f"the state is {word} and not {wanted} after {timeout_s:g} s")

    def bench(self) -> BenchTold:
        """Return the bench calibration at work or the last one (``run``), and those that are kept."""
        return cast("BenchTold", self._daemon.json("GET", "/bench"))

    def begin_bench(
        self,
        board: str | None = None,
        *,
        board_file: str | None = None,
        goes_on: str | None = None,
        wanted_px: float | None = None,
        pictures: int | None = None,
        by_hand: bool | None = None,
    ) -> BenchRunTold:
        """Have the daemon begin a bench calibration, or go on with one, and return it as it is then.

        Parameters
        ----------
        board, board_file, goes_on
            One of them: the name of a packaged board, the text of a BOARD.yaml, the name of a run.
        wanted_px, pictures
            What the calibration may leave of a first pointing, rms an axis, and how many pictures of each
            camera at most; by default 0.2 and 60, or as the run had them.
        by_hand
            Whether a simulated board waits for `board_stands` too, as a real one does.

        Raises
        ------
        ClientError
            ``bench_runs``, ``bench_done``, ``bench_unknown``, ``bad_board``, ``unwritable``, ``disk_low``.
        """
        told: dict[str, Any] = {"board": board, "board_file": board_file, "goes_on": goes_on}
        told |= {"wanted_px": wanted_px, "pictures": pictures, "by_hand": by_hand}
        body = {key: value for key, value in told.items() if value is not None}
        return cast("BenchBegun", self._daemon.command("POST", "/bench", body))["run"]

    def board_stands(self) -> BenchRunTold:
        """Say that the board stands where it was asked for."""
        return cast("BenchBegun", self._daemon.command("POST", "/bench/stands"))["run"]

    def leave_bench(self) -> BenchRunTold:
        """End the bench calibration; it can go on later (`begin_bench`, ``goes_on``)."""
        return cast("BenchBegun", self._daemon.command("POST", "/bench/leave"))["run"]

    def forget_bench(self, name: str) -> BenchTold:
        """Remove a bench calibration that is over, with its pictures and report; its mast file stays.

        Returns what is left, as `bench`. Refused with ``bench_runs``, ``bench_unknown``, ``unwritable``.
        """
        return cast("BenchTold", self._daemon.command("DELETE", f"/bench/runs/{quote(name, safe='')}"))

    def reports(self) -> ReportsTold:
        """Return the reports that can be read, the newest first."""
        return cast("ReportsTold", self._daemon.json("GET", "/reports"))

    def report(self, name: str) -> bytes:
        """Return a report, HTML."""
        return bytes(self._daemon.ask("GET", f"/reports/{quote(name, safe='')}").content)

    def history(self) -> HistoryTold:
        """Return joints, temperatures and events of the last hours, oldest first."""
        return cast("HistoryTold", self._daemon.json("GET", "/history"))

    def recordings(self) -> Recordings:
        """Return the daemon's recordings, and what it records now."""
        return cast("Recordings", self._daemon.json("GET", "/recordings"))

    def start_recording(self, name: str = "") -> RecorderTold:
        """Have the daemon record until `stop_recording`; return what it records then."""
        return cast("RecorderTold", self._daemon.command("POST", "/recordings/start", {"name": name}))

    def stop_recording(self) -> RecordingEnded:
        """End the recording; return its file on the daemon's machine, its size and what was dropped."""
        return cast("RecordingEnded", self._daemon.command("POST", "/recordings/stop"))

    def recording(self, name: str, file: str) -> bytes:
        """Return a file of a recording whole, by the names that `recordings` tells."""
        name, file = quote(name, safe=""), quote(file, safe="")
        return bytes(self._daemon.ask("GET", f"/recordings/{name}/{file}").content)

    def delete_recording(self, name: str) -> RecordingDeleted:
        """Delete a run, or what was kept at a fault; return what is left."""
        return cast("RecordingDeleted", self._daemon.command("DELETE", f"/recordings/{quote(name, safe='')}"))

    def stop(self) -> StopTold:
        """Stop the mast and the running operation."""
        return cast("StopTold", self._daemon.json("POST", "/stop"))

    def estop(self, *, reason: str | None = None, name: str | None = None) -> EstopTold:
        """Stop the mast and let nothing move it until `reset`; ``kept`` says whether a restart would know."""
        body = {"reason": reason, "name": name}
        told = {key: value for key, value in body.items() if value is not None}
        return cast("EstopTold", self._daemon.json("POST", "/estop", json=told))

    def reset(self, *, reason: str, name: str, of: str | None = None) -> ResetTold:
        """Release an emergency stop, of several that of ``of``; nothing moves before the next command."""
        told = {"reason": reason, "name": name, **({} if of is None else {"of": of})}
        return cast("ResetTold", self._daemon.json("POST", "/reset", json=told))

    def pose(
        self,
        position_m: Sequence[float],
        quaternion: Sequence[float],
        *,
        covariance: Sequence[Sequence[float]] | None = None,
        sigma: tuple[float, float] | None = None,
        time_s: float | None = None,
        look: bool = True,
    ) -> PoseTaken:
        """Say where the rover stands; return the track as it is then, and the ``operation`` of a look.

        Parameters
        ----------
        position_m, quaternion
            site_from_rover: (x, y, z), metres, and (w, x, y, z).
        covariance
            6 rows of 6 of the motion since the pose before, along the rover's axes of this pose: x, y, z in
            metres, then the turns about them in radians; or
        sigma
            (metres, radians): one sigma of each axis of its translation and of its rotation.
        time_s
            By the sender's clock.
        look
            Whether a track's target shall be looked for.
        """
        body: dict[str, Any] = {
            "position_m": [float(value) for value in position_m],
            "quaternion": [float(value) for value in quaternion],
            "look": look,
        }
        if covariance is not None:
            body["covariance"] = [[float(value) for value in row] for row in covariance]
        if sigma is not None:
            body["sigma"] = {"position_m": sigma[0], "rotation_rad": sigma[1]}
        if time_s is not None:
            body["time_s"] = time_s
        return cast("PoseTaken", self._daemon.json("POST", "/pose", json=body))

    def track(self) -> TrackTold:
        """Return the track as it is."""
        return cast("TrackTold", self._daemon.json("GET", "/track"))

    def start_track(
        self,
        *,
        pixel: tuple[str, str, float, float] | None = None,
        position_m: Sequence[float] | None = None,
        frame: Literal["rover", "site"] | None = None,
        deadline_s: float | None = None,
        idempotency_key: str | None = None,
    ) -> str:
        """Start to follow a target and return the operation's id; arguments as for `point`."""
        body = _target(pixel, position_m, frame)
        answer = self._daemon.command("POST", "/track", body, key=idempotency_key, deadline_s=deadline_s)
        return str(answer["id"])

    def look(self, *, deadline_s: float | None = None, idempotency_key: str | None = None) -> str:
        """Look for the track's target once more; return the operation's id."""
        answer = self._daemon.command("POST", "/track/look", key=idempotency_key, deadline_s=deadline_s)
        return str(answer["id"])

    def wait_track(
        self,
        operation_id: str | None,
        timeout_s: float = 60.0,
        on_step: Callable[[StepTold], None] | None = None,
    ) -> TrackTold:
        """Wait until a start or a look of the track has ended; return the track after it.

        ``None`` for the operation returns the track as it is. Raises ClientError as `wait`.
        """
        if operation_id is not None:
            self.wait(operation_id, timeout_s, on_step)
        for track in followed(self._daemon, {"topics": "track"}, self.track, timeout_s):
            if operation_id is None or track["operation"] != operation_id:
                return track
        raise ClientError("timeout", f"the track did not take up operation {operation_id}")

    def watch_track(self) -> Iterator[TrackTold]:
        """Yield the track as it is, and again at each change, until the daemon ends."""
        for track in self._daemon.events("/track/stream"):
            yield cast("TrackTold", track)

    def events(self, *topics: str, keys: Sequence[str] = ()) -> Iterator[Event]:
        """Yield each change of some topics (all without any) and keys, beginning with what is known, until
        the daemon ends: ``topic``, ``key``, ``sequence``, ``lost``, ``value``.
        """
        query: dict[str, Any] = {"key": list(keys)} if keys else {}
        if topics:
            query["topics"] = ",".join(topics)
        for event in self._daemon.events("/events", query):
            yield cast("Event", event)

    def stop_track(self) -> TrackTold:
        """End the track; return it as it is then."""
        return cast("TrackTold", self._daemon.json("POST", "/track/stop"))

    def snapshot(
        self,
        camera: str,
        *,
        fresh: bool = True,
        frame_id: str | None = None,
        format: Literal["png", "jpeg"] = "png",
    ) -> Snapshot:
        """Return a picture with its facts.

        Parameters
        ----------
        camera
            The camera's name.
        fresh
            Whether it must be exposed after the daemon got the request; else it is at most a second old.
        frame_id
            A frame that the daemon still keeps, instead of a new one.
        format
            ``png`` is lossless.
        """
        from mastctl.client.snapshot import read_snapshot  # the image library, only where there is an image

        query: dict[str, str] = {"format": format}
        if frame_id is None:
            query["fresh"] = "true" if fresh else "false"
        else:
            query["frame_id"] = frame_id
        answer = self._daemon.ask("GET", f"/snapshot/{quote(camera, safe='')}", params=query)
        try:
            return read_snapshot(answer.content, answer.headers)
        except ValueError as reason:
            raise self._daemon.bad_answer(str(reason)) from None

    def mast_file(self) -> bytes:
        """Return the mast file that the daemon uses, byte for byte."""
        return bytes(self._daemon.ask("GET", "/mast").content)

    def use_mast(self, file: str) -> MastsTold:
        """Use another mast file of the same folder; return which is in use now, and the former one."""
        return cast("MastsTold", self._daemon.command("POST", "/mast", {"file": file}))

    def use_former_mast(self) -> MastsTold:
        """Go back to the mast file that was in use before; return which is in use now, and the former one."""
        return cast("MastsTold", self._daemon.command("POST", "/mast/back"))

    def jog(self) -> Jog:
        """Return a context in which the head turns at rates; it sends the heartbeats itself.

        Examples
        --------
        ::

            with client.jog() as jog:
                jog.rates(0.2, 0.0)      # rad/s
                time.sleep(1.5)
        """
        return Jog(lambda: self._daemon.beside(ANSWER_S))

    def places(self) -> dict[str, PlaceTold]:
        """Return the places of the head that are kept, by name; ``home`` is always among them."""
        return cast("PlacesTold", self._daemon.json("GET", "/places"))["places"]

    def keep_place(self, name: str, pan_rad: float, tilt_rad: float) -> dict[str, PlaceTold]:
        """Keep a place of the head by a name, for everybody; return all."""
        body = {"pan_rad": pan_rad, "tilt_rad": tilt_rad}
        answer = self._daemon.command("POST", f"/places/{quote(name, safe='')}", body)
        return cast("PlacesTold", answer)["places"]

    def forget_place(self, name: str) -> dict[str, PlaceTold]:
        """Forget a place; return those that are left. Raises ClientError ``place_unknown``."""
        return cast("PlacesTold", self._daemon.command("DELETE", f"/places/{quote(name, safe='')}"))["places"]

    def sun(self) -> SunTold:
        """Return the direction that no head camera looks into: ``sun``, null where none was told."""
        return cast("SunTold", self._daemon.json("GET", "/limits/sun"))

    def keep_off_sun(
        self,
        azimuth_rad: float,
        elevation_rad: float,
        half_angle_rad: float,
        *,
        frame: Literal["site", "rover"] = "site",
        valid_s: float | None = None,
    ) -> SunTold:
        """Say where the sun stands: azimuth from north over east (forward over right), elevation up.

        Parameters
        ----------
        half_angle_rad
            How near a head camera's axis may come.
        valid_s
            How long that holds, seconds; left out, until another is told.
        """
        body: dict[str, Any] = {"azimuth_rad": azimuth_rad, "elevation_rad": elevation_rad}
        body |= {"half_angle_rad": half_angle_rad, "frame": frame}
        if valid_s is not None:
            body["valid_s"] = valid_s
        return cast("SunTold", self._daemon.command("POST", "/limits/sun", body))

    def forget_sun(self) -> SunTold:
        """Keep the head off no sun any more."""
        return cast("SunTold", self._daemon.command("DELETE", "/limits/sun"))

    def session(self) -> SessionTold:
        """Return who asks: ``name``, ``role``, ``via``, and whether the daemon asks for a token at all."""
        return cast("SessionTold", self._daemon.json("GET", "/session"))

    def login(self, token: str) -> SessionTold:
        """Begin a session as a page does: this client then needs its token no longer, for some hours."""
        return cast("SessionTold", self._daemon.json("POST", "/login", json={"token": token}))

    def logout(self) -> None:
        """End the session that `login` began."""
        self._daemon.json("POST", "/logout")

    def true_pose(self) -> StandTold:
        """Return where a simulated rover truly stands: ``position_m`` and ``quaternion``, site_from_rover."""
        return cast("StandTold", self._daemon.json("GET", "/simulation/pose"))

    def stand(
        self, x_m: float, y_m: float, heading_rad: float, pitch_rad: float = 0.0, roll_rad: float = 0.0
    ) -> StandTold:
        """Put a simulated rover somewhere on its ground, truly; return its true pose."""
        body = {"x_m": x_m, "y_m": y_m, "heading_rad": heading_rad}
        body |= {"pitch_rad": pitch_rad, "roll_rad": roll_rad}
        return cast("StandTold", self._daemon.command("POST", "/simulation/pose", body))

    def boards(self) -> dict[str, BoardStands]:
        """Return the boards held up before a simulated rover, by name: ``board``, ``position_m``,
        ``quaternion`` (rover_from_board), ``bow_m``.
        """
        return cast("BoardsTold", self._daemon.json("GET", "/simulation/boards"))["boards"]

    def put_board(
        self,
        name: str,
        position_m: Sequence[float],
        board: Mapping[str, Any] | None = None,
        turned_rad: Sequence[float] | None = None,
        quaternion: Sequence[float] | None = None,
        bow_m: Sequence[float] | None = None,
    ) -> BoardStands:
        """Hold a board up before a simulated rover, or move it; frames exposed from now on show it there.

        Parameters
        ----------
        position_m
            (3,) of its middle in the rover frame as the rover truly stands.
        board
            What its BOARD.yaml holds; left out, the board of this name is moved that is there already.
        turned_rad
            How it is turned about its own x, y and z after facing the mast upright: the upper edge nearer,
            the right edge nearer, clockwise.
        quaternion
            rover_from_board (w, x, y, z) instead of that.
        bow_m
            How far its middle stands out, across and down; left out: as before, flat at first.

        Raises
        ------
        ClientError
            ``not_simulated``, ``bad_options``, ``bad_board``.
        """
        body: dict[str, Any] = {"position_m": [float(value) for value in position_m]}
        if board is not None:
            body["board"] = dict(board)
        for key, values in (("turned_rad", turned_rad), ("quaternion", quaternion), ("bow_m", bow_m)):
            if values is not None:
                body[key] = [float(value) for value in values]
        return cast(
            "BoardStands", self._daemon.command("POST", f"/simulation/boards/{quote(name, safe='')}", body)
        )

    def take_board(self, name: str) -> None:
        """Take a board away from a simulated rover."""
        self._daemon.command("DELETE", f"/simulation/boards/{quote(name, safe='')}")

    def simulation_time(self) -> TimeTold:
        """Return a simulated rover's time: ``now_s``, and ``speed``, a number or ``max``."""
        return cast("TimeTold", self._daemon.json("GET", "/simulation/time"))

    def advance(self, duration_s: float) -> TimeTold:
        """Let time pass for a simulated rover whose ``simulation.speed`` is ``max``; return it as
        `simulation_time` does.

        Raises
        ------
        ClientError
            ``time_passes`` where time passes by itself, ``not_simulated``.
        """
        return cast("TimeTold", self._daemon.command("POST", "/simulation/time", {"advance_s": duration_s}))

    def truth(
        self,
        frame_id: str,
        *,
        pixel: tuple[float, float] | None = None,
        position_in_site_m: Sequence[float] | None = None,
    ) -> TruthTold:
        """Return what a pixel (x, y) of a frame truly shows, or where a point of the site truly lies in it.

        Returns
        -------
        told
            ``position_in_site_m``, ``position_m`` in the rover frame when the frame was taken, ``pixel_px``;
            null where the camera could not see it, all where a pixel shows the sky.

        Raises
        ------
        ClientError
            ``not_simulated``; ``frame_too_old`` and such for a frame that is not kept.
        """
        asked: dict[str, Any] = {"frame_id": frame_id}
        if pixel is not None:
            asked |= dict(zip(("x_px", "y_px"), pixel, strict=True))
        if position_in_site_m is not None:
            asked |= dict(zip(("x_m", "y_m", "z_m"), position_in_site_m, strict=True))
        return cast("TruthTold", self._daemon.json("GET", "/simulation/truth", params=asked))

    def fault_words(self) -> dict[str, dict[str, WordTold]]:
        """Return the fault words of each simulated device: what each ``does``, and its ``parameters``."""
        return cast("WordsTold", self._daemon.json("GET", "/simulation/words"))["devices"]

    def faults(self) -> list[FaultSet]:
        """Return the faults that are switched on in a simulated rover."""
        return cast("list[FaultSet]", self._daemon.json("GET", "/simulation/faults")["faults"])

    def set_fault(self, device: str, word: str, **parameters: float) -> list[FaultSet]:
        """Switch a fault of a simulated device on; return all that are on."""
        body = {"device": device, "word": word, "parameters": parameters}
        return cast("list[FaultSet]", self._daemon.command("POST", "/simulation/faults", body)["faults"])

    def clear_faults(self, device: str | None = None) -> None:
        """Switch the faults of one simulated device off, or all."""
        params = {} if device is None else {"device": device}
        self._daemon.command("DELETE", "/simulation/faults", params=params)

    def close(self) -> None:
        """Let go of the connection."""
        self._daemon.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *ignored: object) -> None:
        self.close()


def _how_far(range_m: float | None, plane: Mapping[str, Sequence[float]] | None) -> dict[str, Any]:
    """What says how far a pixel's thing is, as a body has it."""
    told: dict[str, Any] = {} if range_m is None else {"range_m": range_m}
    if plane is not None:
        told["plane"] = {key: list(values) for key, values in plane.items()}
    return told


def _target(
    pixel: tuple[str, str, float, float] | None,
    position_m: Sequence[float] | None,
    frame: Literal["rover", "site"] | None,
) -> dict[str, Any]:
    """What a request says of its target: a pixel of a frame, or a point; what was not given is left out."""
    body: dict[str, Any] = {}
    if pixel is not None:
        body["pixel"] = dict(zip(("camera", "frame_id", "x_px", "y_px"), pixel, strict=True))
    if position_m is not None:
        body["position_m"] = [float(value) for value in position_m]
    if frame is not None:
        body["frame"] = frame
    return body

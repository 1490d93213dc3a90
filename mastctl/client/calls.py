"""Requests that neither point nor track: what a daemon keeps, panoramas, a simulated rover, live pictures."""

from __future__ import annotations

import json
import ssl
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import urlencode

from mastctl import answers
from mastctl.client.connection import PREFIX, Broken, ClientError, DaemonHttp, escaped, given

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection


class Calls:
    """Configuration, mast files, recordings, benches, panoramas, targets, live pictures; of a simulated rover
    its true pose, boards, time and faults.
    """

    daemon: DaemonHttp

    def camera_settings(self, camera: str) -> answers.CameraSettingsAnswer:
        """Return what of a camera can be changed: ``settings`` with bounds, whether they are ``fixed``."""
        return self.daemon.json(answers.CameraSettingsAnswer, "GET", f"/cameras/{escaped(camera)}/settings")

    def set_camera(self, camera: str, **settings: float) -> answers.CameraSettingsAnswer:
        """Change ``exposure_s``, ``gain``, ``white_balance_k``, ``focus`` of a camera, and return all.

        The automatic of each is turned off. ``notes`` has a sentence for each that became another value. They
        hold until the daemon ends, also for a camera that is unplugged meanwhile. Each picture's
        facts have those that it was taken with.
        """
        path = f"/cameras/{escaped(camera)}/settings"
        return self.daemon.command(answers.CameraSettingsAnswer, "PATCH", path, given(**settings))

    def bench(self) -> answers.BenchRuns:
        """Return the bench calibration at work or the last one (``run``), and those that are kept."""
        return self.daemon.json(answers.BenchRuns, "GET", "/bench")

    def begin_bench(self, board: str | None = None, **wanted: Any) -> answers.BenchRunRecord:
        """Have the daemon begin a bench calibration, or go on with one, and return it as it is then.

        ``board`` names a packaged one, ``board_file`` is the text of a BOARD.yaml, ``resume`` names a run:
        one of them is expected. ``wanted_px`` is the error that the calibration may leave of a first
        pointing, rms an axis (by default 0.2), ``pictures`` the most of each camera (60). ``by_hand``: a
        simulated board waits for `board_stands` too, as a real one does.
        """
        body = given(board=board, **wanted)
        return self.daemon.command(answers.BenchAnswer, "POST", "/bench", body)["run"]

    def board_stands(self) -> answers.BenchRunRecord:
        """Confirm that the board is at the requested placement."""
        return self.daemon.command(answers.BenchAnswer, "POST", "/bench/stands")["run"]

    def leave_bench(self) -> answers.BenchRunRecord:
        """End the bench calibration; it can go on later (`begin_bench`, ``resume``)."""
        return self.daemon.command(answers.BenchAnswer, "POST", "/bench/leave")["run"]

    def report(self, name: str) -> bytes:
        """Return the report of a bench calibration, HTML."""
        return self.daemon.request("GET", f"/reports/{escaped(name)}").content

    def start_recording(self, name: str = "") -> answers.RecorderState:
        """Have the daemon record until `stop_recording`; return what it records then."""
        return self.daemon.command(answers.RecorderState, "POST", "/recordings/start", {"name": name})

    def stop_recording(self) -> answers.RecordingEnded:
        """End the recording; return its file on the daemon's machine, its size and what was dropped."""
        return self.daemon.command(answers.RecordingEnded, "POST", "/recordings/stop")

    def mast_file(self) -> bytes:
        """Return the mast file that the daemon uses, byte for byte."""
        return self.daemon.request("GET", "/mast").content

    def use_mast(self, file: str) -> answers.MastChange:
        """Use another mast file of the same folder; return which is in use now, and the former one."""
        return self.daemon.command(answers.MastChange, "POST", "/mast", {"file": file})

    def take_panorama(self, **wanted: Any) -> str:
        """Start to take a panorama and return the operation's id; its record names the panorama.

        ``pair`` or ``camera``; ``pan_rad``, ``tilt_rad``: azimuth and elevation of the field, from and to;
        ``overlap``; ``exposure``: ``first`` or ``auto-per-view``. ``resume`` names one of which views are
        missing, and goes alone.
        """
        return self.daemon.command(answers.Started, "POST", "/panoramas", given(**wanted))["id"]

    def panorama(self, name: str) -> dict[str, Any]:
        """Return a panorama's index (``mastctl/panorama/1``)."""
        return self.daemon.json(dict[str, Any], "GET", f"/panoramas/{escaped(name)}")

    def panorama_file(self, name: str, file: str) -> bytes:
        """Return a file of a panorama: ``index.yaml``, ``mosaic.png``, a frame that the index names."""
        return self.daemon.request("GET", f"/panoramas/{escaped(name)}/files/{file}").content

    def targets(self) -> dict[str, answers.KeptTarget]:
        """Return the targets that are kept, by name."""
        return self.daemon.json(answers.TargetList, "GET", "/targets")["targets"]

    def keep_target(
        self,
        name: str,
        position_m: Sequence[float] | None = None,
        frame: Literal["rover", "site"] = "rover",
        covariance_m2: Sequence[Sequence[float]] | None = None,
        operation: str | None = None,
    ) -> dict[str, answers.KeptTarget]:
        """Keep a point, or what an operation measured, in the site frame if a pose is known; return all."""
        body = given(position_m=position_m, frame=frame, covariance_m2=covariance_m2, operation=operation)
        return self.daemon.command(answers.TargetList, "POST", f"/targets/{escaped(name)}", body)["targets"]

    def true_pose(self) -> answers.TruePose:
        """Return where a simulated rover truly stands: ``position_m`` and ``quaternion``, site_from_rover."""
        return self.daemon.json(answers.TruePose, "GET", "/simulation/pose")

    def stand(
        self, x_m: float, y_m: float, heading_rad: float, pitch_rad: float = 0.0, roll_rad: float = 0.0
    ) -> answers.TruePose:
        """Put a simulated rover somewhere on its ground, truly; return its true pose."""
        body = {"x_m": x_m, "y_m": y_m, "heading_rad": heading_rad}
        body |= {"pitch_rad": pitch_rad, "roll_rad": roll_rad}
        return self.daemon.command(answers.TruePose, "POST", "/simulation/pose", body)

    def boards(self) -> dict[str, answers.BoardPose]:
        """Return the boards held up before a simulated rover, by name: ``board``, ``position_m``,
        ``quaternion`` (rover_from_board), ``bow_m``.
        """
        return self.daemon.json(answers.BoardList, "GET", "/simulation/boards")["boards"]

    def put_board(
        self,
        name: str,
        position_m: Sequence[float],
        board: Mapping[str, Any] | None = None,
        **more: Sequence[float] | None,
    ) -> answers.BoardPose:
        """Hold a board up before a simulated rover, or move it; frames exposed from now on show it there.

        ``position_m`` (3,) is that of its middle in the rover frame as the rover truly stands; ``board`` has
        the contents of its BOARD.yaml, by default those of the present board of this name. ``quaternion``:
        rover_from_board (w, x, y, z), by default so that it faces the mast upright. ``bow_m``: how far its
        middle stands out, across and down; by default as before, flat at first.
        """
        body = given(position_m=position_m, board=board, **more)
        return self.daemon.command(answers.BoardPose, "POST", f"/simulation/boards/{escaped(name)}", body)

    def take_board(self, name: str) -> None:
        """Take a board away from a simulated rover."""
        self.daemon.command(answers.BoardList, "DELETE", f"/simulation/boards/{escaped(name)}")

    def simulation_time(self) -> answers.SimulationTime:
        """Return a simulated rover's time: ``now_s``, and ``speed``, a number or ``max``."""
        return self.daemon.json(answers.SimulationTime, "GET", "/simulation/time")

    def advance(self, duration_s: float) -> answers.SimulationTime:
        """Let time pass for a simulated rover whose ``simulation.speed`` is ``max``; return it then.

        Raises ClientError ``time_passes`` where time passes by itself.
        """
        return self.daemon.command(
            answers.SimulationTime, "POST", "/simulation/time", {"advance_s": duration_s}
        )

    def truth(
        self,
        frame_id: str,
        *,
        pixel: tuple[float, float] | None = None,
        position_in_site_m: Sequence[float] | None = None,
    ) -> answers.PointTruth:
        """Return what a pixel (x, y) of a frame truly shows, or where a point of the site truly lies in it.

        ``position_m`` is in the rover frame when the frame was taken; ``pixel_px`` null where the camera
        could not see it, all three where a pixel shows the sky. Raises ClientError ``frame_too_old`` and
        such.
        """
        x_px, y_px = pixel or (None, None)
        x_m, y_m, z_m = (None, None, None) if position_in_site_m is None else position_in_site_m
        query = given(frame_id=frame_id, x_px=x_px, y_px=y_px, x_m=x_m, y_m=y_m, z_m=z_m)
        return self.daemon.json(answers.PointTruth, "GET", "/simulation/truth", params=query)

    def faults(self) -> list[answers.FaultSet]:
        """Return the faults that are switched on in a simulated rover."""
        return self.daemon.json(answers.FaultsSet, "GET", "/simulation/faults")["faults"]

    def set_fault(self, /, device: str, word: str, **parameters: float) -> list[answers.FaultSet]:
        """Switch a fault of a simulated device on; return all that are on."""
        body = {"device": device, "word": word, "parameters": parameters}
        return self.daemon.command(answers.FaultsSet, "POST", "/simulation/faults", body)["faults"]

    def clear_faults(self, device: str | None = None) -> None:
        """Switch the faults of one simulated device off, or all."""
        self.daemon.command(answers.FaultsSet, "DELETE", "/simulation/faults", params=given(device=device))

    @contextmanager
    def live_pictures(self, *cameras: str) -> Iterator[LivePictures]:
        """Open a line on which pictures of some cameras come, as JPEG at the cameras' own rate.

        Raises ClientError ``no_daemon``; ``refused`` if the daemon does not send them, with its reason;
        ``no_websockets`` where that package is missing.
        """
        try:
            from websockets.exceptions import InvalidHandshake, InvalidURI
            from websockets.sync.client import connect, unix_connect
        except ImportError:
            reason = "live pictures need the package websockets; 'pip install websockets' brings it"
            raise ClientError("no_websockets", reason) from None
        daemon, path = self.daemon, self.daemon.socket_path
        base = "http://localhost" if path is not None else daemon.url.rstrip("/")
        query = urlencode([("camera", one) for one in cameras] + [("on_request", "true"), ("every", "true")])
        address = f"ws{base.removeprefix('http')}{PREFIX}/images?{query}"
        options: dict[str, Any] = {"additional_headers": daemon.shown, "compression": None, "max_size": None}
        try:
            if path is not None:
                line = unix_connect(path, address, **options)
            else:
                secure = ssl.create_default_context() if address.startswith("wss") else None
                line = connect(address, proxy=None, ssl=secure, **options)
        except (InvalidHandshake, InvalidURI) as error:
            raise ClientError(
                "refused", f"the daemon at {daemon.url} sends no pictures: {_why(error)}"
            ) from None
        except (OSError, TimeoutError):
            raise daemon.no_daemon() from None
        with line:
            yield LivePictures(line, daemon.url)


@dataclass(frozen=True, eq=False)
class LivePicture:
    """A camera's JPEG as it came, and its ``facts``: ``camera``, ``frame_id``, ``mid_exposure_s``, ..."""

    facts: dict[str, Any]
    jpeg: bytes


class LivePictures:
    """An open line of live pictures, for one thread. A camera sends its next picture after `wanted`: the
    first one too.
    """

    def __init__(self, line: ClientConnection, url: str) -> None:
        self._line = line
        self._url = url

    def wanted(self, camera: str) -> None:
        """Request a camera's next picture. Raises ClientError as `next`."""
        with self._breaks():
            self._line.send(camera)

    def next(self, timeout_s: float) -> LivePicture | None:
        """Return the next picture, None if there was none for so many seconds.

        Raises ClientError ``no_daemon`` if the line broke or the daemon has ended, ``bad_answer``.
        """
        try:
            with self._breaks():
                message = self._line.recv(timeout=timeout_s)
            if isinstance(message, str):
                raise ValueError
            length = 4 + int.from_bytes(message[:4], "little")
            return LivePicture(dict(json.loads(message[4:length])), message[length:])
        except TimeoutError:
            return None
        except ValueError:
            raise ClientError("bad_answer", f"the program at {self._url} sends no pictures") from None

    @contextmanager
    def _breaks(self) -> Iterator[None]:
        from websockets.exceptions import ConnectionClosed

        try:
            yield
        except TimeoutError:
            raise
        except (ConnectionClosed, OSError) as error:
            raise Broken("no_daemon", f"the line of pictures of {self._url} broke: {error}") from None


def _why(error: Exception) -> str:
    """The sentence of a refusal."""
    try:
        return str(json.loads(error.response.body)["error"]["message"])  # type: ignore[attr-defined]
    except (AttributeError, ValueError, LookupError, TypeError):
        return str(error)

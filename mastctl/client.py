"""A small client of a running daemon: what the command line and the experiments use."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal
from urllib.parse import quote, unquote, urlsplit

import cv2
import httpx
import numpy as np

from drivers.interfaces import Image

PREFIX = "/api/v1"
DEFAULT_URL = "http://127.0.0.1:8420"
POLL_S = 0.05
_BAD_INPUT = frozenset({400, 404, 413, 415, 422})


class ClientError(Exception):
    """The daemon refused, failed, or did not answer.

    Attributes
    ----------
    code
        The daemon's word, or the client's own: ``no_daemon``, ``bad_url``, ``timeout``, ``bad_answer``.
    detail
        What else the daemon told, or None.
    exit_code
        What a command ends with: 2 for bad input, 1 for a failure.
    """

    def __init__(
        self, code: str, message: str, detail: Mapping[str, Any] | None = None, exit_code: int = 1
    ) -> None:
        self.code = code
        self.detail = detail
        self.exit_code = exit_code
        super().__init__(message)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A picture and its facts, as `mastctl.devices.frames.StampedFrame`; ``data`` is the file as it came."""

    image: Image
    data: bytes
    frame_id: str
    camera: str
    sequence: int
    mid_exposure_s: float
    exposure_s: float
    pan_rad: float
    tilt_rad: float
    moving: bool
    mast_digest: str

    @property
    def facts(self) -> dict[str, Any]:
        """Everything but the picture, as JSON."""
        height, width = self.image.shape[:2]
        return {
            "frame_id": self.frame_id,
            "camera": self.camera,
            "sequence": self.sequence,
            "size_px": [width, height],
            "mid_exposure_s": self.mid_exposure_s,
            "exposure_s": self.exposure_s,
            "pan_rad": self.pan_rad,
            "tilt_rad": self.tilt_rad,
            "moving": self.moving,
            "mast_digest": self.mast_digest,
        }


class Client:
    """A connection to one daemon. A context manager; usable from one thread at a time.

    Parameters
    ----------
    url
        ``http://127.0.0.1:8420``, or ``unix:/path/of/socket``.
    timeout_s
        What each request is given, seconds.

    Raises
    ------
    ClientError
        ``bad_url``, if the address is of neither form. Every method raises it for whatever goes wrong.
    """

    def __init__(self, url: str = DEFAULT_URL, timeout_s: float = 30.0) -> None:
        self.url = url
        transport: httpx.HTTPTransport | None = None
        base = url.rstrip("/")
        if url.startswith("unix:"):
            transport = httpx.HTTPTransport(uds=unquote(url.removeprefix("unix:").removeprefix("//")))
            base = "http://localhost"
        try:
            parts = urlsplit(base)
            if parts.scheme not in ("http", "https") or not parts.hostname or (parts.port or 1) < 1:
                raise ValueError
            # No proxy of the environment: the daemon is on this machine, or reached by a tunnel to it.
            self._http = httpx.Client(base_url=base, timeout=timeout_s, trust_env=False, transport=transport)
        except (ValueError, httpx.InvalidURL):
            raise ClientError(
                "bad_url",
                f"'{url}' is no address of a daemon; http://127.0.0.1:8420 or unix:/path is expected",
                exit_code=2,
            ) from None

    def status(self) -> dict[str, Any]:
        """Return what the daemon knows at this moment."""
        return self._json("GET", "/status")

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
        """
        body: dict[str, Any] = {}
        if pixel is not None:
            body["pixel"] = dict(zip(("camera", "frame_id", "x_px", "y_px"), pixel, strict=True))
        if position_m is not None:
            body["position_m"] = [float(value) for value in position_m]
        if aim is not None:
            body["aim"] = dict(zip(("camera", "x_px", "y_px"), aim, strict=True))
        others = {"frame": frame, "pan_rad": pan_rad, "tilt_rad": tilt_rad, "pointings": pointings}
        body |= {key: value for key, value in others.items() if value is not None}
        return str(self._json("POST", "/point", json=body)["id"])

    def operation(self, operation_id: str) -> dict[str, Any]:
        """Return an operation's record."""
        return self._json("GET", f"/operations/{quote(operation_id, safe='')}")

    def operations(self) -> list[dict[str, Any]]:
        """Return the newest operations, newest first, without their steps."""
        return list(self._json("GET", "/operations")["operations"])

    def wait(
        self,
        operation_id: str,
        timeout_s: float = 60.0,
        on_step: Callable[[dict[str, Any]], None] | None = None,
    ) -> dict[str, Any]:
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
        until_s = time.monotonic() + timeout_s
        told = 0
        while True:
            record = self.operation(operation_id)
            for step in record["steps"][told:]:
                told += 1
                if on_step is not None:
                    on_step(step)
            if record["state"] in ("done", "failed", "stopped"):
                return record
            if time.monotonic() > until_s:
                raise ClientError("timeout", f"operation {operation_id} has not ended after {timeout_s:g} s")
            time.sleep(POLL_S)

    def stop(self) -> dict[str, Any]:
        """Stop the mast and the running operation."""
        return self._json("POST", "/stop")

    def pose(
        self,
        position_m: Sequence[float],
        quaternion: Sequence[float],
        *,
        covariance: Sequence[Sequence[float]] | None = None,
        sigma: tuple[float, float] | None = None,
        time_s: float | None = None,
        look: bool = True,
    ) -> dict[str, Any]:
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
        return self._json("POST", "/pose", json=body)

    def track(self) -> dict[str, Any]:
        """Return the track as it is."""
        return self._json("GET", "/track")

    def start_track(
        self,
        *,
        pixel: tuple[str, str, float, float] | None = None,
        position_m: Sequence[float] | None = None,
        frame: Literal["rover", "site"] | None = None,
    ) -> str:
        """Start to follow a target and return the operation's id; arguments as for `point`."""
        body: dict[str, Any] = {}
        if pixel is not None:
            body["pixel"] = dict(zip(("camera", "frame_id", "x_px", "y_px"), pixel, strict=True))
        if position_m is not None:
            body["position_m"] = [float(value) for value in position_m]
        if frame is not None:
            body["frame"] = frame
        return str(self._json("POST", "/track", json=body)["id"])

    def look(self) -> str:
        """Look for the track's target once more; return the operation's id."""
        return str(self._json("POST", "/track/look")["id"])

    def wait_track(
        self,
        operation_id: str | None,
        timeout_s: float = 60.0,
        on_step: Callable[[dict[str, Any]], None] | None = None,
    ) -> dict[str, Any]:
        """Wait until a start or a look of the track has ended; return the track after it.

        ``None`` for the operation returns the track as it is. Raises ClientError as `wait`.
        """
        if operation_id is not None:
            self.wait(operation_id, timeout_s, on_step)
        until_s = time.monotonic() + timeout_s
        while (track := self.track())["operation"] == operation_id is not None:
            if time.monotonic() > until_s:
                raise ClientError("timeout", f"the track did not take up operation {operation_id}")
            time.sleep(POLL_S)
        return track

    def watch_track(self) -> Iterator[dict[str, Any]]:
        """Yield the track as it is, and again at each change, until the daemon ends."""
        try:
            with self._http.stream("GET", PREFIX + "/track/stream") as answer:
                if not answer.is_success:
                    raise self._bad_answer(f"the stream says {answer.status_code}")
                for line in answer.iter_lines():
                    if line.startswith("data:"):
                        yield json.loads(line.removeprefix("data:"))
        except (httpx.ConnectError, httpx.ConnectTimeout):
            raise self._no_daemon() from None
        except httpx.TimeoutException:
            raise ClientError("timeout", f"the daemon at {self.url} fell silent") from None
        except httpx.HTTPError as error:
            raise ClientError("no_daemon", f"the connection to {self.url} broke: {error}") from None
        except ValueError:
            raise self._bad_answer("an event of the stream is not JSON") from None

    def stop_track(self) -> dict[str, Any]:
        """End the track; return it as it is then."""
        return self._json("POST", "/track/stop")

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
        query: dict[str, str] = {"format": format}
        if frame_id is None:
            query["fresh"] = "true" if fresh else "false"
        else:
            query["frame_id"] = frame_id
        answer = self._ask("GET", f"/snapshot/{quote(camera, safe='')}", params=query)
        image = cv2.imdecode(np.frombuffer(answer.content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise self._bad_answer("the picture cannot be decoded")
        told = answer.headers
        try:
            return Snapshot(
                image=np.asarray(image, dtype=np.uint8),
                data=answer.content,
                frame_id=told["X-Mastctl-Frame-Id"],
                camera=told["X-Mastctl-Camera"],
                sequence=int(told["X-Mastctl-Sequence"]),
                mid_exposure_s=float(told["X-Mastctl-Mid-Exposure-S"]),
                exposure_s=float(told["X-Mastctl-Exposure-S"]),
                pan_rad=float(told["X-Mastctl-Pan-Rad"]),
                tilt_rad=float(told["X-Mastctl-Tilt-Rad"]),
                moving=told["X-Mastctl-Moving"] == "true",
                mast_digest=told["X-Mastctl-Mast-Digest"],
            )
        except (KeyError, ValueError) as reason:
            raise self._bad_answer(f"the picture's facts are wrong: {reason}") from None

    def mast_file(self) -> bytes:
        """Return the mast file that the daemon uses, byte for byte."""
        return bytes(self._ask("GET", "/mast").content)

    def true_pose(self) -> dict[str, Any]:
        """Return where a simulated rover truly stands: ``position_m`` and ``quaternion``, site_from_rover."""
        return self._json("GET", "/simulation/pose")

    def stand(
        self, x_m: float, y_m: float, heading_rad: float, pitch_rad: float = 0.0, roll_rad: float = 0.0
    ) -> dict[str, Any]:
        """Put a simulated rover somewhere on its ground, truly; return its true pose."""
        body = {"x_m": x_m, "y_m": y_m, "heading_rad": heading_rad}
        body |= {"pitch_rad": pitch_rad, "roll_rad": roll_rad}
        return self._json("POST", "/simulation/pose", json=body)

    def faults(self) -> list[dict[str, Any]]:
        """Return the faults that are switched on in a simulated rover."""
        return list(self._json("GET", "/simulation/faults")["faults"])

    def set_fault(self, device: str, word: str, **parameters: float) -> list[dict[str, Any]]:
        """Switch a fault of a simulated device on; return all that are on."""
        body = {"device": device, "word": word, "parameters": parameters}
        return list(self._json("POST", "/simulation/faults", json=body)["faults"])

    def clear_faults(self, device: str | None = None) -> None:
        """Switch the faults of one simulated device off, or all."""
        self._json("DELETE", "/simulation/faults", params={} if device is None else {"device": device})

    def close(self) -> None:
        """Let go of the connection."""
        self._http.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _json(self, method: str, path: str, **options: Any) -> dict[str, Any]:
        """Ask, and return the answer, which must be a JSON object."""
        answer = self._ask(method, path, **options)
        try:
            document = answer.json()
        except ValueError:
            document = None
        if not isinstance(document, dict):
            raise self._bad_answer("the answer is not a JSON object")
        return document

    def _ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Ask, and return a good answer; everything else is a ClientError."""
        try:
            answer = self._http.request(method, PREFIX + path, **options)
        except (httpx.ConnectError, httpx.ConnectTimeout):
            raise self._no_daemon() from None
        except httpx.TimeoutException:
            raise ClientError(
                "timeout", f"the daemon at {self.url} took the request but did not answer"
            ) from None
        except httpx.HTTPError as error:
            raise ClientError("no_daemon", f"the connection to {self.url} broke: {error}") from None
        except ValueError as error:
            raise ClientError("bad_request", f"the request cannot be sent: {error}", exit_code=2) from None
        if answer.is_success:
            return answer
        try:
            told = answer.json()["error"]
            code, message, detail = str(told["code"]), str(told["message"]), told.get("detail")
        except (ValueError, LookupError, TypeError, AttributeError):
            raise self._bad_answer(f"it says {answer.status_code}, not in the way of this program") from None
        exit_code = 2 if answer.status_code in _BAD_INPUT else 1
        raise ClientError(code, message, detail if isinstance(detail, dict) else None, exit_code)

    def _no_daemon(self) -> ClientError:
        return ClientError("no_daemon", f"no daemon answers at {self.url}; 'mastctl run' starts one")

    def _bad_answer(self, reason: str) -> ClientError:
        return ClientError("bad_answer", f"what answers at {self.url} is no mastctl daemon: {reason}")

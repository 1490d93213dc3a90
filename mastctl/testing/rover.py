"""The simulated rover as a test sees it (the truth beside the service, faults, time), and its process."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

Request = Callable[..., Any]
"""``request(do, **parameters)``: has the daemon's process carry out an order, and returns its answer."""

ANSWER_S = 120.0
"""The time allowed for an answer, seconds: closing a daemon whose devices hang takes longest."""

START_S = 600.0
"""The time allowed for a start, seconds: the first one after an installation compiles the renderer."""

END_S = 5.0


class RoverError(Exception):
    """The request to the simulated rover cannot be fulfilled: one sentence, and the daemon's ``code``."""

    def __init__(self, message: str, code: str = "failed") -> None:
        self.code = code
        super().__init__(message)


class SetFault(AbstractContextManager["SetFault"]):
    """A fault that is set. Leaving it as a context, or `clear`, takes it back."""

    def __init__(self, request: Request, device: str, word: str) -> None:
        self._request = request
        self.device, self.word = device, word

    def clear(self) -> None:
        """Take the fault back; nothing if it is over already."""
        self._request("clear_fault", device=self.device, word=self.word)

    def __exit__(self, *ignored: object) -> None:
        self.clear()


class SimulatedRover:
    """The rover behind a test's daemon. Angles in radians, lengths in metres; pixels as everywhere: (x, y),
    the centre of the top-left pixel at (0, 0).

    Values named true are those that the daemon never reads: the mechanical angles, with backlash and sag, and
    the true cameras. Every method raises `RoverError` when the daemon's process has ended.
    ``url`` is the daemon's address.
    """

    def __init__(self, request: Request, url: str) -> None:
        self._request = request
        self.url = url

    def true_joints(self) -> tuple[float, float]:
        """Return the mechanical pan and tilt of now, radians."""
        pan_rad, tilt_rad = self._request("joints")
        return pan_rad, tilt_rad

    def true_point(self, frame_id: str, x_px: float, y_px: float) -> tuple[float, float, float] | None:
        """Return the point that a pixel of a frame shows, metres in the true rover frame; None for sky.

        Raises RoverError for a frame that is not among the 512 newest of this daemon.
        """
        point = self._request("point", frame_id=frame_id, pixel_px=[float(x_px), float(y_px)])
        return None if point is None else (point[0], point[1], point[2])

    def true_pixel(self, frame_id: str, position_m: Sequence[float]) -> tuple[float, float] | None:
        """Return the pixel where a point, metres in the true rover frame, lies in a frame.

        None where the camera cannot see; whether something stands before the point is not checked. Raises
        RoverError as `true_point`, and for a position that is not three numbers.
        """
        if len(position_m) != 3:
            raise RoverError(f"position_m has {len(position_m)} numbers, expected three", "bad_request")
        pixel = self._request("pixel", frame_id=frame_id, position_m=[float(value) for value in position_m])
        return None if pixel is None else (pixel[0], pixel[1])

    def true_pose(self) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
        """Return where the rover truly stands in the site frame: metres, and a quaternion (w, x, y, z)."""
        position_m, quaternion = self._request("pose")
        return tuple(position_m), tuple(quaternion)

    def stand(
        self, x_m: float, y_m: float, heading_rad: float, pitch_rad: float = 0.0, roll_rad: float = 0.0
    ) -> None:
        """Put the rover on its ground, at once and unknown to the daemon. Raises RoverError off it."""
        self._request("stand", place=[float(v) for v in (x_m, y_m, heading_rad, pitch_rad, roll_rad)])

    def now_s(self) -> float:
        """Return the rover's time, seconds: that of frames, readings and ``now_s`` in the status."""
        return float(self._request("now"))

    def advance(self, duration_s: float) -> float:
        """Let time pass for the rover and return its time then.

        At ``speed: max`` nothing else makes time pass between two commands, and this returns at once; at any
        other speed it waits.
        """
        return float(self._request("advance", duration_s=float(duration_s)))

    def end_daemon(self) -> None:
        """End the daemon and the rover with it: the address does not answer from then on."""
        self._request("close")

    def start_daemon(self) -> None:
        """Start the daemon that `end_daemon` ended, at the same address, with a rover just switched on.

        Raises RoverError if it runs, or the address has been taken meanwhile.
        """
        self._request("start")

    def set_fault(self, device: str, word: str, **parameters: float) -> SetFault:
        """Set a fault of docs/drivers.md, in place of one with the same word on the same device.

        ``device`` is ``pan_tilt`` or a camera's name; every fault has the parameters ``after_s`` and
        ``for_s`` beside its own. Raises RoverError for an unknown device, word or parameter, or a value out
        of bounds.
        """
        self._request("set_fault", device=device, word=word, parameters=parameters)
        return SetFault(self._request, device, word)

    def clear_faults(self) -> None:
        """Take back every fault, also those that the configuration sets."""
        self._request("clear_fault", device=None, word=None)


class RoverProcess:
    """A process for one daemon after the other: the compiled renderer and the ground are made once.

    It ends with `close`, and by itself when the process that made it is gone. ``log`` is the file of the
    daemons' stderr, and temporary files go beside it; ``workers`` such processes share the processors.
    """

    def __init__(self, log: Path, workers: int = 1) -> None:
        self.log = log
        self._lock = threading.Lock()
        cores = len(os.sched_getaffinity(0))
        share = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        share["NUMBA_NUM_THREADS"] = str(max(1, cores // max(1, workers)))
        self._line, theirs = socket.socketpair()
        with log.open("ab") as printed, theirs:
            fd = theirs.fileno()
            self._process = subprocess.Popen(
                # -P: a folder of the project named as one of ours ("drivers") is not taken for it.
                [sys.executable, "-P", "-m", "mastctl.testing.daemons", str(os.getpid()), str(fd)],
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=printed,
                pass_fds=[fd],
                env={**share, **os.environ, "TMPDIR": str(log.parent)},  # killed, it clears nothing away
                # Ctrl-C is for the tests; the daemon is ended by its fixture, after them.
                start_new_session=True,
            )
        self._answers = self._line.makefile("rb")

    @property
    def pid(self) -> int:
        """The process's id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self._process.poll() is None

    def request(self, do: str, within_s: float = ANSWER_S, **parameters: Any) -> Any:
        """Have an order carried out, and return its answer. Raises RoverError."""
        with self._lock:
            try:
                self._line.settimeout(within_s)
                self._line.sendall(json.dumps({"do": do, **parameters}).encode() + b"\n")
                answer = json.loads(self._answers.readline())
            except (OSError, ValueError) as error:
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(0.0 if isinstance(error, TimeoutError) else END_S)
                code = self._process.poll()
                how = f"it ended with {code}" if code is not None else str(error)
                raise RoverError(f"the daemon's process does not answer: {how}; {self.log}", "gone") from None
        if "error" in answer:
            raise RoverError(answer["error"]["message"], answer["error"]["code"])
        return answer["done"]

    def close(self) -> None:
        """End it; bounded."""
        self._answers.close()
        self._line.close()  # its sign to end
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

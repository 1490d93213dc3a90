"""The process that a worker's daemons live in: ``python -m mastctl.testing.daemons PARENT SOCKET``.

It takes one JSON order a line on the socket and answers each with one. A test gets a daemon of its own;
nothing of the test before is left: no faults, track, stop, mast file in use, place of head and rover, or time
of the clock.

The process ends when the socket is closed, and when the process PARENT is gone: a copy of that one, forked by
a test, may hold it open. A worker of pytest-xdist outlives the pytest that made it by many seconds: that
pytest is watched too.
"""

from __future__ import annotations

import json
import logging
import math
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from calib.files.mast_file import load_rig, save_rig
from calib.geometry.cahvor import CameraModel
from drivers.errors import BadOptions
from drivers.sim.rover import RoverModel
from mastctl.config import Config, Listen, load_config, not_simulated
from mastctl.daemon import RunningDaemon
from mastctl.devices.frames import camera_and_sequence
from mastctl.errors import NotKnown, NotNow, error_body
from mastctl.logs import QueuedHandler, queued
from mastctl.motion.track import RoverPose

USUAL = {"samples": 1, "speed": "max"}


class Daemons:
    """The daemon of the test that runs, if any."""

    def __init__(self) -> None:
        self._daemon: RunningDaemon | None = None
        self._config: Config | None = None  # of the one that runs, or ran last

    def do(self, name: str, order: dict[str, Any]) -> Any:
        """Carry out an order and return its answer, fit for JSON."""
        action = getattr(self, f"_do_{name}")
        if name in ("open", "close", "start") or self._daemon is None:
            return action(**order)
        with self._daemon.service.clock.at_work():
            return action(**order)

    @property
    def _rover(self) -> RoverModel:
        if self._daemon is None or self._daemon.hardware.simulation is None:
            raise NotKnown("no_daemon", "the daemon does not run; start_daemon() starts it")
        return self._daemon.hardware.simulation

    def _do_open(
        self, config: str | None, picture_width_px: int | None, simulation: dict[str, Any], folder: str
    ) -> str:
        self._do_close()
        wanted = config_for_a_test(config, picture_width_px, simulation, Path(folder))
        self._daemon = RunningDaemon(wanted)
        port = int(self._daemon.url.rpartition(":")[2])
        self._config = replace(wanted, listen=Listen(port=port))
        return self._daemon.url

    def _do_start(self) -> None:
        if self._daemon is not None or self._config is None:
            raise NotNow("runs_already", "the daemon runs already; end_daemon() ends it")
        self._daemon = RunningDaemon(self._config)

    def _do_close(self) -> None:
        daemon, self._daemon = self._daemon, None
        if daemon is not None:
            if daemon.hardware.simulation is not None:
                daemon.hardware.simulation.faults.clear()  # whatever hangs comes back: nothing is left behind
            daemon.close()

    def _do_joints(self) -> tuple[float, float]:
        return self._rover.true_joints(self._do_now())

    def _do_point(self, frame_id: str, pixel_px: list[float]) -> list[float] | None:
        point = self._in_frame(self._rover.true_point, frame_id, pixel_px)
        return None if point is None else point.tolist()

    def _do_pixel(self, frame_id: str, position_m: list[float]) -> list[float] | None:
        pixel: list[float] = self._in_frame(self._rover.true_pixel, frame_id, position_m).tolist()
        return pixel if all(map(math.isfinite, pixel)) else None

    @staticmethod
    def _in_frame(truth: Callable[[str, int, list[float]], Any], frame_id: str, numbers: list[float]) -> Any:
        try:
            return truth(*camera_and_sequence(frame_id), numbers)
        except (LookupError, ValueError) as error:
            raise NotKnown("frame_unknown", str(error)) from None

    def _do_pose(self) -> tuple[list[float], list[float]]:
        pose = RoverPose(self._rover.site_from_rover).as_json(0.0)
        return pose["position_m"], pose["quaternion"]

    def _do_stand(self, place: list[float]) -> None:
        self._rover.stand(*place)

    def _do_set_fault(self, device: str, word: str, parameters: dict[str, float]) -> None:
        self._rover.faults.set(device, word, **parameters)

    def _do_clear_fault(self, device: str | None, word: str | None) -> None:
        self._rover.faults.clear(device, word)

    def _do_advance(self, duration_s: float) -> float:
        if not 0.0 <= duration_s <= 1e6:
            raise BadOptions(f"time is to advance by {duration_s} s, expected a number from 0 to 1000000")
        assert self._daemon is not None
        self._daemon.service.clock.sleep(duration_s)
        return self._do_now()

    def _do_now(self) -> float:
        assert self._rover is not None and self._daemon is not None
        return self._daemon.service.clock.now_s()


def config_for_a_test(
    path: str | None, picture_width_px: int | None, simulation: dict[str, Any], folder: Path
) -> Config:
    """Return the configuration of a test's rover, from a file or the packaged one.

    ``simulation`` has keys in place of that section's; a file without them gets one ray a pixel, and ``speed:
    max`` if its head has no wire. New mast files, for another width of the images, are written into
    ``folder``. Raises BadFile as `load_config`, and BadOptions if a device of it is not simulated.
    """
    config = load_config(path)
    if real := not_simulated(config.hardware):
        raise BadOptions(
            f"{config.path}: {real[0]} has driver {real[1]!r}, expected a simulated device: tests in "
            "parallel without an observer move no real head"
        )
    section = dict(config.hardware.simulation)
    if path is None:
        section.pop("samples", None)  # what the demo looks best with
    if "wire" in simulation:
        section.pop("head", None)  # the wire's own, if none is requested
    section = {**USUAL, **section, **simulation}
    if section.get("wire") is not None and "speed" not in simulation:
        section["speed"] = 1
    config = replace(config, listen=Listen(port=0), hardware=replace(config.hardware, simulation=section))
    return config if picture_width_px is None else with_width(config, picture_width_px, folder)


NARROWEST_PX = 64
WIDEST_PX = 4096


def with_width(config: Config, width_px: int, folder: Path) -> Config:
    """Return a configuration whose cameras, as believed and as they truly are, have pictures of a width.

    They see what they saw before, in as many more or fewer pixels; residuals and covariance were of other
    pixels, and go. Both mast files are written into ``folder``. Raises BadOptions for a width that is none,
    or a true rig that cannot be read, and BadFile for a mast file that cannot be read.
    """
    if (
        isinstance(width_px, bool)
        or not isinstance(width_px, int)
        or not NARROWEST_PX <= width_px <= WIDEST_PX
    ):
        raise BadOptions(
            f"picture_width_px is {width_px!r}, expected a whole number from {NARROWEST_PX} to {WIDEST_PX}"
        )
    hardware = config.hardware
    true_rig = hardware.simulation.get("rover")
    if not isinstance(true_rig, str):
        return config  # the simulation says what is wrong
    try:
        rigs = {"true_rig.yaml": load_rig(hardware.folder / true_rig).rig}
    except BadFile as error:
        raise BadOptions(f"simulation.rover: {error}") from None
    rigs["mast.yaml"] = load_rig(config.mast_file).rig
    for name, rig in rigs.items():
        cameras = {
            camera: replace(one, model=resized(one.model, width_px)) for camera, one in rig.cameras.items()
        }
        save_rig(replace(rig, cameras=cameras, fit={}), folder / name)
    simulation = {**hardware.simulation, "rover": str(folder / "true_rig.yaml")}
    return replace(config, mast_file=folder / "mast.yaml", hardware=replace(hardware, simulation=simulation))


def resized(model: CameraModel, width_px: int) -> CameraModel:
    """Return a camera that sees the same in pictures of another width, and of the height that goes with it.

    The edges of the picture stay where they are: x + 1/2 grows by the factor, as the centre of the first
    pixel is 0. H and V are linear in the pixels: H' = s H + (s - 1)/2 A.
    """
    width, height = model.size_px
    size_px = (width_px, max(1, round(height * width_px / width)))
    across, down = size_px[0] / width, size_px[1] / height
    return replace(
        model,
        size_px=size_px,
        H=across * model.H + (across - 1.0) / 2.0 * model.A,
        V=down * model.V + (down - 1.0) / 2.0 * model.A,
    )


PARENT_CHECKED_S = 0.25


def main() -> None:
    """Serve until no client is left."""
    parent, line = int(sys.argv[1]), socket.socket(fileno=int(sys.argv[2]))
    line.set_inheritable(False)
    threading.Thread(target=_watch, args=(parent,), name="parent watched", daemon=True).start()
    sys.stdout = sys.stderr = queued(2)  # as `mastctl run` says things
    handler = QueuedHandler(queued(2))
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.getLogger().addHandler(handler)
    for name in ("mastctl", "drivers", "calib"):
        logging.getLogger(name).setLevel(logging.INFO)
    daemons = Daemons()
    with line, line.makefile("rb") as orders, suppress(OSError):
        for text in orders:
            order: dict[str, Any] = json.loads(text)
            try:
                answer = {"done": daemons.do(order.pop("do"), order)}
            except Exception as error:
                body = error_body(error)
                if body["code"] == "internal":
                    logging.getLogger(__name__).exception("an order failed")
                answer = {"error": {"code": body["code"], "message": body["message"]}}
            line.sendall(json.dumps(answer).encode() + b"\n")
    os._exit(0)  # a simulated rover needs no orderly end, and a thread that hangs must not hold this one


def _watch(parent: int) -> None:
    """End with the process that made this one; the system names another parent when that is gone."""
    controller = _parent_of(parent) if "PYTEST_XDIST_WORKER" in os.environ else None
    while os.getppid() == parent and (controller is None or _parent_of(parent) == controller):
        time.sleep(PARENT_CHECKED_S)
    os._exit(1)


def _parent_of(pid: int) -> int | None:
    """The id of a process's parent; None if it is gone."""
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2]
    except OSError:
        return None
    return int(after_name.split()[1])


if __name__ == "__main__":
    main()

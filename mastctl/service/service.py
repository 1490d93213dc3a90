"""What a daemon consists of, from the configuration to the last operation, without any web in it.

Its parts are made, each with those below it in hand, and closed again, the head first.
"""

from __future__ import annotations

import contextlib
import logging
import math
import random
import threading
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from calib.files.mast_file import StoredRig
from calib.matching.handoff import MatchedHandoff
from drivers.clock import Clock, SystemClock
from drivers.hardware import Hardware, clock_for, head_name
from drivers.simulation_clock import SimulationClock
from mastctl.answers import (
    CameraAnswer,
    EstopAnswer,
    MeasuredJoints,
    PanoramaDrawn,
    Status,
    StopAnswer,
    TrackAnswer,
)
from mastctl.as_json import as_json
from mastctl.bench.operation import BenchOperation
from mastctl.config import Config
from mastctl.control.entry import (
    ESTOP,
    STOP,
    Answers,
    CommandEntry,
    CommandRequest,
)
from mastctl.control.lease import Caller, LeaseTable
from mastctl.control.machine import StandingFault, StateMachine
from mastctl.control.operations import Operation, OperationRunner, last_frame
from mastctl.control.publisher import Topic
from mastctl.devices.cameras import CAMERA_GRACE_S
from mastctl.devices.devices import Devices
from mastctl.devices.frames import OPERATIONS, StampedFrame, check_known, random_run
from mastctl.devices.joint_history import HeadReading
from mastctl.devices.opening import open_rig
from mastctl.drift.handoffs import line_of
from mastctl.drift.journal import JournalThread
from mastctl.drift.watch import DriftWatch
from mastctl.errors import MastctlError, NotNow
from mastctl.motion.jog import Jogs
from mastctl.motion.requests import wrong_camera
from mastctl.motion.track import RoverPose, Tracker, TrackStatus
from mastctl.panorama.compose import drawn
from mastctl.panorama.panoramas import Panoramas
from mastctl.recorder.entries import AttachedMast
from mastctl.recorder.recorder import Recorder
from mastctl.recorder.writer import Attached
from mastctl.safety import stop_socket
from mastctl.safety.latch import Latch
from mastctl.safety.state_folder import StateFolder, head_folders
from mastctl.safety.stop_socket import StopSocket, Verb
from mastctl.service.masts import MastInUse, Masts, read_mast
from mastctl.service.metrics import Metrics
from mastctl.service.places import Targets, places
from mastctl.service.steering import Steering
from mastctl.service.stopping import Stopping, StopThreads, latch_faults

log = logging.getLogger(__name__)

SNAPSHOT_AGE_S = 1.0  # a snapshot that need not be fresh may be this old
SNAPSHOT_TIMEOUT_S = 5.0
RENDERING_S = 20.0  # six simulated cameras share one renderer, on a machine that may be busy
HARDWARE_CLOSE_S = 3.0
RECORDS_FOLDER = "records"
KEPT_PICTURES = 8  # of a camera


class Service:
    """The parts of one daemon; safe to use from any thread.

    ``folder``, where state is kept, and the head's own folder ``head``, where its latch is kept (None for one
    in memory), are closed by `close`, the ``hardware`` too. ``machine`` states what the daemon is doing; its
    publisher gets every change.
    """

    def __init__(
        self,
        config: Config,
        mast: MastInUse,
        hardware: Hardware,
        clock: Clock,
        folder: StateFolder,
        head: StateFolder | None = None,
    ) -> None:
        self.config = config
        self.hardware = hardware
        self.clock = clock
        self.started_s = clock.now_s()
        self._version = version("mastctl")
        self.folder = folder
        self.places = places(folder.path)
        self.head_folder = head
        self.latch = Latch(head or folder, [*head_folders(head_name(config.hardware)), folder.path])
        self.machine = StateMachine(clock, latched=self.latch.entries)
        publisher = self.machine.publisher
        self.journals = JournalThread(clock)
        self._open_head(mast)
        self.targets = Targets(folder.path, self.masts, self.tracker, self.operations)
        publisher.publish("track", "track", self.tracker.status)
        self.stop_threads = StopThreads()
        self.recorder = Recorder(
            config.record,
            config.record.folder or self.folder.path / RECORDS_FOLDER,
            lambda: _attached(self.masts.in_use),
            [Attached(config.path.name, config.data)],
            {"hardware": hardware.kind, "version": self._version},
            publisher,
            self.devices.store.by_id,
            self.event_value,
            clock,
        )
        real_time = SystemClock()  # clients live in it, whatever a simulated rover's clock does
        self.leases = LeaseTable(real_time, self.machine.something_runs, self._steered, self.stopping.stop)
        threading.Thread(target=self.leases.watch, name="leases", daemon=True).start()
        answers, later = Answers(real_time, clock), self.journals.put
        self.entry = CommandEntry(clock, self.leases, answers, self.operations, publisher, folder.path, later)
        self.bench = BenchOperation(
            self.folder.path,
            lambda: self.masts.in_use.path.parent,
            self.leases,
            publisher,
            hardware.kind == "simulated",
        )
        self.metrics = Metrics(
            self.status,
            self.devices.errors,
            self.devices.frame_counts,
            publisher,
            lambda: self.devices.temperatures_c,
        )
        self.devices.watch_faults(self._own_faults)
        self.stop_socket: StopSocket | None = None
        self._socket_folder: StateFolder | None = None
        self._closed = False

    def _open_head(self, mast: MastInUse) -> None:
        """Make what moves the head, and what stops it."""
        config, clock, machine = self.config, self.clock, self.machine
        new_run = _run_names(self.hardware, clock)
        self.devices = Devices(
            self.hardware.pan_tilt,
            self.hardware.cameras,
            config.limits,
            mast.stored.digest,
            clock,
            mast.stored.rig,
            CAMERA_GRACE_S if self.hardware.simulation is None else RENDERING_S,
            new_run,
            config.sun,
            machine,
        )
        self.operations = OperationRunner(self.devices, clock, new_run(), self._ended, machine)
        self.tracker = Tracker(
            self.operations,
            self.devices,
            mast.rig,
            clock,
            config.tracking,
            self._handed_over,
        )
        self.stopping = Stopping(self.devices, self.operations, self.tracker, machine, self.latch)
        self.masts = Masts(config, mast, self.devices, self.operations, machine, self._use_mast)
        self.panoramas = Panoramas(
            self.folder.path,
            self.masts.unchanged,
            lambda: self.masts.in_use.rig,
            self.devices,
            clock,
            self.operations,
        )
        self.drift = DriftWatch(  # which measures at once what it is given
            self.folder.path,
            config.tracking.handoff_log,
            mast.stored,
            self.panoramas.slip,
            self.journals,
            clock,
        )
        self.steering = Steering(
            self.masts,
            self.devices,
            clock,
            self.operations,
            self.tracker,
            self.drift,
            self.panoramas,
            config.repeat_after_s,
        )
        self.jogs = Jogs(
            self.operations,
            self.devices,
            clock,
            self.masts.unchanged,
        )

    @classmethod
    def open(cls, config: Config, clock: Clock | None = None, folder: StateFolder | None = None) -> Service:
        """Read the mast file, open the hardware, and return the running service.

        Raises BadFile if the mast file cannot be used, or lacks a configured camera; DriverError if a driver
        refuses its options or cannot reach its device; StateInUse if another program drives the head.
        """
        clock = clock or clock_for(config.hardware)
        mast = read_mast(config.mast_file, config)
        for note in mast.stored.notes:
            log.warning("%s", note)
        with contextlib.ExitStack() as undo:
            hardware, head = open_rig(config.hardware, clock)
            if head is not None:
                undo.callback(head.close)
            undo.callback(hardware.close)
            kept = folder or StateFolder.temporary()
            if folder is None:
                undo.callback(kept.close)
            with clock.at_work():
                service = cls(config, mast, hardware, clock, kept, head)
                if hardware.simulation is not None:  # as an odometer would
                    pose = RoverPose(hardware.simulation.site_from_rover, received_s=clock.now_s())
                    service.steering.take_pose(pose, look=False)
            undo.pop_all()
        return service

    @property
    def stored(self) -> StoredRig:
        """The mast file in use, as read."""
        return self.masts.in_use.stored

    def status(self) -> Status:
        """Return what is known at this moment, as ``GET /status`` has it."""
        now_s = self.clock.now_s()
        faults = self.devices.faults()  # first: the machine hears of them
        former, reading, track = self.masts.former, self.devices.last_reading, self.tracker.status
        return {
            **self.machine.standing.summary(now_s),
            "simulated": self.hardware.kind == "simulated",
            "hardware": self.hardware.kind,
            "moving": reading is not None and reading.moving,
            "joints": None if reading is None else joints_answer(reading, now_s),
            "axes": {
                name: {"count_rad": axis.count_rad, "one_sided": axis.rising_below_rad is not None}
                for name, axis in self.devices.judge.axes.items()
            },
            "limits": as_json(self.config.limits),
            "pose": None if track.pose is None else track.pose.as_json(now_s),
            "track": {"state": track.state, "reason": track.reason, "id": track.id},
            "control": self.leases.control(),
            "stop_socket": None if self.stop_socket is None else str(self.stop_socket.path),
            "calibration": self.drift.verdict(),
            "sentinel": self.drift.pictures,
            "cameras": {
                name: camera_answer(frame, now_s) for name, frame in self.devices.newest_frames().items()
            },
            "faults": [fault.as_json(now_s) for fault in faults],
            "mast": self.masts.in_use.as_json(),
            "former_mast": None if former is None else former.as_json(),
            "version": self._version,
            "now_s": now_s,
            "uptime_s": now_s - self.started_s,
        }

    def event_value(self, topic: Topic, value: Any) -> Any:
        """Return a published value as events and recordings have it."""
        if topic == "track":
            return self.track_answer(value)
        if topic == "lease":
            return {"control": self.leases.control()}
        return published_value(topic, value, self.clock.now_s())

    def track_answer(self, status: TrackStatus | None = None) -> TrackAnswer:
        """Return the track, as it is or was, as ``GET /track`` has it."""
        return (status or self.tracker.status).as_json(self.clock.now_s())

    def panorama_drawn(self, name: str) -> PanoramaDrawn:
        """Return what is drawn over a panorama; targets only while the rover stands where it was taken.

        Raises NotKnown ``panorama_unknown``, Unable ``unreadable``, NotNow ``no_views``.
        """
        folder, reading = self.panoramas.open(name), self.devices.last_reading
        camera, rig = folder.index.cameras[0], self.stored.rig
        if not folder.index.taken():
            raise NotNow("no_views", f"panorama {name} has no view yet")
        now = rig.camera_in_rover(camera, *reading.true_rad) if reading and camera in rig.cameras else None
        moved_s = self.tracker.moved_s
        stands = moved_s is None or moved_s <= self.panoramas.began_s(name)
        return drawn(folder, now, {k: at for k, at, _ in self.targets.in_rover()} if stands else {})

    def snapshot(self, camera: str, fresh: bool) -> StampedFrame:
        """Return a frame exposed after this call (``fresh``), or one that is at most a second old.

        Raises NotKnown, DriverError: as `mastctl.devices.devices.Devices.frames`.
        """
        now_s = self.clock.now_s()
        after_s = now_s if fresh else now_s - SNAPSHOT_AGE_S
        return self.devices.frames([camera], after_s, SNAPSHOT_TIMEOUT_S)[camera]

    def check_camera(self, camera: str) -> None:
        """Pass a configured camera's name. Raises NotKnown."""
        check_known(camera, self.devices.newest_frames())

    def kept_frame(self, camera: str, frame_id: str) -> StampedFrame:
        """Return a frame that is still kept, by its id.

        Raises NotKnown, NoLonger, NotNow, BadRequest if it is not kept, is of another camera, or there is no
        such camera.
        """
        self.check_camera(camera)
        frame = self.devices.store.by_id(frame_id)
        if frame.camera != camera:
            raise wrong_camera(frame, camera)
        return frame

    def open_stop_socket(self) -> Path:
        """Listen for stops in the state folder, or a temporary one if its name is too long for a socket's.

        Returns the socket's path.
        """
        try:
            self.stop_socket = StopSocket(self.folder.path / stop_socket.FILE, self._stop_by_socket)
        except MastctlError as error:
            log.warning("%s", error)
            self._socket_folder = StateFolder.temporary()
            self.stop_socket = StopSocket(self._socket_folder.path / stop_socket.FILE, self._stop_by_socket)
        return self.stop_socket.path

    def _stop_by_socket(self, verb: Verb, reason: str | None, name: str | None) -> StopAnswer | EstopAnswer:
        """Carry out a stop that came by the socket; return its answer."""
        caller = Caller(role="view", via=stop_socket.VIA)
        if verb == "stop":
            return self.entry.first(STOP, CommandRequest(caller), self.stopping.stop_answer)
        sent = CommandRequest(caller, request={"reason": reason, "name": name})
        return self.entry.first(ESTOP, sent, lambda: self.stopping.estop(reason, name))

    def close(self) -> None:
        """Stop the mast and let go of everything; bounded, never raises."""
        closed, self._closed = self._closed, True
        if closed:
            return
        files = self.journals, self.latch, self.folder, self.head_folder, self._socket_folder
        for close in (
            self.leases.close,
            self.operations.close,
            self.bench.close,
            self.devices.close,
            self.machine.publisher.close,
            self.metrics.close,
            self.recorder.close,
            self._close_hardware,
            self.stop_threads.close,
            *(one.close for one in (self.stop_socket, *files) if one is not None),
        ):
            try:
                close()
            except Exception:  # a defect of one part must not keep the others open
                log.exception("a part of the daemon could not be closed")

    def _close_hardware(self) -> None:
        try:
            self.stop_threads.submit(self.hardware.close).result(HARDWARE_CLOSE_S)
        except TimeoutError:
            log.error("closing the hardware did not end in %.0f s and is left behind", HARDWARE_CLOSE_S)

    # Changes that one part makes in others

    def _own_faults(self) -> tuple[StandingFault, ...]:
        """What is wrong with the daemon's own files; takes no lock."""
        return (
            *self.drift.faults(),
            *self.journals.faults(),
            *self.recorder.faults(),
            *self.entry.faults(),
            *latch_faults(self.latch),
        )

    def _use_mast(self, mast: MastInUse) -> None:
        """Have every part use another mast file."""
        stored = mast.stored
        self.devices.use_rig(stored.rig, stored.digest)
        self.tracker.use_rig(mast.rig, mast.path.name)
        self.drift.use_mast(stored)

    def _steered(self) -> None:
        """Publish which client steers."""
        self.machine.publisher.publish("lease", "lease", self.leases.control())

    def _ended(self, operation: Operation) -> None:
        """Have an operation's end recorded, and its last image kept for later."""
        self.entry.ended(operation.id, operation.state, operation.error)
        frame_id = last_frame(operation.result)
        if frame_id is not None:
            with contextlib.suppress(MastctlError):  # it is gone already: the mast file has changed
                self.devices.store.keep(self.devices.store.by_id(frame_id), OPERATIONS, KEPT_PICTURES)

    def _handed_over(self, handoff: MatchedHandoff) -> None:
        """Have a hand-off counted and recorded."""
        self.drift.handed_over(handoff)
        self.recorder.add_handoff(line_of(handoff))


def camera_answer(frame: StampedFrame | None, now_s: float) -> CameraAnswer:
    """Return the facts of a camera's newest frame."""
    if frame is None:
        return {"frame_id": None, "sequence": None, "exposure_s": None, "age_s": None}
    return {
        "frame_id": frame.frame_id,
        "sequence": frame.sequence,
        "exposure_s": frame.exposure_s,
        "age_s": max(0.0, now_s - frame.mid_exposure_s),
    }


def joints_answer(reading: HeadReading, now_s: float) -> MeasuredJoints:
    """Return a reading of the head."""
    return {
        "pan_rad": reading.pan_rad,
        "tilt_rad": reading.tilt_rad,
        "true_pan_rad": reading.true_rad[0],
        "true_tilt_rad": reading.true_rad[1],
        "pan_approach": reading.approach[0],
        "tilt_approach": reading.approach[1],
        "measured_s": reading.time_s,
        "age_s": max(0.0, now_s - reading.time_s),
    }


def published_value(topic: Topic, value: Any, now_s: float) -> Any:
    """Return a published value as events and recordings have it, but for track and lease."""
    match topic:
        case "state":
            return value.as_json(now_s)
        case "joints":
            return {**joints_answer(value, now_s), "moving": value.moving}
        case "fault":
            return [one.as_json(now_s) for one in value]
        case "frame":
            return as_json(value) | {"age_s": max(0.0, now_s - value.mid_exposure_s)}
        case "operation":
            return value.as_json()
        case "command":  # without the key, by which others would get the answer, and a lease with it
            return {name: one for name, one in value.items() if name != "key"}
        case _:
            return value


def _attached(mast: MastInUse) -> AttachedMast:
    """A mast file as a recording has it."""
    return AttachedMast(mast.stored.rig, Attached(mast.path.name, mast.data))


def _run_names(hardware: Hardware, clock: Clock) -> Callable[[], str]:
    """Return what makes a part of ids: random, or the same ones in every run that shall be the same."""
    simulation = hardware.simulation
    if simulation is None or not isinstance(clock, SimulationClock) or math.isfinite(clock.speed):
        return random_run
    seeded = random.Random(simulation.settings.camera.seed)
    return lambda: f"{seeded.getrandbits(16):04x}"

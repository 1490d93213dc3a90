"""What a daemon holds, from the configuration to the last operation, without any web in it."""

from __future__ import annotations

import logging
import math
import random
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, replace
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np

from calib.files.mast_file import StoredRig
from calib.handoff.matched import MatchedHandoff
from drivers.clock import Clock, SystemClock
from drivers.errors import DriverError
from drivers.hardware import Hardware
from drivers.open_hardware import clock_for, open_hardware
from drivers.simulation_clock import SimulationClock
from mastctl.commands.audit import AuditLog
from mastctl.commands.entry import Entry
from mastctl.commands.idempotency import Answers
from mastctl.commands.lease import Control, Leases
from mastctl.config import Config
from mastctl.devices.devices import Devices
from mastctl.devices.frames import StampedFrame, check_known, random_run
from mastctl.errors import MastctlError, NotNow, Unable
from mastctl.handoff.check import HandoffCheck
from mastctl.health.health import CalibrationHealth
from mastctl.live.settings import LiveSettings
from mastctl.live.view import LiveView, check_installed
from mastctl.metrics.metrics import Metrics
from mastctl.operations.operations import STOP_ASKED, Operations
from mastctl.operations.records import Operation
from mastctl.pointing.jog import Jogs
from mastctl.pointing.loop import PointingLoop
from mastctl.pointing.requests import AnglesTarget, PixelTarget, PointRequest, PositionTarget
from mastctl.pointing.wanted import aim_of, clicked_frame, wrong_camera
from mastctl.safety import stop_socket
from mastctl.safety.latch import Held, Latch
from mastctl.safety.state_folder import StateFolder
from mastctl.safety.stop_socket import StopSocket
from mastctl.safety.stop_threads import StopThreads
from mastctl.service.mast_in_use import MastInUse, configured, read_mast, read_next
from mastctl.service.recording import Recording
from mastctl.service.socket_stops import SocketStops
from mastctl.service.state import State
from mastctl.state.faults import StandingFault
from mastctl.state.machine import Machine
from mastctl.state.refusals import Need
from mastctl.state.standing import Latched
from mastctl.tracking.pose import RoverPose
from mastctl.tracking.status import ACTIVE, TrackStatus
from mastctl.tracking.tracker import Tracker

log = logging.getLogger(__name__)

CLICK_AGE_S = 300.0  # a person may look at a picture for minutes before clicking; the sun moves meanwhile
SNAPSHOT_AGE_S = 1.0  # a snapshot that need not be fresh may be this old
SNAPSHOT_TIMEOUT_S = 5.0
RENDERING_S = 20.0  # six simulated cameras share one renderer, on a machine that may be busy
HARDWARE_CLOSE_S = 3.0
KEPT_S = 1.0  # what the disk is given before an emergency stop is answered without it
STATE = "state"
AUDIT_FILE = "audit.jsonl"
KEPT_COMMANDS = 100  # the newest ones, which a new listener still hears of


class Service:
    """The devices, the pointing loop and the operations of one daemon; safe to use from any thread.

    Parameters
    ----------
    config
        The configuration.
    mast
        The mast file that the configuration names.
    hardware
        The opened drivers; closed by `close`.
    clock
        The clock that stamps everything.
    folder
        Where state is kept, closed by `close`; a temporary one by default.

    Attributes
    ----------
    mast, former
        The mast file in use, and the one before it; replaced as a whole, never edited.
    machine
        What the daemon is doing; its publisher tells every change.
    tracker
        The track, and the rover's pose.
    jogs
        Takes the heartbeats of jogs.
    handoffs
        What the track's hand-offs say of the mast file in use.
    health
        What the pointings' residuals say of it.
    entry, leases, audit
        Where each command passes, who steers, and what is recorded of it.
    metrics
        What is counted, for Prometheus.
    stop_threads
        Where the web side calls `stop`: threads that nothing else can keep busy.
    recording
        The recorder, and what it hears.
    live
        What Foxglove shows, if the configuration asks for it.
    latch
        The emergency stop, if one is latched.
    folder
        Where state is kept that outlives the daemon.
    stop_socket
        The Unix socket for stops alone, once `open_stop_socket` was called.
    """

    def __init__(
        self,
        config: Config,
        mast: MastInUse,
        hardware: Hardware,
        clock: Clock,
        folder: StateFolder | None = None,
    ) -> None:
        self.config = config
        self.mast = mast
        self.former: MastInUse | None = None
        self._mast_lock = threading.Lock()  # no operation starts between one mast file and the next
        self.hardware = hardware
        self.clock = clock
        self.started_s = clock.now_s()
        grace_s = None if hardware.simulation is None else RENDERING_S
        new_run = _run_names(hardware, clock)
        self.folder = folder or StateFolder.temporary()
        self.latch = Latch(self.folder)
        self.machine = Machine(clock, latch=_latched(self.latch.held))
        self.machine.publisher.publish("mast", "in_use", mast.told())
        self.devices = Devices(
            hardware,
            config.limits,
            mast.stored.digest,
            clock,
            mast.stored.rig,
            grace_s,
            new_run,
            config.sun,
            self.machine,
        )
        self.operations = Operations(self.devices, clock, new_run(), self._ended, self.machine)
        if self.latch.held is not None:
            self.devices.block_moves(self.latch.held, self.latch.held.refusal())
        self.stop_threads = StopThreads()
        self._rig = configured(mast.stored.rig, config.hardware.cameras)
        self._loop = PointingLoop(self._rig, self.devices, config.limits, clock)
        self.jogs = Jogs(self.operations, self.devices, clock)
        self.handoffs = HandoffCheck(config.tracking.handoff_log, mast.stored.digest, clock)
        self.health = CalibrationHealth(self.folder.path, mast.stored)
        self.tracker = Tracker(
            self.operations,
            self.devices,
            self._rig,
            config.limits,
            clock,
            config.tracking,
            self._handed_over,
            self.machine,
        )
        self.machine.publisher.publish("track", "track", self.tracker.status)
        people_s = SystemClock()  # clients live in real time, whatever a simulated rover's clock does
        self.leases = Leases(people_s, self._runs, self._steered)
        self.audit = AuditLog(self.folder.path / AUDIT_FILE, clock)
        self.entry = Entry(
            clock,
            self.leases,
            Answers(people_s, clock),
            self.audit,
            self.operations,
            self,
            self._commanded,
        )
        self.metrics = Metrics(lambda: self.state().told(), self.devices.errors, self.machine.publisher)
        self._version = version("mastctl")
        self.recording = Recording(
            config,
            mast,
            hardware.kind,
            self._version,
            self.folder.path,
            self.machine.publisher,
            self.devices.frame_by_id,
            clock,
        )
        self.live = None if config.live is None else self._live_view(config.live)
        self.stop_socket: StopSocket | None = None
        self._socket_folder: StateFolder | None = None
        self._closing = threading.Lock()
        self._latch_lock = threading.Lock()
        self._closed = False

    @classmethod
    def open(cls, config: Config, clock: Clock | None = None, folder: StateFolder | None = None) -> Service:
        """Read the mast file, open the hardware, and return the running service.

        Raises
        ------
        BadFile
            If the mast file cannot be used, or lacks a configured camera.
        DriverError
            If a driver refuses its options or cannot reach its device.
        Unable
            ``no_foxglove`` if a live view is asked for, and what shows it is not installed.
        """
        clock = clock or clock_for(config.hardware)
        mast = read_mast(config.mast_file, config)
        for note in mast.stored.notes:
            log.warning("%s", note)
        if config.live is not None:
            check_installed()
        hardware = open_hardware(config.hardware, clock)
        try:
            with clock.at_work():
                return cls(config, mast, hardware, clock, folder)
        except BaseException:
            hardware.close()
            raise

    @property
    def stored(self) -> StoredRig:
        """The mast file in use, as read."""
        return self.mast.stored

    def state(self) -> State:
        """Return what is known at this moment."""
        mast, former = self.mast, self.former
        faults = (
            *self.devices.faults(),
            *self.handoffs.faults(),
            *self.recording.faults(),
            *(() if self.live is None else self.live.faults()),
            *self.audit.faults(),
            *self._state_faults(),
        )  # first: the machine is told of them
        return State(
            now_s=self.clock.now_s(),
            started_s=self.started_s,
            version=self._version,
            hardware=self.hardware.kind,
            mast=mast.told(),
            former_mast=None if former is None else former.told(),
            limits=self.config.limits,
            reading=self.devices.last_reading,
            frames=self.devices.newest_frames(),
            standing=self.machine.standing,
            track=self.tracker.status,
            faults=faults,
            control=self.leases.told(),
            calibration=self.health.verdict.told(),
            stop_socket=None if self.stop_socket is None else str(self.stop_socket.path),
        )

    def track_told(self, status: TrackStatus | None = None) -> dict[str, Any]:
        """Return the track, as it is or was, and the self-check of now as ``GET /track`` tells them."""
        told = (status or self.tracker.status).told(self.clock.now_s())
        return {**told, "self_check": self.handoffs.told()}

    def snapshot(self, camera: str, fresh: bool) -> StampedFrame:
        """Return a frame exposed after this call (``fresh``), or one that is at most a second old.

        Raises
        ------
        NotKnown, DriverError
            As `mastctl.devices.devices.Devices.frames`.
        """
        now_s = self.clock.now_s()
        after_s = now_s if fresh else now_s - SNAPSHOT_AGE_S
        return self.devices.frames([camera], after_s, SNAPSHOT_TIMEOUT_S)[camera]

    def check_camera(self, camera: str) -> None:
        """Pass a configured camera's name. Raises NotKnown."""
        check_known(camera, self.devices.newest_frames())

    def kept_frame(self, camera: str, frame_id: str) -> StampedFrame:
        """Return a frame that is still kept, by its id.

        Raises
        ------
        NotKnown, NoLonger, NotNow, BadRequest
            If it is not kept, is of another camera, or there is no such camera.
        """
        self.check_camera(camera)
        frame = self.devices.frame_by_id(frame_id)
        if frame.camera != camera:
            raise wrong_camera(frame, camera)
        return frame

    def point(self, request: PointRequest, told: Mapping[str, Any]) -> Operation:
        """Start a pointing operation and return its first record.

        Parameters
        ----------
        request
            What to point at.
        told
            The request as it came, for the record.

        Raises
        ------
        NotKnown, NoLonger, BadRequest
            If camera, frame, pixel or joint angles do not fit this rig.
        NotNow
            If the frame is of another mast file, head or rover moved since, or another operation runs.
        """
        self._refuse_if_latched()
        with self._mast_lock:
            if isinstance(request.target, PositionTarget):
                request = replace(request, target=self._in_rover(request.target))
            self._check(request)
            loop = self._loop

            def run(record: Callable[[Any], None], cancelled: threading.Event) -> Any:
                with self.devices.exposure_held():
                    return loop.run(request, record, cancelled)

            return self.operations.start(told, run, partial(self.health.ended, self.stored))

    def start_track(self, target: PixelTarget | PositionTarget, told: Mapping[str, Any]) -> Operation:
        """Begin to follow what a pixel shows, or what is seen at a position; return the start's record.

        Raises
        ------
        NotKnown, NoLonger, BadRequest, NotNow
            As for `point`; ``busy`` also while a track runs.
        """
        self._refuse_if_latched()
        with self._mast_lock:
            if isinstance(target, PositionTarget):
                target = self._in_rover(target)
            self._check(PointRequest(target))
            return self.tracker.start(target, told)

    def take_pose(self, pose: RoverPose, look: bool) -> str | None:
        """Take where the rover stands; return the id of the look that follows, if one does.

        Raises
        ------
        BadRequest, NotNow
            As `mastctl.tracking.tracker.Tracker.take_pose`.
        """
        with self._mast_lock:
            taken = self.tracker.take_pose(pose, look)
            self.devices.door.rover_stands(pose.site_from_rover.inverse.rotation)
            return taken

    def look_for_target(self) -> Operation:
        """Look for the track's target once more and return the look's first record.

        Raises
        ------
        NotNow, Unable
            As `mastctl.tracking.tracker.Tracker.look`.
        """
        self._refuse_if_latched()
        with self._mast_lock:
            return self.tracker.look()

    def stop_track(self) -> None:
        """End the track, and stop the mast if it moves for it. Raises DriverError."""
        running = self.tracker.status.operation
        if running is not None and self.machine.standing.operation == running:
            self.operations.stop()  # the head first
        running = self.tracker.stop("the track was stopped")
        if running is not None and self.machine.standing.operation == running:
            self.operations.stop()

    def load_mast(self, name: str) -> MastInUse:
        """Use another mast file of the configured one's folder from now on, and return it.

        Frames taken before are refused from then on. The file before it stays at hand for `former_mast`.

        Raises
        ------
        BadMastFile
            If it cannot be used; nothing has changed.
        NotNow
            ``busy``, ``moving``: if an operation runs or the head moves.
        DriverError
            If the head does not say whether it moves.
        """
        return self._use(read_next(name, self.config, self.mast))

    def former_mast(self) -> MastInUse:
        """Go back to the mast file that was in use before, as it was then; the second time forth again.

        Raises
        ------
        NotNow, DriverError
            ``no_former_mast`` if none was loaded since the start; else as for `load_mast`.
        """
        former = self.former
        if former is None:
            raise NotNow("no_former_mast", "no other mast file was in use since the daemon started")
        return self._use(former)

    def _use(self, mast: MastInUse) -> MastInUse:
        """Put a mast file into use while the head rests and nothing runs."""
        self.devices.read()  # the machine knows whether the head moves now
        with self._mast_lock:
            refusal = self.refusal("rest")
            if refusal is not None:
                raise refusal
            self.devices.use_rig(mast.stored.rig, mast.stored.digest)
            self._rig = configured(mast.stored.rig, self.config.hardware.cameras)
            self._loop = PointingLoop(self._rig, self.devices, self.config.limits, self.clock)
            self.tracker.use_rig(self._rig, mast.path.name)
            self.handoffs.use_mast(mast.stored.digest)
            self.health.use_mast(mast.stored)
            self.recording.use_mast(mast)
            if self.live is not None:
                self.live.use_mast(mast.stored.rig, mast.stored.digest)
            self.mast, self.former = mast, self.mast
            self.machine.publisher.publish("mast", "in_use", mast.told())
        for note in mast.stored.notes:
            log.warning("%s", note)
        log.info("mast file %s (%s) is in use", mast.path.name, mast.stored.digest[:12])
        return mast

    def _check(self, request: PointRequest) -> None:
        """Refuse a request that does not fit the mast file in use; see `point`."""
        target = request.target
        if isinstance(target, PixelTarget):
            self._check_pixel(target)
        if isinstance(target, AnglesTarget):
            self.devices.door.check_goal(target.pan_rad, target.tilt_rad)
        if request.aim is not None:
            aim_of(request, self._rig)

    def _in_rover(self, target: PositionTarget) -> PositionTarget:
        """A position in the rover frame of now; before the first pose that is the site frame."""
        pose = self.tracker.pose
        if target.frame != "site" or pose is None:
            return target
        x, y, z = pose.site_from_rover.inverse.points(np.array(target.position_m)).tolist()
        return PositionTarget((x, y, z), "rover")

    def stop(self, reason: str = STOP_ASKED) -> str | None:
        """Stop the mast, then what runs and the track; return the stopped operation's id. Raises DriverError.

        Nothing comes before the head: no log, no file, and no lock that is held for longer than a read.
        """
        with self.operations.held():  # until the track has ended too, which would look again
            try:
                stopped = self.operations.stop(reason)
            finally:
                self.tracker.stop(reason)
        return stopped

    def estop(self, reason: str | None = None, name: str | None = None) -> dict[str, Any]:
        """Stop the mast, and let nothing move it before `reset`, across restarts too.

        The head first; then what runs and the track end; then it is told whether the disk holds the stop.

        Returns
        -------
        dict
            As ``POST /estop`` tells it: ``latched``, ``kept`` (a restart would find it; else ``message`` says
            why not), ``operation``, and ``reason``, ``name`` and ``at`` of the stop that is latched.

        Raises
        ------
        Unable
            ``stop_unconfirmed`` if the head did not confirm; the stop is latched all the same.
        """
        stopped, unconfirmed = None, None
        with self.operations.held():
            held = self.latch_estop(reason, name)
            try:
                stopped = self.stop(f"an emergency stop: {held.reason} ({held.name})")
            except (DriverError, MastctlError) as error:
                unconfirmed = error
        self.latch.head_told()
        kept = self.latch.kept_within(KEPT_S)
        why = "" if kept else f"it would not survive a restart of the daemon: {self.latch.not_kept}"
        if unconfirmed is not None:
            words = f"the emergency stop is latched, but the head did not confirm it: {unconfirmed}"
            raise Unable("stop_unconfirmed", f"{words}; {why}" if why else words)
        told = {"stopped": True, "latched": True, "kept": kept, "operation": stopped, **asdict(held)}
        return told | ({"message": why} if why else {})

    def latch_estop(self, reason: str | None, name: str | None) -> Held:
        """Let no move out from now on; the head is told by `estop`. Returns the stop that is latched."""
        self.machine.stop_asked()
        try:
            held = self.latch.hold(reason, name)
            self.machine.estop_asked(Latched(**asdict(held)))
            self.devices.block_moves(held, held.refusal())
        finally:
            self.machine.stop_ended()
        return held

    def stop_told(self) -> dict[str, Any]:
        """Stop as `stop`; return what ``POST /stop`` tells."""
        return {"stopped": True, "operation": self.stop()}

    def refusal(self, need: Need) -> MastctlError | None:
        """Return why a command may not be carried out now, as `mastctl.state.machine.Machine.refusal`.

        What a stop has ended may end first.
        """
        self.operations.let_stopped_end()
        return self.machine.refusal(need)

    def open_stop_socket(self) -> None:
        """Listen for stops in the state folder, or a temporary one if its name is too long for a socket's."""
        try:
            self.stop_socket = StopSocket(self.folder.path / stop_socket.FILE, SocketStops(self))
        except MastctlError as error:
            log.warning("%s", error)
            self._socket_folder = StateFolder.temporary()
            self.stop_socket = StopSocket(self._socket_folder.path / stop_socket.FILE, SocketStops(self))

    def reset(self, reason: str, name: str) -> Held:
        """Release the emergency stop and return it; nothing moves before the next command.

        Raises
        ------
        NotNow
            ``not_estopped`` if none is latched, ``stopping`` while a stop is under way.
        Unable
            ``not_saved`` if the state folder goes on to say that it is latched; ``closing``.
        """
        refusal = self.refusal("latch")
        if refusal is not None:
            raise refusal
        if self.devices.stop_pending:
            raise NotNow("stopping", "the mast is being stopped; an emergency stop is released after that")
        with self._latch_lock:
            held = self.latch.release(reason, name)
            self.devices.allow_moves(held)  # and not what another one blocks that came meanwhile
            self.machine.reset(name, reason, lambda: _latched(self.latch.held))
        return held

    def _refuse_if_latched(self) -> None:
        """Raises Estopped."""
        held = self.latch.held
        if held is not None:
            raise held.refusal()

    def _state_faults(self) -> Iterator[StandingFault]:
        """What keeps state from outliving the daemon, where it should."""
        if self.folder.why_temporary:
            words = f"nothing outlives this daemon, an emergency stop above all: {self.folder.why_temporary}"
            yield StandingFault(
                STATE, "state_not_kept", words, self.started_s, "the daemon has a state folder"
            )
        elif self.folder.refused and self.latch.held is None:
            words = f"an emergency stop would not survive a restart: {self.folder.refused}"
            yield StandingFault(STATE, "state_not_kept", words, self.started_s, "the daemon is started again")
        elif self.latch.not_kept and not self.folder.is_temporary:
            words = f"the emergency stop is held in memory only: {self.latch.not_kept}"
            yield StandingFault(
                STATE, "latch_not_kept", words, self.latch.since_s, "the disk takes it, or a reset"
            )

    def close(self) -> None:
        """Stop the mast and let go of everything; bounded, never raises."""
        with self._closing:
            if self._closed:
                return
            self._closed = True
        self.operations.close()
        self.devices.close()
        self.machine.publisher.close()
        self.metrics.close()
        self.stop_threads.close()
        self.handoffs.close()
        self.health.close()
        self.recording.close()
        if self.live is not None:
            self.live.close()
        _bounded("closing the hardware", self.hardware.close, HARDWARE_CLOSE_S)
        if self.stop_socket is not None:
            self.stop_socket.close()
        self.audit.close()
        self.latch.close()
        for folder in (self.folder, self._socket_folder):
            if folder is not None:
                folder.close()

    def _live_view(self, settings: LiveSettings) -> LiveView:
        stored, names = self.stored, tuple(self.hardware.cameras)
        return LiveView(
            settings, stored.rig, stored.digest, names, self.machine.publisher, self.devices, self.clock
        )

    def _runs(self) -> bool:
        """Whether an operation or a track runs; takes no lock."""
        return self.operations.running is not None or self.tracker.status.state in ACTIVE

    def _steered(self, control: Control | None) -> None:
        """Publish who holds the lease."""
        told = None if control is None else asdict(control)
        self.machine.publisher.publish("lease", "lease", told)

    def _commanded(self, number: int, record: Mapping[str, Any]) -> None:
        """Publish a command's record, or how what it began has ended."""
        publisher, end = self.machine.publisher, ".ended" if "ended" in record else ""
        publisher.publish("command", f"{number}{end}", record)
        publisher.forget("command", f"{number - KEPT_COMMANDS}{end}")

    def _ended(self, operation: Operation) -> None:
        """Have an operation's end recorded."""
        self.entry.ended(operation.id, operation.state, operation.error)

    def _handed_over(self, handoff: MatchedHandoff) -> None:
        """Have a hand-off counted and recorded."""
        self.handoffs.add(handoff)
        self.recording.handed_over(handoff)

    def _check_pixel(self, target: PixelTarget) -> None:
        taken_with, in_use = target.mast_digest, self.stored.digest
        if taken_with not in (None, in_use):
            words = f"the pixel was taken with mast file {taken_with:.8}..., the one in use is {in_use:.8}..."
            raise NotNow("other_mast_file", words)
        find = partial(self.devices.frame_by_id, max_age_s=CLICK_AGE_S)
        frame = clicked_frame(target, self._rig, find, self.stored.rig)
        moved_s = self.tracker.moved_s
        if moved_s is not None and frame.exposure_began_s < moved_s:
            words = f"the rover moved since frame {target.frame_id} was exposed; take another"
            raise NotNow("rover_moved", words)


def _latched(held: Held | None) -> Latched | None:
    """What the machine is told of an emergency stop that was found."""
    return None if held is None else Latched(**asdict(held))


def _bounded(what: str, function: Callable[[], None], timeout_s: float) -> None:
    """Run something that may hang or raise; go on after ``timeout_s`` seconds at the latest."""

    def run() -> None:
        try:
            function()
        except Exception:  # the last thing done with a driver; nothing is left to protect but the exit
            log.exception("%s failed", what)

    thread = threading.Thread(target=run, name=what, daemon=True)
    thread.start()
    thread.join(timeout_s)
    if thread.is_alive():
        log.error("%s did not end within %.0f s and is left behind", what, timeout_s)


def _run_names(hardware: Hardware, clock: Clock) -> Callable[[], str]:
    """What makes a part of ids: random words, or the same ones every time where a run shall be the same."""
    simulation = hardware.simulation
    if simulation is None or not isinstance(clock, SimulationClock) or math.isfinite(clock.speed):
        return random_run
    seeded = random.Random(simulation.settings.camera.seed)
    return lambda: f"{seeded.getrandbits(16):04x}"

"""What a daemon holds, from the configuration to the last operation, without any web in it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from importlib.metadata import version
from typing import Any

from calib.errors import CalibError
from calib.files.mast_file import StoredRig
from calib.mast.covariance import stored_covariance
from calib.mast.rig import Rig
from drivers.clock import Clock, SystemClock
from drivers.open_hardware import Hardware, open_hardware
from mastctl.config import Config
from mastctl.devices.devices import HEAD, Devices, UnknownCamera
from mastctl.devices.frames import StampedFrame
from mastctl.errors import FrameGone, MastctlError
from mastctl.handoff.check import HandoffCheck
from mastctl.operations import STOP_ASKED, Busy, Operation, Operations
from mastctl.pointing.loop import PointingLoop
from mastctl.pointing.requests import Aim, AnglesTarget, PixelTarget, PointRequest, PositionTarget
from mastctl.pointing.wanted import position_in_rover_m
from mastctl.service.mast_in_use import MastInUse, read_mast, read_next
from mastctl.service.state import State
from mastctl.service.stop_threads import StopThreads
from mastctl.tracking.pose import RoverPose
from mastctl.tracking.status import TrackStatus
from mastctl.tracking.tracker import Tracker

log = logging.getLogger(__name__)

CLICK_AGE_S = 300.0  # a person may look at a picture for minutes before clicking; the sun moves meanwhile
SNAPSHOT_AGE_S = 1.0  # a snapshot that need not be fresh may be this old
SNAPSHOT_TIMEOUT_S = 5.0
RENDERING_S = 20.0  # six simulated cameras share one renderer, on a machine that may be busy
HARDWARE_CLOSE_S = 3.0
ENDS_SOON_S = 0.25  # a stopped operation ends within 20 ms or so; then the next one may follow at once


class Refused(MastctlError):
    """A request that makes no sense for this rig; ``code`` names why."""

    def __init__(self, code: str, message: str) -> None:
        self.code = code
        super().__init__(message)


class NoFormerMast(MastctlError):
    """There is no former mast file to go back to."""

    code = "no_former_mast"


class HeadMoves(MastctlError):
    """Something that needs a head at rest was asked for while it moves."""

    code = "moving"


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

    Attributes
    ----------
    mast, former
        The mast file in use, and the one before it; replaced as a whole, never edited.
    tracker
        The track, and the rover's pose.
    handoffs
        What the track's hand-offs say of the mast file in use.
    stop_threads
        Where the web side calls `stop`: threads that nothing else can keep busy.
    """

    def __init__(self, config: Config, mast: MastInUse, hardware: Hardware, clock: Clock) -> None:
        self.config = config
        self.mast = mast
        self.former: MastInUse | None = None
        self._mast_lock = threading.Lock()  # no operation starts between one mast file and the next
        self.hardware = hardware
        self.clock = clock
        self.started_s = clock.now_s()
        grace_s = None if hardware.simulation is None else RENDERING_S
        self.devices = Devices(hardware, config.limits, mast.stored.digest, clock, mast.stored.rig, grace_s)
        self.operations = Operations(self.devices, clock)
        self.stop_threads = StopThreads()
        self._rig = _configured(mast.stored.rig, config.hardware.cameras)
        self._loop = PointingLoop(self._rig, self.devices, config.limits, clock)
        self.handoffs = HandoffCheck(config.tracking.handoff_log, mast.stored.digest, clock)
        self.tracker = Tracker(
            self.operations,
            self.devices,
            self._rig,
            config.limits,
            clock,
            config.tracking,
            self.handoffs.add,
        )
        self._version = version("mastctl")
        self._closing = threading.Lock()
        self._closed = False

    @classmethod
    def open(cls, config: Config, clock: Clock | None = None) -> Service:
        """Read the mast file, open the hardware, and return the running service.

        Raises
        ------
        BadFile
            If the mast file cannot be used, or lacks a configured camera.
        DriverError
            If a driver refuses its options or cannot reach its device.
        """
        clock = clock or SystemClock()
        mast = read_mast(config.mast_file, config)
        for note in mast.stored.notes:
            log.warning("%s", note)
        hardware = open_hardware(config.hardware, clock)
        try:
            return cls(config, mast, hardware, clock)
        except BaseException:
            hardware.close()
            raise

    @property
    def stored(self) -> StoredRig:
        """The mast file in use, as read."""
        return self.mast.stored

    @property
    def head(self) -> str:
        """The name under which the head's faults stand."""
        return HEAD

    def state(self) -> State:
        """Return what is known at this moment."""
        mast, former = self.mast, self.former
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
            motion=self.operations.motion,
            track=self.tracker.status,
            faults=(*self.devices.faults(), *self.handoffs.faults()),
        )

    def track_told(self, status: TrackStatus | None = None) -> dict[str, Any]:
        """Return the track, as it is or was, and the self-check of now as ``GET /track`` tells them."""
        told = (status or self.tracker.status).told(self.clock.now_s())
        return {**told, "self_check": self.handoffs.told()}

    def snapshot(self, camera: str, fresh: bool) -> StampedFrame:
        """Return a frame exposed after this call (``fresh``), or one that is at most a second old.

        Raises
        ------
        UnknownCamera, DriverError
            As `mastctl.devices.devices.Devices.frames`.
        """
        now_s = self.clock.now_s()
        after_s = now_s if fresh else now_s - SNAPSHOT_AGE_S
        return self.devices.frames([camera], after_s, SNAPSHOT_TIMEOUT_S)[camera]

    def check_camera(self, camera: str) -> None:
        """Pass a configured camera's name. Raises UnknownCamera."""
        known = self.devices.newest_frames()
        if camera not in known:
            words = ", ".join(sorted(known)) or "none"
            raise UnknownCamera(f"camera {camera[:80]} is not configured; configured are {words}")

    def kept_frame(self, camera: str, frame_id: str) -> StampedFrame:
        """Return a frame that is still kept, by its id.

        Raises
        ------
        FrameGone, Refused, UnknownCamera
            If it is not kept, is of another camera, or there is no such camera.
        """
        self.check_camera(camera)
        frame = self.devices.frame_by_id(frame_id)
        if frame.camera != camera:
            raise Refused("wrong_camera", f"frame {frame_id} is of camera {frame.camera}, not of {camera}")
        return frame

    def point(
        self, request: PointRequest, told: Mapping[str, Any], mast_digest: str | None = None
    ) -> Operation:
        """Start a pointing operation and return its first record.

        Parameters
        ----------
        request
            What to point at.
        told
            The request as it came, for the record.
        mast_digest
            The mast file that the client took the pixel by, if it says so.

        Raises
        ------
        FrameGone
            If the clicked frame is unknown, too old, or of another mast file.
        OutsideLimits
            If joint angles were asked for that may not be commanded.
        Refused
            If a camera or pixel does not fit this rig, or the head moved while the frame was exposed.
        Busy
            If another operation runs.
        """
        with self._mast_lock:
            if isinstance(request.target, PositionTarget):
                request = replace(request, target=self._in_rover(request.target))
            self._check(request, mast_digest)
            loop = self._loop

            def run(record: Callable[[Any], None], cancelled: threading.Event) -> Any:
                with self.devices.exposure_held():
                    return loop.run(request, record, cancelled)

            return self.operations.start(told, run)

    def start_track(
        self, target: PixelTarget | PositionTarget, told: Mapping[str, Any], mast_digest: str | None = None
    ) -> Operation:
        """Begin to follow what a pixel shows, or what is seen at a position; return the start's record.

        Raises
        ------
        TrackRuns, Busy
            If a track or another operation runs.
        FrameGone, Refused
            As for `point`.
        """
        with self._mast_lock:
            if isinstance(target, PositionTarget):
                target = self._in_rover(target)
            self._check(PointRequest(target), mast_digest)
            return self.tracker.start(target, told)

    def take_pose(self, pose: RoverPose, look: bool) -> str | None:
        """Take where the rover stands; return the id of the look that follows, if one does.

        Raises
        ------
        PoseRefused
            As `mastctl.tracking.tracker.Tracker.take_pose`.
        """
        with self._mast_lock:
            return self.tracker.take_pose(pose, look)

    def look_for_target(self) -> Operation:
        """Look for the track's target once more and return the look's first record.

        Raises
        ------
        NoTrack, Busy
            As `mastctl.tracking.tracker.Tracker.look`.
        """
        with self._mast_lock:
            return self.tracker.look()

    def stop_track(self) -> None:
        """End the track, and stop the mast if it moves for it. Raises DriverError."""
        running = self.tracker.status.operation
        if running is not None and self.operations.motion.operation == running:
            self.operations.stop()  # the head first
        running = self.tracker.stop("the track was stopped")
        if running is not None and self.operations.motion.operation == running:
            self.operations.stop()

    def load_mast(self, name: str) -> MastInUse:
        """Use another mast file of the configured one's folder from now on, and return it.

        Frames taken before are refused from then on. The file before it stays at hand for `former_mast`.

        Raises
        ------
        BadMastFile
            If it cannot be used; nothing has changed.
        Busy, HeadMoves
            If an operation runs or the head moves.
        DriverError
            If the head does not say whether it moves.
        """
        return self._use(read_next(name, self.config, self.mast))

    def former_mast(self) -> MastInUse:
        """Go back to the mast file that was in use before, as it was then; the second time forth again.

        Raises
        ------
        NoFormerMast
            If none was loaded since the start.
        Busy, HeadMoves, DriverError
            As for `load_mast`.
        """
        former = self.former
        if former is None:
            raise NoFormerMast("no other mast file was in use since the daemon started")
        return self._use(former)

    def _use(self, mast: MastInUse) -> MastInUse:
        """Put a mast file into use while the head rests and nothing runs."""
        reading = self.devices.read()
        with self._mast_lock:
            running = self.operations.motion.operation
            if running is not None:
                raise Busy(running)
            if reading.moving:
                raise HeadMoves("the head moves; a mast file is changed while it rests")
            self.devices.use_rig(mast.stored.rig, mast.stored.digest)
            self._rig = _configured(mast.stored.rig, self.config.hardware.cameras)
            self._loop = PointingLoop(self._rig, self.devices, self.config.limits, self.clock)
            self.tracker.use_rig(self._rig, mast.path.name)
            self.handoffs.use_mast(mast.stored.digest)
            self.mast, self.former = mast, self.mast
        for note in mast.stored.notes:
            log.warning("%s", note)
        log.info("mast file %s (%s) is in use", mast.path.name, mast.stored.digest[:12])
        return mast

    def _check(self, request: PointRequest, mast_digest: str | None) -> None:
        """Refuse a request that does not fit the mast file in use; see `point`."""
        target = request.target
        if mast_digest is not None and mast_digest != self.stored.digest:
            raise FrameGone(
                "other_mast_file",
                f"the pixel was taken with mast file {mast_digest[:8]}..., "
                f"the one in use is {self.stored.digest[:8]}...",
            )
        if isinstance(target, PixelTarget):
            self._check_pixel(target)
        if isinstance(target, AnglesTarget):
            self.config.limits.check(target.pan_rad, target.tilt_rad)
        if request.aim is not None:
            self._check_aim(request.aim)

    def _in_rover(self, target: PositionTarget) -> PositionTarget:
        """A position in the rover frame of now; before the first pose that is the site frame."""
        pose = self.tracker.pose
        if target.frame != "site" or pose is None:
            return target
        x, y, z = pose.site_from_rover.inverse.points(position_in_rover_m(target)).tolist()
        return PositionTarget((x, y, z), "rover")

    def stop(self) -> str | None:
        """Stop the mast, then what runs and the track; return the stopped operation's id. Raises DriverError.

        Nothing comes before the head: no log, no file, and no lock that is held for longer than a read.
        """
        with self.operations.held():  # until the track has ended too, which would look again
            try:
                stopped = self.operations.stop()
            finally:
                self.tracker.stop(STOP_ASKED)
        if stopped is not None:
            self.operations.wait_ended(stopped, ENDS_SOON_S)
        return stopped

    def close(self) -> None:
        """Stop the mast and let go of everything; bounded, never raises."""
        with self._closing:
            if self._closed:
                return
            self._closed = True
        self.operations.close()
        self.devices.close()
        self.stop_threads.close()
        self.handoffs.close()
        _bounded("closing the hardware", self.hardware.close, HARDWARE_CLOSE_S)

    def _check_pixel(self, target: PixelTarget) -> None:
        if target.camera not in self._rig.cameras:
            known = ", ".join(self._rig.cameras) or "none"
            raise UnknownCamera(f"camera {target.camera[:80]} is not configured; configured are {known}")
        self._check_pair(target.camera)
        frame = self.devices.frame_by_id(target.frame_id, CLICK_AGE_S)
        if frame.camera != target.camera:
            words = f"frame {target.frame_id} is of camera {frame.camera}, not of {target.camera}"
            raise Refused("wrong_camera", words)
        if frame.moving:
            words = f"the head moved while frame {target.frame_id} was exposed; take another"
            raise Refused("frame_moving", words)
        moved_s = self.tracker.moved_s
        if moved_s is not None and frame.exposure_began_s < moved_s:
            words = f"the rover moved since frame {target.frame_id} was exposed; take another"
            raise Refused("rover_moved", words)
        height, width = frame.image.shape[:2]
        _check_inside("pixel", target.x_px, target.y_px, (width, height))

    def _check_pair(self, camera: str) -> None:
        """Pass a camera whose other eye is configured too: without it there is no range. Raises Refused."""
        if any(camera in eyes for eyes in self._rig.stereo.values()):
            return
        words = f"{camera} is in no stereo pair of the mast file"
        for pair, eyes in self.stored.rig.stereo.items():
            if camera in eyes:
                other = eyes[1] if camera == eyes[0] else eyes[0]
                words = f"the other eye of the stereo pair {pair}, {other}, is not in the configuration"
        raise Refused("no_stereo", f"{words}, so a pixel of {camera} has no range")

    def _check_aim(self, aim: Aim) -> None:
        known = self._rig.cameras.get(aim.camera)
        if known is None or known.on != "head":
            on_head = [name for name, entry in self._rig.cameras.items() if entry.on == "head"]
            known_words = ", ".join(on_head) or "there is none"
            words = f"'{aim.camera[:80]}' where a configured camera on the head is expected: {known_words}"
            raise Refused("bad_aim", f"aim.camera is {words}")
        _check_inside("aim", aim.x_px, aim.y_px, known.model.size_px)


def _configured(rig: Rig, cameras: Iterable[str]) -> Rig:
    """Return the part of a rig that this daemon can see with: nothing is aimed with a camera it lacks."""
    names = set(cameras)
    fit = {key: value for key, value in rig.fit.items() if key not in ("parameters", "covariance")}
    try:
        known = stored_covariance(rig)
    except CalibError as error:
        log.warning("the calibration counts as exact: %s", error)
        known = None
    if known is not None:
        part = known.of(tuple(names))
        fit |= {"parameters": list(part.names), "covariance": part.covariance.tolist()}
    return replace(
        rig,
        fit=fit,
        cameras={name: camera for name, camera in rig.cameras.items() if name in names},
        stereo={pair: eyes for pair, eyes in rig.stereo.items() if names.issuperset(eyes)},
    )


def _check_inside(what: str, x_px: float, y_px: float, size_px: tuple[int, int]) -> None:
    """Pass a pixel inside an image. Raises Refused."""
    width, height = size_px
    if not (-0.5 <= x_px <= width - 0.5 and -0.5 <= y_px <= height - 0.5):
        words = f"{what} ({x_px:g}, {y_px:g}) is outside the image of {width}x{height} px"
        raise Refused("outside_image", words)


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

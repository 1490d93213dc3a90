"""Requests about a daemon's configuration, mast files, recordings, places and benches."""

from __future__ import annotations

from typing import Literal

from mastctl.answers import (
    BenchAnswer,
    BenchRunRecord,
    BenchRuns,
    CalibrationReport,
    CameraSettingsTold,
    ClientSession,
    HeadPlace,
    LiveTold,
    MastChange,
    PlaceList,
    RecorderState,
    RecordingDeleted,
    RecordingEnded,
    Recordings,
    ReloadResult,
    ReportList,
    RigSummary,
    SentinelTold,
    SunTold,
)
from mastctl.client.connection import DaemonHttp, escaped, given


class KeepingCalls:
    """Requests that move no head."""

    daemon: DaemonHttp

    def reload(self) -> ReloadResult:
        """Have the daemon read its configuration again: all of it comes into use while the head rests, or
        nothing (``restart_needed``, ``bad_config``, ``bad_mast_file``, ``busy``, ``moving``).
        """
        return self.daemon.command(ReloadResult, "POST", "/reload")

    def live(self) -> LiveTold:
        """Return that the daemon answers; needs no token."""
        return self.daemon.json(LiveTold, "GET", "/health/live")

    def calibration_health(self) -> CalibrationReport:
        """Return whether residuals of the last days are as the mast file predicts, with the figures."""
        return self.daemon.json(CalibrationReport, "GET", "/calibration/health")

    def sentinel(self) -> SentinelTold:
        """Return what the drift sentinel in the daemon's state folder has found, and how long ago."""
        return self.daemon.json(SentinelTold, "GET", "/sentinel")

    def rig(self) -> RigSummary:
        """Return the configured cameras by the mast file in use: where each looks and how much it sees."""
        return self.daemon.json(RigSummary, "GET", "/rig")

    def camera_settings(self, camera: str) -> CameraSettingsTold:
        """Return what of a camera can be changed: ``settings`` with bounds, and whether they are ``held``."""
        return self.daemon.json(CameraSettingsTold, "GET", f"/cameras/{escaped(camera)}/settings")

    def set_camera(
        self,
        camera: str,
        *,
        exposure_s: float | None = None,
        gain: float | None = None,
        white_balance_k: float | None = None,
        focus: float | None = None,
    ) -> CameraSettingsTold:
        """Change some of a camera's settings and return all as they are then.

        The automatic of each is turned off. ``notes`` has a sentence for each that became another value. They
        hold until the daemon ends, also for a camera that is unplugged meanwhile. Each picture's
        facts have those that it was taken with.
        """
        body = given(exposure_s=exposure_s, gain=gain, white_balance_k=white_balance_k, focus=focus)
        path = f"/cameras/{escaped(camera)}/settings"
        return self.daemon.command(CameraSettingsTold, "PATCH", path, body)

    def bench(self) -> BenchRuns:
        """Return the bench calibration at work or the last one (``run``), and those that are kept."""
        return self.daemon.json(BenchRuns, "GET", "/bench")

    def begin_bench(
        self,
        board: str | None = None,
        *,
        board_file: str | None = None,
        resume: str | None = None,
        wanted_px: float | None = None,
        pictures: int | None = None,
        by_hand: bool | None = None,
    ) -> BenchRunRecord:
        """Have the daemon begin a bench calibration, or go on with one, and return it as it is then.

        Parameters
        ----------
        board, board_file, resume
            One of them: the name of a packaged board, the text of a BOARD.yaml, the name of a run.
        wanted_px, pictures
            The error that the calibration may leave of a first pointing, rms an axis, and the most pictures
            of each camera. By default 0.2 and 60, or as the run had them.
        by_hand
            Whether a simulated board waits for `board_stands` too, as a real one does.
        """
        body = given(
            board=board,
            board_file=board_file,
            resume=resume,
            wanted_px=wanted_px,
            pictures=pictures,
            by_hand=by_hand,
        )
        return self.daemon.command(BenchAnswer, "POST", "/bench", body)["run"]

    def board_stands(self) -> BenchRunRecord:
        """Confirm that the board is at the requested placement."""
        return self.daemon.command(BenchAnswer, "POST", "/bench/stands")["run"]

    def leave_bench(self) -> BenchRunRecord:
        """End the bench calibration; it can go on later (`begin_bench`, ``resume``)."""
        return self.daemon.command(BenchAnswer, "POST", "/bench/leave")["run"]

    def forget_bench(self, name: str) -> BenchRuns:
        """Remove a bench calibration that is over, with its pictures and report; its mast file stays.

        Returns what is left, as `bench`. Refused with ``bench_runs``, ``bench_unknown``, ``unwritable``.
        """
        return self.daemon.command(BenchRuns, "DELETE", f"/bench/runs/{escaped(name)}")

    def reports(self) -> ReportList:
        """Return the reports that can be read, the newest first."""
        return self.daemon.json(ReportList, "GET", "/reports")

    def report(self, name: str) -> bytes:
        """Return a report, HTML."""
        return self.daemon.request("GET", f"/reports/{escaped(name)}").content

    def recordings(self) -> Recordings:
        """Return the daemon's recordings, and what it records now."""
        return self.daemon.json(Recordings, "GET", "/recordings")

    def start_recording(self, name: str = "") -> RecorderState:
        """Have the daemon record until `stop_recording`; return what it records then."""
        return self.daemon.command(RecorderState, "POST", "/recordings/start", {"name": name})

    def stop_recording(self) -> RecordingEnded:
        """End the recording; return its file on the daemon's machine, its size and what was dropped."""
        return self.daemon.command(RecordingEnded, "POST", "/recordings/stop")

    def recording(self, name: str, file: str) -> bytes:
        """Return a file of a recording whole, by the names that `recordings` returns."""
        path = f"/recordings/{escaped(name)}/{escaped(file)}"
        return self.daemon.request("GET", path).content

    def delete_recording(self, name: str) -> RecordingDeleted:
        """Delete a run, or what was kept at a fault; return what is left."""
        return self.daemon.command(RecordingDeleted, "DELETE", f"/recordings/{escaped(name)}")

    def mast_file(self) -> bytes:
        """Return the mast file that the daemon uses, byte for byte."""
        return self.daemon.request("GET", "/mast").content

    def use_mast(self, file: str) -> MastChange:
        """Use another mast file of the same folder; return which is in use now, and the former one."""
        return self.daemon.command(MastChange, "POST", "/mast", {"file": file})

    def use_former_mast(self) -> MastChange:
        """Go back to the mast file that was in use before; return which is in use now, and the former one."""
        return self.daemon.command(MastChange, "POST", "/mast/back")

    def places(self) -> dict[str, HeadPlace]:
        """Return the places of the head that are kept, by name; ``home`` is always among them."""
        return self.daemon.json(PlaceList, "GET", "/places")["places"]

    def keep_place(self, name: str, pan_rad: float, tilt_rad: float) -> dict[str, HeadPlace]:
        """Keep a place of the head by a name, for everybody; return all."""
        body = {"pan_rad": pan_rad, "tilt_rad": tilt_rad}
        return self.daemon.command(PlaceList, "POST", f"/places/{escaped(name)}", body)["places"]

    def forget_place(self, name: str) -> dict[str, HeadPlace]:
        """Forget a place; return those that are left. Raises ClientError ``place_unknown``."""
        return self.daemon.command(PlaceList, "DELETE", f"/places/{escaped(name)}")["places"]

    def sun(self) -> SunTold:
        """Return the direction that no head camera looks into: ``sun``, null where none was stated."""
        return self.daemon.json(SunTold, "GET", "/limits/sun")

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

        ``half_angle_rad``: how near a head camera's axis may come; ``valid_s``: how long that holds, seconds,
        by default until another is stated.
        """
        body = given(
            azimuth_rad=azimuth_rad,
            elevation_rad=elevation_rad,
            half_angle_rad=half_angle_rad,
            frame=frame,
            valid_s=valid_s,
        )
        return self.daemon.command(SunTold, "POST", "/limits/sun", body)

    def forget_sun(self) -> SunTold:
        """Keep the head off no sun any more."""
        return self.daemon.command(SunTold, "DELETE", "/limits/sun")

    def session(self) -> ClientSession:
        """Return this client's ``name``, ``role`` and ``via``, and whether the daemon requires a token."""
        return self.daemon.json(ClientSession, "GET", "/session")

"""Requests about panoramas and about targets that are kept by a name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from mastctl.answers import KeptTarget, PanoramaList, PanoramaListed, Started, TargetList
from mastctl.client.connection import DaemonHttp, escaped, floats, given


class PanoramaCalls:
    """Taking panoramas, reading them, and keeping targets."""

    daemon: DaemonHttp

    def take_panorama(
        self,
        *,
        pair: str | None = None,
        camera: str | None = None,
        pan_rad: Sequence[float] | None = None,
        tilt_rad: Sequence[float] | None = None,
        overlap: float | None = None,
        exposure: Literal["first", "auto-per-view"] | None = None,
        resume: str | None = None,
    ) -> str:
        """Start to take a panorama and return the operation's id; its record names the panorama.

        ``pan_rad``, ``tilt_rad``: azimuth and elevation of the field, from and to. ``resume`` names one of
        which views are missing, and goes alone.
        """
        body = given(
            pair=pair, camera=camera, overlap=overlap, exposure=exposure, resume=resume,
            pan_rad=None if pan_rad is None else floats(pan_rad),
            tilt_rad=None if tilt_rad is None else floats(tilt_rad),
        )  # fmt: skip
        return self.daemon.command(Started, "POST", "/panoramas", body)["id"]

    def panoramas(self) -> list[PanoramaListed]:
        """Return the daemon's panoramas, the newest first."""
        return self.daemon.json(PanoramaList, "GET", "/panoramas")["panoramas"]

    def panorama(self, name: str) -> dict[str, Any]:
        """Return a panorama's index (``mastctl/panorama/1``)."""
        return self.daemon.json(dict[str, Any], "GET", f"/panoramas/{escaped(name)}")

    def panorama_file(self, name: str, file: str) -> bytes:
        """Return a file of a panorama: ``index.yaml``, ``mosaic.png``, a frame that the index names."""
        return self.daemon.request("GET", f"/panoramas/{escaped(name)}/files/{file}").content

    def targets(self) -> dict[str, KeptTarget]:
        """Return the targets that are kept, by name."""
        return self.daemon.json(TargetList, "GET", "/targets")["targets"]

    def keep_target(
        self,
        name: str,
        position_m: Sequence[float],
        frame: Literal["rover", "site"] = "rover",
        covariance_m2: Sequence[Sequence[float]] | None = None,
    ) -> dict[str, KeptTarget]:
        """Keep a point by a name, for everybody, in the site frame if a pose is known; return all."""
        rows = None if covariance_m2 is None else [floats(row) for row in covariance_m2]
        body = given(position_m=floats(position_m), frame=frame, covariance_m2=rows)
        return self.daemon.command(TargetList, "POST", f"/targets/{escaped(name)}", body)["targets"]

    def forget_target(self, name: str) -> dict[str, KeptTarget]:
        """Forget a target; return those that are left. Raises ClientError ``target_unknown``."""
        return self.daemon.command(TargetList, "DELETE", f"/targets/{escaped(name)}")["targets"]

"""A target followed by a daemon on the simulated rover: over HTTP, with true poses and told ones."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.rig import Rig, RigCamera
from calib.geometry.rigid import FloatArray, Rigid
from hil_tests.waiting import until
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon
from mastctl.drift.handoffs import read_log
from mastctl.experiment.targets import texture_mask

CROPPED_PX = (400, 300)
STEP_M = 0.45
ODOMETRY, HEADING_RAD = 0.02, math.radians(0.5)
ROVER = """
schema: mastctl/config/1
mast_file: rig.yaml
listen: {port: 0}
pan_tilt: {driver: sim}
cameras: {navcam_left: {driver: sim}, navcam_right: {driver: sim},
          hazcam_left: {driver: sim}, hazcam_right: {driver: sim}}
limits: {pan_rad: [-2.6, 2.6], tilt_rad: [-1.2, 0.5], speed_rad_per_s: 2.0}
simulation: {rover: rig.yaml, samples: 1, seed: 3, speed: max, cameras: {rate_hz: 30}}
tracking: {handoff: {pairs: {navcam: {nearest_m: 2.6}}}, handoff_log: handed.jsonl}
"""


def cropped(camera: RigCamera) -> RigCamera:
    """The middle of a camera's picture, as if its chip were smaller."""
    model = camera.model
    x, y = ((whole - part) // 2 for whole, part in zip(model.size_px, CROPPED_PX, strict=True))
    return replace(
        camera,
        model=replace(model, size_px=CROPPED_PX, H=model.H - x * model.A, V=model.V - y * model.A),
    )


@pytest.fixture(scope="module")
def daemon(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    """One simulated rover for all tests here: building its ground takes seconds."""
    folder = tmp_path_factory.mktemp("rover")
    rig = load_rig(repository / "configs/sim/rocky8.yaml").rig
    cameras = {name: cropped(rig.cameras[name]) for name in rig.stereo["navcam"]}
    cameras |= {name: rig.cameras[name] for name in rig.stereo["hazcam"]}
    stereo = {pair: rig.stereo[pair] for pair in ("navcam", "hazcam")}
    save_rig(Rig("small", rig.mast, cameras, stereo), folder / "rig.yaml")
    (folder / "rover.yaml").write_text(ROVER)
    with RunningDaemon(load_config(folder / "rover.yaml")) as made:
        yield made


@pytest.fixture
def client(daemon: RunningDaemon) -> Iterator[Client]:
    with Client(daemon.url) as made:
        yield made
        made.clear_faults()
        made.stop_track()


class Drive:
    """The simulated rover driven by hand: the truth is set, and an odometer with errors tells of it."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._rng = np.random.default_rng(8)
        client.stand(0.0, 0.0, 0.0)
        self._told = self.true()
        self.tell((0.0, 0.0))

    def true(self) -> Rigid:
        pose = self._client.true_pose()
        w, x, y, z = pose["quaternion"]
        return Rigid(Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(pose["position_m"]))

    def to(self, x_m: float, y_m: float, heading_rad: float) -> dict[str, Any]:
        """Drive there; return the track after the look from there."""
        before = self.true()
        self._client.stand(x_m, y_m, heading_rad, 0.02, -0.01)
        motion = before.inverse @ self.true()
        way_m = float(np.linalg.norm(motion.translation_m))
        sigma = (max(1e-4, ODOMETRY * way_m), HEADING_RAD)
        off = self._rng.normal(0.0, 1.0, 6)
        error = Rigid(Rotation.from_rotvec(sigma[1] * off[:3]).as_matrix(), sigma[0] * off[3:])
        self._told = self._told @ motion @ error
        return self.tell(sigma)

    def tell(self, sigma: tuple[float, float]) -> Any:
        x, y, z, w = Rotation.from_matrix(self._told.rotation).as_quat().tolist()
        position = self._told.translation_m.tolist()
        answer = self._client.pose(position, (w, x, y, z), sigma=sigma)
        return self._client.wait_track(answer["operation"])


def begun(client: Client, daemon: RunningDaemon, range_m: float = 3.4) -> FloatArray:
    """A track of a textured place; returns where it truly is in the site frame."""
    client.wait(client.point(position_m=[range_m, 0.2, 0.0]))
    shot = client.snapshot("navcam_left")
    rows, columns = np.nonzero(texture_mask(shot.image)[60:-60, 60:-60])
    simulation = daemon.hardware.simulation
    assert simulation is not None
    for pick in np.random.default_rng(2).integers(len(rows), size=8):
        pixel = (float(columns[pick] + 60), float(rows[pick] + 60))
        track = client.wait_track(client.start_track(pixel=("navcam_left", shot.frame_id, *pixel)))
        if track["state"] == "tracking":
            point = simulation.true_point("navcam_left", shot.sequence, pixel)
            assert point is not None
            return simulation.site_from_rover.points(point)
    raise AssertionError(f"none of eight textured pixels could be followed: {track['reason']}")


def off_m(track: dict[str, Any], drive: Drive, target_m: FloatArray) -> float:
    """How far the track's position is from the true one."""
    return float(np.linalg.norm(np.array(track["position_m"]) - drive.true().inverse.points(target_m)))


def test_an_approach_over_http_hands_over_and_keeps_its_target(client: Client, daemon: RunningDaemon) -> None:
    drive = Drive(client)
    target_m = begun(client, daemon)
    for step in range(1, 5):
        track = drive.to(STEP_M * step, 0.04 * step, 0.05 * step)
        assert track["state"] == "tracking", track["reason"]
        assert not track["predicted"]
        sigma_m = math.sqrt(sum(track["covariance_m2"][axis][axis] for axis in range(3)))
        assert off_m(track, drive, target_m) < min(0.03, 5 * sigma_m)
        if track["pair"] == "navcam":
            pixels = [track["pixels"][name] for name in ("navcam_left", "navcam_right")]
            middle = (np.array(CROPPED_PX) - 1) / 2
            off_px = np.mean([(one["x_px"], one["y_px"]) for one in pixels], axis=0) - middle
            assert np.abs(off_px).max() < 60, "the head looks where the target was predicted"
    assert track["pair"] == "hazcam"
    assert [(one["from_pair"], one["to_pair"]) for one in track["handoffs"]] == [("navcam", "hazcam")]
    assert track["looks"] == 4
    path = daemon.service.config.mast_file.parent / "handed.jsonl"
    until(lambda: path.exists() and len(read_log(path).handoffs) == 1, "the record is written")
    (record,) = read_log(path).handoffs
    assert record.pair == ("navcam_left", "navcam_right")
    assert list(record.found) == ["hazcam_left", "hazcam_right"]
    for landed in record.found.values():
        assert landed.found_px == pytest.approx(landed.geometric_px, abs=1.0), "the mast file is true"
    assert 0.0 < record.joints.sigma_rad < 4e-4, "a joint's reading is known to less than half a pixel"

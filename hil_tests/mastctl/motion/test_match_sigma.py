"""How true the sigmas are that the pointing loop's stereo matches report, on rough ground.

The simulated rover's Navcams see ground and rocks; a pixel is matched in the other camera as the loop does
it. Truth is geometry: the pixel's ray meets the scene (`Scene.cast`), and the point is projected into the
other picture. Targets that the other picture does not show are left out.
"""

from __future__ import annotations

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.warp import grey
from drivers.sim.placed import SceneSettings
from drivers.sim.render import Renderer
from drivers.sim.scene import Scene, build_scene
from hil_tests.support.sim_survey.board import photograph
from mastctl.devices.frames import StampedFrame
from mastctl.experiment.targets import texture_mask
from mastctl.motion.measurement import CameraView, RigCameras
from mastctl.motion.requests import PointingError
from mastctl.packaged import config_folder

TARGETS, SEEDS, RELIEF_M = 8, (1, 2), 0.5
LEFT, RIGHT = "navcam_left", "navcam_right"
NEAR_M, FAR_M = 1.8, 11.0
BLUR_PX, NOISE_DN = 0.7, 2.0
HIDDEN = 0.01
"""A point is hidden from a camera whose ray ends earlier by more than this part of the way."""


def taken(rig: Rig, drawing: Renderer, rng: np.random.Generator) -> dict[str, CameraView]:
    """Pictures of both cameras at a random pose of the head."""
    range_m = np.exp(rng.uniform(np.log(NEAR_M), np.log(FAR_M)))
    pan, tilt = rng.uniform(-0.9, 0.9), -np.arctan2(1.46, range_m)
    views = {}
    for number, name in enumerate((LEFT, RIGHT)):
        picture = drawing.image(rig.cameras[name].model, rig.mast.rover_from_head(pan, tilt))
        image = photograph(picture, BLUR_PX, NOISE_DN, rng)
        facts = (f"{name}-{number}", name, number, 0.0, 0.0, pan, tilt, False, "")
        frame = StampedFrame(*facts, image=image, true_pan_rad=pan, true_tilt_rad=tilt)
        views[name] = CameraView(grey(image), rig.camera_in_rover(name, pan, tilt), frame)
    return views


def shown(scene: Scene, camera: CameraModel, point_m: FloatArray) -> FloatArray | None:
    """Where a camera sees a point; None if it is hidden or near the border or outside."""
    pixel, valid = camera.project(point_m)
    if not (valid and camera.holds(pixel, 45.0)):
        return None
    ray = camera.ray(pixel)
    way_m = float((point_m - ray.origins_m) @ ray.directions)
    return pixel if float(scene.cast(ray.origins_m, ray.directions)) > (1.0 - HIDDEN) * way_m else None


def errors_by_sigma(rig: Rig, seed: int) -> list[FloatArray]:
    """Found minus true over the reported sigma, (2,) for each target that is matched."""
    rng = np.random.default_rng([seed, 0])
    drawing = Renderer(build_scene(SceneSettings(seed=seed, relief_m=RELIEF_M)), workers=1)
    views = taken(rig, drawing, rng)
    cameras = RigCameras(None, rig)  # type: ignore[arg-type]  # it takes none
    rows, columns = np.nonzero(texture_mask(views[LEFT].frame.image))
    found: list[FloatArray] = []
    given = 0
    for pick in rng.integers(len(rows), size=20 * TARGETS):
        pixel = np.array([columns[pick], rows[pick]], dtype=float)
        ray = views[LEFT].camera.ray(pixel)
        range_m = float(drawing.scene.cast(ray.origins_m, ray.directions))
        truth = shown(drawing.scene, views[RIGHT].camera, ray.origins_m + range_m * ray.directions)
        if range_m > 2 * FAR_M or truth is None:
            continue
        given += 1
        try:
            match = cameras.stereo(views[LEFT], pixel, views[RIGHT]).match
        except PointingError:
            continue
        found.append((match.pixel_px - truth) / match.sigma_px)
        if given == TARGETS:
            break
    return found


@pytest.mark.long(1, "many rendered matches for one scatter")
def test_the_loops_matches_on_rough_ground_are_off_by_what_they_tell() -> None:
    rig = load_rig(config_folder() / "masts" / "rocky8_simulated.yaml").rig
    found = np.array([one for seed in SEEDS for one in errors_by_sigma(rig, seed)])
    assert len(found) > TARGETS
    assert 0.4 < np.sqrt(np.mean(found[:, 0] ** 2)) < 2.0, "along x, where ranges show"

"""How true the sigmas are that the pointing loop's matches tell, on gentle and on rough ground.

The simulated rover's Navcams look at ground and rocks; a pixel is matched as the loop does it: in the other
eye, and, with the surface found so, in pictures after a turn of the head. Truth is geometry: the pixel's ray
meets the scene (`Scene.cast`), and the point is projected into the other picture. Targets that the other
picture does not show are left out. Rows: the loop's settings, the tracker's. Errors are
found minus true, px along x (where ranges show in the other eye) and y; a true sigma has error/sigma 1.
With ``--colour`` pixels lie under colour filters and pictures are JPEG of quality 90, as on the worst day.

    .venv/bin/python -m tools.campaigns.match_sigma [--cases 4] [--relief 0.15 0.5] [--seeds 3] [--colour]
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.track import SIZES
from calib.matching.verdict import PatchMatch
from calib.matching.warp import grey
from drivers.sim.optics.exposure import FrameExposure
from drivers.sim.optics.readout import Noise, Readout
from drivers.sim.render import Renderer
from drivers.sim.scene import Scene, SceneSettings, build_scene
from mastctl.cli.output import at_least, not_negative
from mastctl.devices.frames import StampedFrame
from mastctl.experiment.targets import texture_mask
from mastctl.motion.looking import CameraView, Clicked, RigCameras
from mastctl.motion.results import PointingError
from mastctl.motion.settings import PointingSettings
from mastctl.packaged import config_folder
from tools.command import end, options, run_cases, show
from tools.sim_survey.board import photograph

LEFT, RIGHT = "navcam_left", "navcam_right"
NEAR_M, FAR_M = 1.8, 11.0
BLUR_PX, NOISE_DN = 0.7, 2.0
READ_DN, SHOT_DN, JPEG = 1.0, 1.7, 90
"""Of a colour camera, which adds no blur."""
HIDDEN = 0.01
"""A point is hidden from an eye whose ray ends earlier by more than this part of the way."""

SETTINGS = {
    "the loop's": PointingSettings().match,
    "the tracker's": SIZES,
}
MATCHES = ("other eye", "after a turn")


@dataclass(frozen=True)
class MatchLook:
    """Pictures of both eyes at a random pose and after a turn, and so many targets in them."""

    rig: Rig
    relief_m: float
    seed: int
    number: int
    targets: int
    colour: bool = False


@dataclass(frozen=True)
class MatchRow:
    """Matches of one kind: asked for, and errors and sigmas (n, 2) px of the good ones."""

    asked: int
    error_px: FloatArray
    sigma_px: FloatArray


Rows = dict[tuple[str, str], MatchRow]
"""By settings and kind of match."""


@cache
def renderer(relief_m: float, seed: int) -> Renderer:
    """Return what draws a scene of such a relief."""
    return Renderer(build_scene(SceneSettings(seed=seed, relief_m=relief_m)), workers=1)


class TakenPose:
    """Pictures of one pose of the head, and its cameras."""

    def __init__(self, look: MatchLook, pan_rad: float, tilt_rad: float, rng: np.random.Generator) -> None:
        drawing = renderer(look.relief_m, look.seed)
        site_from_head = look.rig.mast.rover_from_head(pan_rad, tilt_rad)
        self.views: dict[str, CameraView] = {}
        for number, name in enumerate((LEFT, RIGHT)):
            picture = drawing.image(look.rig.cameras[name].model, site_from_head)
            if look.colour:
                noise = Noise(READ_DN, SHOT_DN, int(rng.integers(2**31)), name)
                image = Readout(noise, colour=True, jpeg_quality=JPEG).picture(picture, 0, FrameExposure(0.0))
            else:
                image = photograph(picture, BLUR_PX, NOISE_DN, rng)
            facts = (f"{name}-{number}", name, number, 0.0, 0.0, pan_rad, tilt_rad, False, "")
            camera = look.rig.camera_in_rover(name, pan_rad, tilt_rad)
            frame = StampedFrame(*facts, image=image, true_pan_rad=pan_rad, true_tilt_rad=tilt_rad)
            self.views[name] = CameraView(frame, grey(image), camera)


def run_look(look: MatchLook) -> Rows:
    """Take the pictures and match the targets by each of the settings."""
    rng = np.random.default_rng([look.seed, look.number])
    range_m = np.exp(rng.uniform(np.log(NEAR_M), np.log(FAR_M)))
    pan, tilt = rng.uniform(-0.9, 0.9), -np.arctan2(1.46, range_m)
    turn = rng.uniform(-0.15, 0.15, 2)
    first = TakenPose(look, pan, tilt, rng)
    second = TakenPose(look, pan + turn[0], tilt + turn[1], rng)
    scene = renderer(look.relief_m, look.seed).scene
    found: dict[tuple[str, str], list[FloatArray | None]] = {
        (name, kind): [] for name in SETTINGS for kind in MATCHES
    }
    for pixel, truths in chosen(look, scene, first, second, rng):
        for name, match in SETTINGS.items():
            eyes = RigCameras(_NoCameras(), look.rig, replace(PointingSettings(), match=match))
            stereo, turned = matched(eyes, pixel, first, second)
            for kind, one, truth in zip(MATCHES, (stereo, turned), truths, strict=True):
                found[name, kind].append(
                    None if one is None else np.stack([one.pixel_px - truth, one.sigma_px])
                )
    rows = {}
    for key, matches in found.items():
        good = np.array([one for one in matches if one is not None]).reshape(-1, 2, 2)
        rows[key] = MatchRow(len(matches), good[:, 0], good[:, 1])
    return rows


def chosen(
    look: MatchLook, scene: Scene, first: TakenPose, second: TakenPose, rng: np.random.Generator
) -> Iterator[tuple[FloatArray, tuple[FloatArray, FloatArray]]]:
    """Pixels of the left eye with texture, and where the right eye, and the left after the turn, see them."""
    view = first.views[LEFT]
    rows, columns = np.nonzero(texture_mask(view.frame.image))
    given = 0
    for pick in rng.integers(len(rows), size=20 * look.targets) if len(rows) else ():
        pixel = np.array([columns[pick], rows[pick]], dtype=float)
        ray = view.camera.ray(pixel)
        range_m = float(scene.cast(ray.origins_m, ray.directions))
        point = ray.origins_m + range_m * ray.directions
        truths = [shown(scene, one, point) for one in (first.views[RIGHT].camera, second.views[LEFT].camera)]
        if range_m <= 2 * FAR_M and truths[0] is not None and truths[1] is not None:
            yield pixel, (truths[0], truths[1])
            given += 1
        if given == look.targets:
            return


def shown(scene: Scene, camera: CameraModel, point_m: FloatArray) -> FloatArray | None:
    """Where a camera sees a point; None if it is hidden or near the border or outside."""
    pixel, valid = camera.project(point_m)
    if not (valid and camera.holds(pixel, 45.0)):
        return None
    ray = camera.ray(pixel)
    way_m = float((point_m - ray.origins_m) @ ray.directions)
    return pixel if float(scene.cast(ray.origins_m, ray.directions)) > (1.0 - HIDDEN) * way_m else None


def matched(
    eyes: RigCameras, pixel: FloatArray, first: TakenPose, second: TakenPose
) -> tuple[PatchMatch | None, PatchMatch | None]:
    """The matches in the other eye and after the turn, None where the loop refuses."""
    view = first.views[LEFT]
    try:
        stereo = eyes.stereo(view, pixel, first.views[RIGHT])
    except PointingError:
        return None, None
    assert stereo.plane is not None
    try:
        return stereo.match, eyes.look_for(
            Clicked(view, pixel, stereo.plane, relief=stereo.relief), second.views[LEFT]
        )
    except PointingError:
        return stereo.match, None


class _NoCameras:
    """Pictures are given to the loop's eyes; they fetch none."""

    def frames(
        self, cameras: Sequence[str], exposed_after_s: float, timeout_s: float
    ) -> dict[str, StampedFrame]:
        return {}

    def newest_frames(self) -> dict[str, StampedFrame | None]:
        return {}


def together(parts: Sequence[Rows]) -> Rows:
    """Rows of several looks as one."""
    return {
        key: MatchRow(
            sum(part[key].asked for part in parts),
            np.concatenate([part[key].error_px for part in parts]),
            np.concatenate([part[key].sigma_px for part in parts]),
        )
        for key in parts[0]
    }


def told(relief_m: float, rows: Rows) -> list[dict[str, Any]]:
    """The table's rows; not-a-number is none where nothing was good."""
    table = []
    for (settings, kind), row in rows.items():
        share = row.error_px / row.sigma_px
        numbers = {
            "rms_px": np.sqrt((row.error_px**2).mean(axis=0)),
            "p95_px": np.percentile(np.abs(row.error_px), 95, axis=0),
            "worst_px": np.abs(row.error_px).max(axis=0),
            "of_sigma": np.sqrt((share**2).mean(axis=0)),
            "p95_of_sigma": np.percentile(np.abs(share), 95, axis=0),
        } if len(share) else {}  # fmt: skip
        facts = {
            "relief_m": relief_m,
            "match": kind,
            "settings": settings,
            "asked": row.asked,
            "good": len(share),
        }
        table.append({**facts, **{name: value.tolist() for name, value in numbers.items()}})
    return table


_X_Y = "{{{0}[0]:.3f}}, {{{0}[1]:.3f}}".format
COLUMNS = {
    "relief, m": "{relief_m:.2f}", "match": "{match}", "settings": "{settings}", "good": "{good} of {asked}",
    "px x, y: rms": _X_Y("rms_px"), "p95": _X_Y("p95_px"), "worst": _X_Y("worst_px"),
    "of sigma: rms": _X_Y("of_sigma"), "p95 of sigma": _X_Y("p95_of_sigma"),
}  # fmt: skip


def main() -> int:
    """Match, and print a table or a document."""
    parser = options(__doc__, 4, "views of each scene", seed=None, as_json=True)
    parser.add_argument("--targets", type=at_least(1), default=20, help="of each view (default 20)")
    parser.add_argument("--relief", type=not_negative, nargs="+", default=[0.15, 0.5], metavar="M")
    parser.add_argument("--seeds", type=at_least(1), default=3, help="scenes of each relief, from seed 1 on")
    parser.add_argument("--colour", action="store_true", help="colour filters and JPEG")
    args = parser.parse_args()
    rig = load_rig(config_folder() / "masts" / "rocky8_simulated.yaml").rig
    looks = [
        MatchLook(rig, relief_m, seed, number, args.targets, args.colour)
        for relief_m in args.relief
        for seed in range(1, args.seeds + 1)
        for number in range(args.cases)
    ]
    label = "relief {0.relief_m:g} m, seed {0.seed}, view {0.number}".format
    found = run_cases(args, "views", run_look, looks, label)
    table: list[dict[str, Any]] = []
    for relief_m in dict.fromkeys(args.relief):
        parts = [rows for look, rows in zip(looks, found, strict=True) if look.relief_m == relief_m]
        table += told(relief_m, together(parts))
    show(args, table, COLUMNS)
    return 0


if __name__ == "__main__":
    end(main)

"""What each unkindness of the simulated head and cameras costs in pixels, and what is left after what helps.

    .venv/bin/python -m tools.campaigns.life head [--config FILE] [--cases 100] [--minutes 10] [--seed 1]
    .venv/bin/python -m tools.campaigns.life cameras [--config FILE] [--cases 4] [--seed 1]

``head``: each option of the configuration's head, clocks and temperature is tried alone, on a head that is
else the preset. Head: moves to random views of the ground; how far the view is from the one that was asked
for in the middle of the first exposure after the head says that it rests, at the first pointing (less the
mean, which a calibration takes) and, corrected by what that exposure showed, at the second. Clocks: what
stamps taken at their word are off by after so many minutes while a head turns at 0.1 rad/s. Temperature: the
whole picture, at the day's extreme. rms and worst, pixels of Navcam and Pancam. Nothing is rendered: the
truth is the simulator's own.

``cameras``: each option of the configuration's cameras is put on the packaged rover, and the pointing
experiment is run on it, a number of targets a distance, at the simulation's own speed ``max``: residuals of
the left Navcam, rms px (x, y) over all distances, as measured and (true) as the simulator knows. Two rows are
between these: none of the options, and all of them.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from drivers.clock import ManualClock
from drivers.errors import DriverError
from drivers.sim.camera_settings import CameraClock, ClockSettings, TemperatureSettings
from drivers.sim.heads import PRESETS, HeadSettings
from drivers.sim.pan_tilt import SimulatedPanTilt
from drivers.sim.settings import SimulationSettings, simulation_settings
from mastctl.cli.output import at_least
from mastctl.config import load_config
from mastctl.motion.settings import PointingSettings
from mastctl.packaged import config_folder
from tools.command import end, options, run_cases, show

PAIRS = ("navcam", "pancam")
PERIOD_S, EXPOSURE_S = 0.1, 0.008
TURNING_RAD_PER_S = 0.1
OPTIONS: Mapping[str, tuple[str, ...]] = {
    "none of them": (),
    "ringing": ("ring_hz", "ring_damping", "ring_gain"),
    "ringing, with settle_s": ("ring_hz", "ring_damping", "ring_gain", "settle_s"),
    "encoder harmonics": ("harmonics_rad",),
    "play under gravity": ("gravity_turnover_rad", "gravity_friction"),
}

OF_CAMERAS: Mapping[str, tuple[str, ...]] = {
    "none of them": (),
    "smear and rolling shutter": ("smear", "row_time_s"),
    "automatic exposure": ("exposure",),
    "falloff": ("lens.falloff",),
    "defocus": ("lens.f_number", "lens.focus_m", "lens.pitch_um"),
    "dust": ("lens.dust", "lens.dust_um", "lens.dust_gap_um"),
    "colour": ("colour",),
    "JPEG": ("jpeg_quality",),
    "all of them": ("smear", "row_time_s", "exposure", "lens", "colour", "jpeg_quality"),
}

Offs = NDArray[np.float64]
"""(n, 2): in pan and tilt, radians, or in x and y, pixels."""


@dataclass(frozen=True)
class LivedHead:
    """A head with one option; all heads are sent to the same views and looked at after the same waits."""

    option: str
    settings: HeadSettings
    moves: int
    seed: int


class LifeRow(NamedTuple):
    """By pair, rms and worst, px; None where nothing is told."""

    option: str
    how: str
    navcam: tuple[float, float] | None
    pancam: tuple[float, float] | None


@dataclass(frozen=True)
class LightTrial:
    """An option, the section ``cameras`` that is it, and the targets."""

    option: str
    cameras: Mapping[str, Any]
    targets: int
    seed: int


class LightRow(NamedTuple):
    """Rms px (x, y) over all targets; ``failed``: targets without a residual."""

    option: str
    first_px: tuple[float, float]
    second_px: tuple[float, float]
    true_second_px: tuple[float, float]
    failed: int


_TWO = "{{{0}[0]:{1}}}, {{{0}[1]:{1}}}".format
HEAD_COLUMNS = {
    "option": "{option}", "how": "{how}", "navcam px: rms, worst": _TWO("navcam", ".2f"),
    "pancam px: rms, worst": _TWO("pancam", ".2f"),
}  # fmt: skip
CAMERA_COLUMNS = {
    "option": "{option}", "first, rms px": _TWO("first_px", ".3f"), "second": _TWO("second_px", ".3f"),
    "second, true": _TWO("true_second_px", ".3f"), "failed": "{failed}",
}  # fmt: skip


def main() -> int:
    """Measure, and print a table or a document."""
    worst = config_folder() / "worst_day.yaml"
    parser = options(__doc__, minutes=10.0, as_json=True)
    parser.add_argument("of", choices=("head", "cameras"))
    parser.add_argument(
        "--cases",
        type=at_least(2),
        metavar="N",
        help="moves (default 100), or targets a distance (default 4)",
    )
    parser.add_argument("--config", type=Path, default=worst, metavar="FILE", help="(default worst_day.yaml)")
    args = parser.parse_args()
    config = load_config(args.config)
    if args.of == "cameras":
        cameras = config.hardware.simulation.get("cameras", {})
        trials = [
            LightTrial(option, only_of(cameras, keys), args.cases or 4, args.seed)
            for option, keys in OF_CAMERAS.items()
        ]
        lights = run_cases(args, "options", pointed, trials, lambda trial: trial.option)
        show(args, [row._asdict() for row in lights], CAMERA_COLUMNS)
        return 0
    settings = simulation_settings(config.hardware.simulation, config.hardware.folder)
    rig = load_rig(settings.rover).rig
    heads = [
        LivedHead(option, only(settings.head, names), args.cases or 100, args.seed)
        for option, names in OPTIONS.items()
    ]
    found = run_cases(args, "heads", offs, heads, lambda head: head.option)
    rows = [
        *of_the_head(heads, found, rig),
        *of_the_clocks(settings, rig, 60 * args.minutes, config.hardware.cameras),
        *of_the_day(settings.temperature, rig),
    ]
    show(args, [row._asdict() for row in rows], HEAD_COLUMNS)
    return 0


def of_the_head(
    heads: Sequence[LivedHead], found: Sequence[tuple[Offs, Offs]], rig: Rig
) -> Iterator[LifeRow]:
    """Each option of the head alone."""
    for head, pointings in zip(heads, found, strict=True):
        for number, off in enumerate(pointings, 1):
            pixels = (spread(off * px_per_rad(rig, pair)) for pair in PAIRS)
            yield LifeRow(head.option, f"pointing {number}", *pixels)


def only(head: HeadSettings, names: tuple[str, ...]) -> HeadSettings:
    """The preset with some of a head's options."""
    plain = PRESETS[head.name]
    pan, tilt = ({name: getattr(axis, name) for name in names} for axis in (head.pan, head.tilt))
    return replace(plain, pan=replace(plain.pan, **pan), tilt=replace(plain.tilt, **tilt))


def offs(head: LivedHead) -> tuple[Offs, Offs]:
    """How far a picture is from the view that was asked for, at the first and at the second pointing."""
    random = np.random.default_rng(head.seed)
    ranges_m = np.exp(random.uniform(np.log(2.0), np.log(12.0), head.moves))
    goals = np.stack([random.uniform(-1, 1, head.moves), -np.arctan(1.46 / ranges_m)], axis=-1)
    clock = ManualClock(100.0)
    device = SimulatedPanTilt(head.settings, clock)
    dwell_s = PointingSettings().dwell_s if head.settings.pan.settle_s > 0 else 0.0
    found: tuple[list[Offs], list[Offs]] = ([], [])
    for goal in goals:
        off = np.zeros(2)
        for pointing in found:
            device.move(*(goal - off))
            while device.read().moving:
                clock.advance(0.005)
            clock.advance(dwell_s + random.uniform(0, PERIOD_S) + EXPOSURE_S)
            seen = np.array(device.true_joints(clock.now_s() - EXPOSURE_S / 2)) - goal
            pointing.append(seen)
            off = off + seen
            clock.advance(PERIOD_S)
        clock.advance(20.0)
    return np.array(found[0]) - np.mean(found[0], axis=0), np.array(found[1])


def px_per_rad(rig: Rig, pair: str) -> float:
    """A pair's left focal length."""
    model = rig.cameras[rig.stereo[pair][0]].model
    return model.focal_px[0]


def spread(px: Offs) -> tuple[float, float]:
    """Rms of one axis, and the worst of either."""
    return float(np.sqrt((px**2).mean())), float(np.abs(px).max())


def of_the_clocks(
    settings: SimulationSettings, rig: Rig, passed_s: float, cameras: Mapping[str, Any]
) -> Iterator[LifeRow]:
    """What stamps are off by if the cameras' clocks make them, without and with offset_s; and as it is."""
    turning = {pair: TURNING_RAD_PER_S * px_per_rad(rig, pair) for pair in PAIRS}
    cases = (("own stamps", True, False), ("own stamps, offset_s", True, True), ("offset_s", False, True))
    for how, by_own, corrected in cases:
        cells: dict[str, tuple[float, float]] = {}
        for pair in PAIRS:
            late_s = []
            for name in rig.stereo[pair]:
                own = settings.clocks.get(name, ClockSettings())
                clock = CameraClock(replace(own, own_stamps=True) if by_own else own, 0.0)
                offset_s = cameras[name].offset_s if corrected else 0.0
                late_s.append(clock.stamp_s(passed_s) + offset_s - passed_s)
            cells[pair] = spread(np.array(late_s) * turning[pair])
        yield LifeRow("clocks", how, cells["navcam"], cells["pancam"])


def of_the_day(day: TemperatureSettings, rig: Rig) -> Iterator[LifeRow]:
    """Lenses and mount at the extreme."""
    warmer_k = day.amplitude_k
    still = {"focal_ppm_per_k": 0.0, "centre_x_px_per_k": 0.0, "centre_y_px_per_k": 0.0}
    parts = {
        "focal length": replace(day, **{**still, "focal_ppm_per_k": day.focal_ppm_per_k}),
        "image centre": replace(day, focal_ppm_per_k=0.0),
    }
    for part, one in parts.items():
        cells = []
        for pair in PAIRS:
            model = rig.cameras[rig.stereo[pair][0]].model
            cells.append(spread(moved_px(model, one.camera(model, False, warmer_k))))
        yield LifeRow("temperature", part, *cells)
    mount = np.array([[day.mount_pan_rad_per_k, day.mount_tilt_rad_per_k]]) * warmer_k
    yield LifeRow("temperature", "mount", *(spread(mount * px_per_rad(rig, pair)) for pair in PAIRS))


def moved_px(model: CameraModel, warm: CameraModel) -> Offs:
    """By how much far points of the whole picture move."""
    width, height = model.size_px
    grid = np.stack(np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 7)), axis=-1)
    rays = model.ray(grid.reshape(-1, 2))
    far, _ = warm.project(rays.origins_m + 1000.0 * rays.directions)
    return np.asarray(far - grid.reshape(-1, 2))


def only_of(cameras: Mapping[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    """The section with some keys alone, ``a.b`` for one of a part."""
    kept: dict[str, Any] = {}
    for key in keys:
        part, _, name = key.partition(".")
        if part in cameras and not name:
            kept[part] = cameras[part]
        elif name in cameras.get(part, {}):
            kept.setdefault(part, {})[name] = cameras[part][name]
    return kept


def pointed(trial: LightTrial) -> LightRow:
    """The pointing experiment on the packaged rover with such cameras."""
    folder = config_folder()
    config = yaml.safe_load((folder / "default.yaml").read_text())
    config["mast_file"] = str(folder / config["mast_file"])
    config["simulation"]["rover"] = str(folder / config["simulation"]["rover"])
    config["simulation"]["cameras"] = dict(trial.cameras)
    with tempfile.TemporaryDirectory() as where:
        file = Path(where, "config.yaml")
        file.write_text(yaml.safe_dump(config))
        command = [sys.executable, "-m", "mastctl", "demo", "--config", str(file), "--speed", "max", "--json"]
        out = str(Path(where, "out"))
        command += ["--targets", str(trial.targets), "--seed", str(trial.seed), "--out", out]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        distances = json.loads(done.stdout)["distances"]
    except (ValueError, KeyError):
        raise DriverError(f"the experiment with {trial.option} did not run: {done.stderr[-300:]}") from None

    def of_all(key: str) -> tuple[float, float]:
        x_px, y_px = np.sqrt(np.mean(np.square([distance[key] for distance in distances]), axis=0))
        return float(x_px), float(y_px)

    failed = sum(distance["failed"] for distance in distances)
    return LightRow(
        trial.option, of_all("first_rms_px"), of_all("second_rms_px"), of_all("true_second_rms_px"), failed
    )


if __name__ == "__main__":
    end(main)

"""How true panoramas are: clicked pixels, seams, and a joint that slipped, on the packaged rover.

    .venv/bin/python -m tools.campaigns.panorama [--cases 200] [--seed 1] [--json]

A scene of its own for each 20 cases: the daemon takes a panorama by the Navcams, then random pixels of the
mosaic that show something 2 to 10 m away are pointed at once each. Truth is the simulator's geometry, as in
`tools.campaigns.residuals`. Besides: the seams with the daemon's mast file, and what they say of a panorama
in which a reading is 1 mrad off from the middle view on.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.geometry.rigid import FloatArray
from drivers.sim.rover import RoverModel
from mastctl.client import Client
from mastctl.daemon import RunningDaemon
from mastctl.errors import MastctlError
from mastctl.panorama.compose import picture_at
from mastctl.panorama.folder import Folder
from tools.campaigns.residuals import FAR_M, LEFT, NEAR_M, RIGHT, TrueClick, config_of, hit, shown, summary
from tools.command import end, options, results_of, show

Angles = dict[int, tuple[float, float]]
A_SCENE = 20
FIELD: dict[str, Any] = {"pan_rad": (-1.1, 1.1), "tilt_rad": (-0.75, -0.1)}
SLIP_RAD = 1e-3
WAITED_S = 1800.0


@dataclass(frozen=True)
class Scene:
    """One panorama, and so many clicks."""

    seed: int
    number: int
    cases: int


@dataclass(frozen=True)
class Found:
    """What one scene showed: clicks, seams' rms (x, y, across, of matches), named slips."""

    clicks: list[TrueClick]
    seams_px: tuple[float, ...]
    slips: list[str]


def found_in(task: Scene) -> Found:
    """Take a panorama in a scene of its own, and click it."""
    rng = np.random.default_rng([task.seed, task.number, 3])
    config = config_of("kind", int(rng.integers(1, 2**31)))
    with tempfile.TemporaryDirectory() as state:
        config = replace(config, state_folder=Path(state))
        with RunningDaemon(config) as daemon, Client(daemon.url, timeout_s=120.0) as client:
            rover = daemon.hardware.simulation
            assert rover is not None
            folder = taken(client, Path(state))
            assert folder.index.whole is not None
            seams = (*folder.index.whole.rms_px, *folder.index.whole.across_px)
            true = true_angles(folder, rover)  # the simulator forgets them
            clicks = [click(client, rover, folder, true, rng) for _ in range(task.cases)]
            slips = [slipped(client, folder, axis) for axis in (0, 1)] if task.number == 0 else []
    return Found(clicks, seams, slips)


def taken(client: Client, state: Path) -> Folder:
    """Have a panorama taken and return it."""
    record = client.wait(client.take_panorama(pair="navcam", **FIELD), timeout_s=WAITED_S)
    assert record["state"] == "done", record["error"]
    return Folder(state / "panoramas" / str(record["request"]["panorama"]))


def true_angles(folder: Folder, rover: RoverModel) -> dict[int, tuple[float, float]]:
    """Where the joints truly stood at each view, by its number."""
    views = folder.index.taken()
    return {at: rover.true_joints(view.frames[LEFT].facts.mid_exposure_s) for at, view in views}


def click(
    client: Client, rover: RoverModel, folder: Folder, true: Angles, rng: np.random.Generator
) -> TrueClick:
    """Point once at a random pixel of the mosaic, and hold the residual against the truth."""
    (x, y), view, point = random_pixel(folder, rover, true, rng)
    hidden = not shown(rover, rover.rig.camera_in_rover(RIGHT, *true[view]), point)
    target = {"id": folder.index.id, "x_px": x, "y_px": y}
    record: Any = client.wait(client.point(panorama=target), timeout_s=WAITED_S)
    if record["state"] != "done":
        return TrueClick(hidden, record["error"]["code"] if record["error"] else record["state"])
    (row,) = record["pointings"]
    landed = client.snapshot(LEFT, frame_id=row["frame_id"])
    now = rover.rig.camera_in_rover(LEFT, *rover.true_joints(landed.mid_exposure_s))
    error_px = np.array(row["target_px"]) - now.project(point)[0]
    return TrueClick(hidden, "", (error_px[0], error_px[1]), tuple(row["residual_sigma_px"]))


def random_pixel(
    folder: Folder, rover: RoverModel, true: Angles, rng: np.random.Generator
) -> tuple[tuple[float, float], int, FloatArray]:
    """A random pixel of the mosaic that shows something in range, its view, and that point (rover frame)."""
    assert folder.index.mosaic is not None
    while True:
        x, y = (float(rng.uniform(0, side - 1)) for side in folder.index.mosaic.size_px)
        try:
            seen = picture_at(folder, (x, y))
        except MastctlError:  # no view shows it
            continue
        camera = rover.rig.camera_in_rover(LEFT, *true[seen.view])
        point = hit(rover, camera, seen.pixel_px[None])[0]
        if NEAR_M <= float(np.linalg.norm(point - camera.C)) <= FAR_M:
            return (x, y), seen.view, point


def slipped(client: Client, before: Folder, axis: int) -> str:
    """What the seams say where a reading is off from the middle view on."""
    operation, half = client.take_panorama(pair="navcam", **FIELD), len(before.index.views) // 2
    name = str(client.operation(operation)["request"]["panorama"])
    while sum(one["state"] == "taken" for one in client.panorama(name)["views"]) < half:
        client.advance(0.5)
    client.set_fault("pan_tilt", "wrong", offset_rad=-SLIP_RAD, axis=axis)
    client.wait(operation, timeout_s=WAITED_S)
    client.clear_faults()
    sentence = client.panorama(name).get("slip", {"sentence": "none"})["sentence"]
    return f"{('pan', 'tilt')[axis]} {1e3 * SLIP_RAD:+.2f} mrad: {sentence}"


COLUMNS = {
    "clicks": "{cases}", "refused, %": "{refused_percent:.0f}", "of these hidden": "{refused_hidden}",
    "z rms": "{z_rms:.2f}", "worst": "{worst_z:.1f}",
    "error rms, px": "{error_rms_px[0]:.3f}, {error_rms_px[1]:.3f}",
    "seams, px": "{seams_px[0]:.3f}, {seams_px[1]:.3f}",
    "across": "{seams_px[2]:.3f}", "matches": "{seams_px[3]:.3f}",
}  # fmt: skip


def main() -> int:
    """Take panoramas, click, and print a table or a document."""
    args = options(__doc__, 200, "clicks", as_json=True).parse_args()
    tasks = [
        Scene(args.seed, number, min(A_SCENE, args.cases - number * A_SCENE))
        for number in range(math.ceil(args.cases / A_SCENE))
    ]
    found = results_of(args, "scenes", found_in, tasks, "scene {0.number}".format)
    row = summary("kind", "panorama", [one for scene in found for one in scene.clicks])
    row["seams_px"] = np.sqrt(np.mean(np.square([scene.seams_px for scene in found]), axis=0)).tolist()
    row["slips"] = [one for scene in found for one in scene.slips]
    show(args, [row], COLUMNS, "slips")
    return 0


if __name__ == "__main__":
    end(main)

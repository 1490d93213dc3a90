"""Pictures of a still scene from a simulated head that looks round, with a true rig unlike the believed one.

Nothing of `calib.calibrate.scene` has a part in it: the head's joints err by what is told here, and the
simulator's renderer draws what its cameras then see.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np

from calib.calibrate.scene.terms import SceneView
from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid
from drivers.sim.optics.readout import Noise
from drivers.sim.render import Renderer
from drivers.sim.scene import SceneSettings, build_scene

RIG = Path(__file__).resolve().parents[1] / "configs" / "sim" / "rocky8.yaml"
NAVCAMS = ("navcam_left", "navcam_right")

Rest = tuple[float, float]
TrueAngles = Callable[[int, Rest], Rest]
"""Where the joints truly stand, by the rest's number and what they read."""


def navcams() -> Rig:
    """The packaged rover's mast with its two Navcams alone."""
    rig = load_rig(RIG).rig
    cameras = {name: rig.cameras[name] for name in NAVCAMS}
    return Rig("navcams", rig.mast, cameras, {"navcam": NAVCAMS})


def rests(rows: int, columns: int, span_rad: float) -> list[Rest]:
    """Where the head looks: rows of tilts from -0.15 rad down, pans to either side, there and back again."""
    tilts = -0.15 - 0.3 * np.arange(rows)
    pans = np.linspace(-span_rad / 2, span_rad / 2, columns)
    return [
        (float(pan), float(tilt))
        for row, tilt in enumerate(tilts)
        for pan in (pans if row % 2 == 0 else pans[::-1])
    ]


def pictures(
    true: Rig,
    looked: list[Rest],
    angles: TrueAngles,
    seed: int,
    noise_dn: float = 1.5,
    moved: Callable[[int], Rigid] = lambda _: Rigid.identity(),
) -> Iterator[SceneView]:
    """Yield what the head cameras of a true rig see, with the angles that the joints read.

    ``moved`` says where the rover stands at a rest, in its first place's frame.
    """
    renderer = _renderer(seed)
    for pose, rest in enumerate(looked):
        site_from_head = moved(pose) @ true.mast.rover_from_head(*angles(pose, rest))
        for name, camera in true.cameras.items():
            light = renderer.image(camera.model, site_from_head, 2)
            noise = Noise(noise_dn, noise_dn, seed, name)
            image: FloatArray = noise.levels(light, noise.sigma_dn(light), pose).astype(np.float32)
            yield SceneView(f"{name} {pose}", name, image, *rest, pose)


@cache
def _renderer(seed: int) -> Renderer:
    return Renderer(build_scene(SceneSettings(seed=seed)), workers=1)

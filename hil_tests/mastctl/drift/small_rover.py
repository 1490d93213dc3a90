"""A daemon on a simulated rover of two small Navcams, and changes of what is true that it is not given."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from mastctl.config import Listen, load_config
from mastctl.daemon import RunningDaemon

BY = 2
"""The Navcams have so many times fewer pixels along each side."""

RESTS = ("-1.2,-0.3", "0.0,-0.35", "1.2,-0.3")


def small(rig: Rig) -> Rig:
    """The Navcams alone, in fewer pixels."""
    cameras = {}
    for name in ("navcam_left", "navcam_right"):
        one = rig.cameras[name]
        cameras[name] = replace(one, model=smaller(one.model, BY))
    return replace(rig, cameras=cameras, stereo={"navcam": rig.stereo["navcam"]})


@contextmanager
def small_rover(repository: Path, folder: Path) -> Iterator[RunningDaemon]:
    """A running daemon; what is true differs from its mast file as on the packaged rover."""
    config = load_config(repository / "configs/default.yaml")
    save_rig(small(load_rig(config.mast_file).rig), folder / "mast.yaml")
    save_rig(small(load_rig(repository / "configs/sim/rocky8.yaml").rig), folder / "true.yaml")
    hardware = config.hardware
    changes = {"speed": "max", "samples": 1, "rover": str(folder / "true.yaml")}
    cameras = {name: one for name, one in hardware.cameras.items() if name.startswith("navcam")}
    hardware = replace(hardware, simulation={**hardware.simulation, **changes}, cameras=cameras)
    config = replace(
        config,
        listen=Listen(port=0),
        mast_file=folder / "mast.yaml",
        hardware=hardware,
        state_folder=folder / "state",
    )
    with RunningDaemon(config) as daemon:
        yield daemon


@contextmanager
def truly(daemon: RunningDaemon, rig: Rig) -> Iterator[None]:
    """Another true rig inside the block."""
    rover = daemon.service.hardware.simulation
    assert rover is not None
    before, rover.rig = rover.rig, rig
    try:
        yield
    finally:
        rover.rig = before


def smaller(model: CameraModel, by: int) -> CameraModel:
    """The same view in ``by`` times fewer pixels along each side; (0, 0) is the middle of the first pixel."""
    width, height = model.size_px
    h, v = (vector / by + (0.5 / by - 0.5) * model.A for vector in (model.H, model.V))
    return replace(model, size_px=(width // by, height // by), H=h, V=v)

"""A daemon on a simulated rover of two small Navcams, and changes of what is true that nobody tells it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import rot_y
from hil_tests.support.feature_days import ChangedRig, about
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


def bumped(rig: Rig, camera: str, turn_rad: tuple[float, float, float]) -> Rig:
    """A camera turned about its own place, by small angles about x, y, z of the head."""
    return _with(rig, camera, ChangedRig(turned={camera: np.array(turn_rad)}))


def _with(rig: Rig, camera: str, truth: ChangedRig) -> Rig:
    one = rig.cameras[camera]
    model = changed(one.model, camera, truth)
    return replace(rig, cameras={**rig.cameras, camera: replace(one, model=model)})


def slipped(rig: Rig, pan_rad: float, tilt_rad: float) -> Rig:
    """All that hangs on the head turned against its joints, as by a horn that slipped on its shaft."""
    # pan stands upstream of tilt: what the pan's horn turns is the mast itself
    mast = replace(rig.mast, rotation_rad=rig.mast.rotation_rad + np.array([0.0, 0.0, pan_rad]))
    turn = rot_y(tilt_rad)
    cameras = {}
    for name, one in rig.cameras.items():
        vectors = {letter: turn @ getattr(one.model, letter) for letter in "CAHVO"}
        cameras[name] = replace(one, model=replace(one.model, **vectors)) if one.on == "head" else one
    return replace(rig, mast=mast, cameras=cameras)


def changed(model: CameraModel, eye: str, truth: ChangedRig) -> CameraModel:
    """A camera of the head as a change leaves it: turned about its own place, its focal length another."""
    t = truth.turned.get(eye, np.zeros(3))
    turn = about(2, t[2]) @ about(1, t[1]) @ about(0, t[0])
    longer = 1.0 + truth.focal.get(eye, 0.0)
    vectors = {}
    for letter in "HV":
        vector = getattr(model, letter)
        along = float(model.A @ vector) * model.A
        vectors[letter] = turn @ (along + longer * (vector - along))
    vectors |= {"A": turn @ model.A, "O": turn @ model.O}
    return replace(model, **vectors)


def smaller(model: CameraModel, by: int) -> CameraModel:
    """The same view in ``by`` times fewer pixels along each side; (0, 0) is the middle of the first pixel."""
    width, height = model.size_px
    h, v = (vector / by + (0.5 / by - 0.5) * model.A for vector in (model.H, model.V))
    return replace(model, size_px=(width // by, height // by), H=h, V=v)

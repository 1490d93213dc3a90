"""The same cameras with fewer pixels: pictures that are quickly drawn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from calib.errors import BadFile
from calib.files.mast_file import load_rig, save_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from drivers.errors import BadOptions
from mastctl.config import Config

NARROWEST_PX = 64
WIDEST_PX = 4096


def with_width(config: Config, width_px: int, folder: Path) -> Config:
    """Return a configuration whose cameras, as believed and as they truly are, have pictures of a width.

    They see what they saw before, in as many more or fewer pixels. Both mast files are written into
    ``folder``.

    Raises
    ------
    BadOptions
        For a width that is none, or a true rig that cannot be read.
    BadFile
        For a mast file that cannot be read.
    """
    if isinstance(width_px, bool) or not isinstance(width_px, int) or not 64 <= width_px <= WIDEST_PX:
        raise BadOptions(
            f"picture_width_px is {width_px!r}, expected a whole number from {NARROWEST_PX} to {WIDEST_PX}"
        )
    hardware = config.hardware
    true_rig = hardware.simulation.get("rover")
    if not isinstance(true_rig, str):
        return config  # the simulation says what is wrong
    try:
        truth = load_rig(hardware.folder / true_rig).rig
    except BadFile as error:
        raise BadOptions(f"simulation.rover: {error}") from None
    belief = load_rig(config.mast_file).rig
    save_rig(_narrowed(truth, width_px), folder / "true_rig.yaml")
    save_rig(_narrowed(belief, width_px), folder / "mast.yaml")
    simulation = {**hardware.simulation, "rover": str(folder / "true_rig.yaml")}
    return replace(config, mast_file=folder / "mast.yaml", hardware=replace(hardware, simulation=simulation))


def _narrowed(rig: Rig, width_px: int) -> Rig:
    """A rig with pictures of a width; without residuals and covariance: those were of other pixels."""
    cameras = {
        name: replace(camera, model=resized(camera.model, width_px)) for name, camera in rig.cameras.items()
    }
    return replace(rig, cameras=cameras, fit={})


def resized(model: CameraModel, width_px: int) -> CameraModel:
    """Return a camera that sees the same in pictures of another width, and of the height that goes with it.

    The edges of the picture stay where they are: x + 1/2 grows by the factor, as the centre of the first
    pixel is 0. H and V are linear in the pixels: H' = s H + (s - 1)/2 A.
    """
    width, height = model.size_px
    size_px = (width_px, max(1, round(height * width_px / width)))
    across, down = size_px[0] / width, size_px[1] / height
    return replace(
        model,
        size_px=size_px,
        H=across * model.H + (across - 1.0) / 2.0 * model.A,
        V=down * model.V + (down - 1.0) / 2.0 * model.A,
    )

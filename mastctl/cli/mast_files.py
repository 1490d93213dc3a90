"""What commands on mast and camera files share: reading them, and finding in them what the options name."""

from __future__ import annotations

import argparse
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from mastctl.cli import output

if TYPE_CHECKING:
    from calib.files import CameraFile
    from calib.files.mast_file import StoredRig
    from calib.geometry.rig import Rig


def read_mast_file(path: Path) -> StoredRig:
    """Read a mast file, with its notes on stderr, for stdout holds the result."""
    from calib.files.mast_file import load_rig

    stored = load_rig(path)
    tell_notes(stored.notes)
    return stored


def tell_notes(notes: Iterable[str]) -> None:
    """Write on stderr what reading a file changed."""
    for note in notes:
        output.tell(note)


def camera_name(stored: StoredRig, name: str | None) -> str:
    """Return the camera of this name, the only one by default. Raises WrongUse."""
    cameras = stored.rig.cameras
    if name is None and len(cameras) == 1:
        return next(iter(cameras))
    if not cameras:
        raise output.WrongUse(f"{stored.path} holds no camera")
    if name is None:
        raise output.WrongUse(
            f"{stored.path} holds several cameras; --camera with one of {', '.join(cameras)}"
        )
    if name not in cameras:
        raise output.WrongUse(f"no camera '{name}' in {stored.path}; {nearest_of(name, cameras)}")
    return name


def stereo_pair(stored: StoredRig, name: str) -> tuple[str, str]:
    """Return the cameras (left, right) of a stereo pair. Raises WrongUse."""
    stereo = stored.rig.stereo
    if name not in stereo:
        raise output.WrongUse(f"no stereo pair '{name}' in {stored.path}; {nearest_of(name, stereo)}")
    return stereo[name]


def need_joints(rig: Rig, name: str, args: argparse.Namespace) -> None:
    """Refuse a camera on the head without --pan and --tilt. Raises WrongUse."""
    if rig.cameras[name].on == "head" and (args.pan is None or args.tilt is None):
        raise output.WrongUse(f"camera '{name}' is on the head; --pan RAD and --tilt RAD are expected")


def nearest_of(name: str, known: Collection[str]) -> str:
    """Return the nearest of the known names, or all, as a hint."""
    from calib.files.yaml_text import nearest

    return nearest(name, list(known)) if known else "it has none"


def chosen_camera(path: Path, name: str | None) -> tuple[str, CameraFile]:
    """Return the camera of a file that is meant, and its name. Raises WrongUse and BadFile."""
    from calib.files.any_camera import load_any

    found, camera = camera_of(load_any(path), name)
    tell_notes(camera.notes)
    return found, camera


def camera_of(
    source: StoredRig | CameraFile | dict[str, CameraFile], name: str | None
) -> tuple[str, CameraFile]:
    """Return the camera that is meant, and its name. Raises WrongUse."""
    from calib.files import CameraFile

    if isinstance(source, CameraFile):
        _refuse_name(name)
        return "camera", source
    if isinstance(source, dict):
        path = next(iter(source.values())).path
        if name is None:
            raise output.WrongUse(f"{path} holds several cameras; --camera with one of {', '.join(source)}")
        if name not in source:
            raise output.WrongUse(f"no camera '{name}' in {path}; {nearest_of(name, source)}")
        return name, source[name]
    name = camera_name(source, name)
    camera = source.rig.cameras[name]
    provenance = {"mast_file_sha256": source.digest, **source.rig.provenance}
    left_out = ("the mast file's 'fit' is left out",) if source.rig.fit else ()
    return name, CameraFile(camera.model, camera.on, {}, provenance, source.notes + left_out)


def _refuse_name(name: str | None) -> None:
    """Refuse --camera where the file holds one camera without a name."""
    if name is not None:
        raise output.WrongUse("the file holds one camera without a name; leave --camera out")

"""The camera that a command means, of a file of any format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mastctl.cli import output
from mastctl.cli.mast_files import camera_name, nearest_of, tell_notes

if TYPE_CHECKING:
    from calib.files import CameraFile
    from calib.files.any_camera import CameraFiles
    from calib.files.mast_file import StoredRig


def chosen_camera(path: Path, name: str | None) -> tuple[str, CameraFile]:
    """Return the camera of a file that is meant, and its name, notes told. Raises WrongUse and BadFile."""
    from calib.files.any_camera import load_any

    found, camera = camera_of(load_any(path), name)
    tell_notes(camera.notes)
    return found, camera


def camera_of(source: StoredRig | CameraFile | CameraFiles, name: str | None) -> tuple[str, CameraFile]:
    """Return the camera that is meant, and its name. Raises WrongUse."""
    from calib.files import CameraFile
    from calib.files.any_camera import CameraFiles

    if isinstance(source, CameraFile):
        _refuse_name(name)
        return "camera", source
    if isinstance(source, CameraFiles):
        cameras = source.cameras
        if name is None:
            raise output.WrongUse(
                f"{source.path} holds several cameras; --camera with one of {', '.join(cameras)}"
            )
        if name not in cameras:
            raise output.WrongUse(f"no camera '{name}' in {source.path}; {nearest_of(name, cameras)}")
        return name, cameras[name]
    name = camera_name(source, name)
    camera = source.rig.cameras[name]
    provenance = {"mast_file_sha256": source.digest, **source.rig.provenance}
    left_out = ("the mast file's 'fit' is left out",) if source.rig.fit else ()
    return name, CameraFile(camera.model, camera.on, {}, provenance, source.notes + left_out)


def _refuse_name(name: str | None) -> None:
    """Refuse --camera where the file holds one camera without a name."""
    if name is not None:
        raise output.WrongUse("the file holds one camera without a name; leave --camera out")

"""A recording as a configuration: its mast file, its limits, its frames through the replay driver."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from calib.files.yaml_text import dump_mapping, parse_mapping
from drivers.recordings.mcap_file import BadRecording
from mastctl.recorder.recorded import Recording

SPEED_RAD_PER_S = 1.0
WHOLE_TURN_RAD = 6.2832


def replay_files(recording: Recording, folder: Path, listen: dict[str, Any]) -> Path:
    """Write the mast file and a configuration that serves a recording; return the configuration's path.

    Parameters
    ----------
    recording
        With at least one picture of a head at rest.
    folder
        Where both are written.
    listen
        The configuration's section of that name.

    Raises
    ------
    BadRecording
        If no mast file is attached, or there is no picture that a camera of it took.
    OSError
        If the folder cannot be written.
    """
    mast, stored = recording.first_mast
    known = {str(frame.facts["camera"]) for frame in recording.frames.values()} & set(stored.rig.cameras)
    if not known:
        raise BadRecording(f"{recording.path}: holds no picture that could be served")
    name = Path(mast.name).name or "mast.yaml"
    (folder / name).write_bytes(mast.data)
    device = {"driver": "replay", "options": {"recording": str(recording.path.resolve())}}
    config = {
        "schema": "mastctl/config/1",
        "mast_file": name,
        "listen": listen,
        "pan_tilt": device,
        "cameras": {camera: device for camera in stored.rig.cameras if camera in known},
        "limits": _limits(recording),
    }
    path = folder / "replay.yaml"
    path.write_bytes(dump_mapping(config))
    return path


def _limits(recording: Recording) -> dict[str, Any]:
    """Those of the attached configuration; a whole turn either way without one."""
    if recording.config is not None:
        limits = parse_mapping(recording.config.data, recording.config.name).get("limits")
        if isinstance(limits, dict):
            return limits
    turn = [-WHOLE_TURN_RAD, WHOLE_TURN_RAD]
    return {"pan_rad": turn, "tilt_rad": turn, "speed_rad_per_s": SPEED_RAD_PER_S}

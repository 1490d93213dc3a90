"""The folder of a new simulated rig: configuration, the mast file that is believed, the rig that is true."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.files.atomic import save_bytes
from calib.files.mast_file import load_rig, save_rig
from calib.files.yaml_text import dump_mapping
from calib.geometry.rig import Rig
from drivers.sim.axis import AxisSettings
from drivers.sim.heads import DEFAULT_HEADS, PRESETS
from mastctl.calibration.mast_file import rounded_matrix
from mastctl.config import CONFIG_SCHEMA, check_cameras, load_config
from mastctl.errors import MastctlError
from mastctl.packaged import driver_of_hardware, name_schema
from mastctl.setup.true_twin import STATED, Twin, true_twin, usual_covariance

CONFIG, MAST, TRUE_RIG = "config.yaml", "mast.yaml", "true_rig.yaml"

USUAL_LIMITS_RAD = ((-2.6, 2.6), (-1.2, 0.5))
MARGIN_RAD = 0.05
"""Between the soft limits and the ends of the head's range."""


class InTheWay(MastctlError):
    """Files of a rig are there already."""

    code = "in_the_way"
    exit_code = 2


@dataclass(frozen=True)
class NewRig:
    """A folder that was written, and what is in it."""

    folder: Path
    believed: Rig
    twin: Twin


def boards_about(count: int) -> list[dict[str, float]]:
    """Return so many dot boards for ``simulation.scene.boards``, by turns 3 and 5 m ahead."""
    apart_rad = min(0.5, 2.4 / max(count, 1))
    bearings = [(k - (count - 1) / 2) * apart_rad for k in range(count)]
    return [
        {
            "x_m": round((3.0, 5.0)[k % 2] * math.cos(bearing), 3),
            "y_m": round((3.0, 5.0)[k % 2] * math.sin(bearing), 3),
            "raised_m": (0.1, 0.6)[k % 2],
        }
        for k, bearing in enumerate(bearings)
    ]


def check_empty(folder: Path, force: bool) -> None:
    """Refuse a folder that holds files of a rig, unless they may be replaced. Raises InTheWay."""
    for name in (CONFIG, MAST, TRUE_RIG):
        if (folder / name).exists() and not force:
            raise InTheWay(f"{folder / name} exists; another folder, or --force to replace it, is expected")


def write_built(
    rig: Rig,
    folder: Path,
    simulation: Mapping[str, Any],
    seed: int,
    limits_rad: Sequence[Sequence[float]] = USUAL_LIMITS_RAD,
) -> NewRig:
    """Write a rig made of numbers, believed as a usual calibration leaves it. Raises as `write_twin`.

    ``limits_rad`` are the soft limits of pan and tilt that are wanted, within what the head reaches.
    """
    known = usual_covariance(rig)
    fit = {
        "method": "stated",
        "stated": STATED,
        "parameters": list(known.names),
        "covariance": rounded_matrix(known.covariance),
    }
    source = {"kind": "made by mastctl rig sim new from numbers", "seed": seed}
    believed = replace(rig, fit=fit, provenance=source)
    folder.mkdir(parents=True, exist_ok=True)
    save_rig(believed, folder / MAST)
    name_schema(folder / MAST, "mast")
    return _write(believed, folder, simulation, seed, limits_rad)


def write_twin(file: Path, folder: Path, simulation: Mapping[str, Any], seed: int) -> NewRig:
    """Write a mast file, to the byte, and a true rig that it could be the calibration of.

    Raises BadFile, BadOptions for ``simulation``, and as `true_twin` if no true rig can be drawn.
    """
    believed = load_rig(file)
    data = file.read_bytes()
    true_twin(believed.rig, np.random.default_rng(seed))  # before anything is written
    folder.mkdir(parents=True, exist_ok=True)
    save_bytes(folder / MAST, data)
    return _write(believed.rig, folder, simulation, seed)


def _write(
    believed: Rig,
    folder: Path,
    simulation: Mapping[str, Any],
    seed: int,
    limits_rad: Sequence[Sequence[float]] = USUAL_LIMITS_RAD,
) -> NewRig:
    """Write the true rig and the configuration, and read all of it as the daemon does."""
    from drivers.sim.settings import simulation_settings

    twin = true_twin(believed, np.random.default_rng(seed))
    stated = "" if twin.by == "fit.covariance" else f": {STATED}"
    provenance = {
        "kind": "the true rig of a simulated rover, which the service never reads",
        "drawn": f"about {MAST} by {twin.by}{stated}",
        "seed": seed,
    }
    true_rig = replace(twin.true_rig, name=f"{believed.name}_true", fit={}, provenance=provenance)
    save_rig(true_rig, folder / TRUE_RIG)
    save_bytes(folder / CONFIG, dump_mapping(_configuration(believed, simulation, limits_rad)))
    for name, kind in ((TRUE_RIG, "mast"), (CONFIG, "config")):
        name_schema(folder / name, kind)
    config = load_config(folder / CONFIG)
    check_cameras(config, load_rig(config.mast_file).rig)
    simulation_settings(config.hardware.simulation, config.hardware.folder)
    return NewRig(folder, believed, twin)


def _configuration(
    rig: Rig, simulation: Mapping[str, Any], limits_rad: Sequence[Sequence[float]]
) -> dict[str, Any]:
    """The configuration that runs the rig: every camera simulated, soft limits inside the head's range."""
    wire = simulation.get("wire")
    head = PRESETS[simulation.get("head", DEFAULT_HEADS.get(str(wire), "ptu_d46_70"))]
    pan_rad, tilt_rad = (
        _limits(axis, usual) for axis, usual in zip((head.pan, head.tilt), limits_rad, strict=True)
    )
    speed = min(1.0, head.pan.speed_rad_per_s, head.tilt.speed_rad_per_s)
    simulated = driver_of_hardware("simulated")
    return {
        "schema": CONFIG_SCHEMA,
        "mast_file": MAST,
        "listen": {"host": "127.0.0.1", "port": 8420},
        "pan_tilt": {"driver": simulated},
        "cameras": {name: {"driver": simulated} for name in rig.cameras},
        "limits": {"pan_rad": pan_rad, "tilt_rad": tilt_rad, "speed_rad_per_s": speed},
        "simulation": {"rover": TRUE_RIG, **simulation},
    }


def _limits(axis: AxisSettings, usual: Sequence[float]) -> list[float]:
    """Soft limits of an axis."""
    margin_rad = MARGIN_RAD + axis.approach_rad
    return [
        round(max(usual[0], axis.low_rad + margin_rad), 3),
        round(min(usual[1], axis.high_rad - margin_rad), 3),
    ]

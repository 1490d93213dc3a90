"""Scenes that were built before: read from disk in no time, their pages shared by all processes."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from drivers.sim import ground, placed, rocks, scene
from drivers.sim.compiled import kernels
from drivers.sim.kept import digest_of, keep_newest, kept_folder
from drivers.sim.scene import Scene, SceneSettings, build_scene

FACTS = "scene.json"


def kept_scene(settings: SceneSettings) -> Scene:
    """Return what `build_scene` returns, from disk if it was built before by the same sources.

    A scene that cannot be read, or is damaged, is built and written again; where nothing can be written, it
    is built each time. Raises what `build_scene` raises.
    """
    folder = folder_of(settings)
    try:
        found = read(folder, settings)
    except (OSError, ValueError, KeyError, TypeError):  # not there, or not whole
        found = build_scene(settings)
        with contextlib.suppress(OSError):
            write(folder, found)
            keep_newest(folder)
    return found


def folder_of(settings: SceneSettings) -> Path:
    """Return where a scene is kept: under the digest of its settings and of all that makes it."""
    modules = (ground, placed, rocks, scene, kernels())
    makers = digest_of(Path(str(module.__file__)) for module in modules)
    words = (repr(settings), makers, np.__version__, scipy.__version__)
    return kept_folder("scenes", hashlib.sha256("\n".join(words).encode()).hexdigest())


def write(folder: Path, made: Scene) -> None:
    """Write a scene, whole or not at all: numbers to one file, each array to one of its own."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(dir=folder.parent))
    try:
        facts: dict[str, float | int] = {}
        for name, value in parts(made.world, "world"):
            if isinstance(value, np.ndarray):
                np.save(scratch / f"{name}.npy", value)
            else:
                facts[name] = value
        (scratch / FACTS).write_text(json.dumps(facts))
        shutil.rmtree(folder, ignore_errors=True)  # what is there was not good
        scratch.replace(folder)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def parts(value: Any, name: str) -> list[tuple[str, Any]]:
    """Return names and values of all arrays and numbers in tuples in tuples."""
    if not hasattr(value, "_fields"):
        return [(name, value)]
    return [part for field in value._fields for part in parts(getattr(value, field), f"{name}.{field}")]


def read(folder: Path, settings: SceneSettings) -> Scene:
    """Return a scene that was written; any of the errors that `kept_scene` knows if it is not whole."""
    facts = json.loads((folder / FACTS).read_text())
    module = kernels()
    kinds = {"inner": module.Grid, "outer": module.Grid, "rocks": module.Rocks}

    def part(name: str) -> Any:
        # private pages: a process that writes into one gets a copy of its own
        return facts[name] if name in facts else np.asarray(np.load(folder / f"{name}.npy", mmap_mode="c"))

    def of_world(field: str) -> Any:
        if field == "sun":
            return part("world.sun")
        kind = kinds.get(field, module.Texture)
        return kind(*(part(f"world.{field}.{name}") for name in kind._fields))

    world = module.World(*(of_world(field) for field in module.World._fields))
    with contextlib.suppress(OSError):
        os.utime(folder)  # used last
    return Scene(settings, world)

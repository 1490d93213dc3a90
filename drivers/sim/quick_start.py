"""What lets a simulated rover start soon: scenes that were built before, and another process that compiles.

A scene that was built before is read from disk in no time, and its pages are shared by all its users. What
draws pictures takes most of the compiling: another process does it while this one makes the scene.

    python -m drivers.sim.quick_start

compiles it into the folder where compiled code is kept, for as long as its stdin is open. However many of
these run at once, as for the workers of a test run, it is compiled once: the others wait, and find it.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from drivers.sim import boards, ground, placed, rocks, scene
from drivers.sim.kept import digest_of, is_compiled, keep_newest, kept_folder, kernels
from drivers.sim.render import compile_drawing
from drivers.sim.rocks import Brick
from drivers.sim.scene import Scene, SceneSettings, build_scene

FACTS = "scene.json"

PATIENCE_S = 120.0
"""After so long it is left to this process."""

_compiling: list[subprocess.Popen[bytes]] = []
"""The process that compiles for this one, as long as a block wants it."""


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
    modules = (boards, ground, placed, rocks, scene)
    makers = digest_of(Path(str(module.__file__)) for module in modules), kernels().SOURCES
    words = (repr(settings), *makers, np.__version__, scipy.__version__)
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
        np.save(
            scratch / "bricks.npy", np.array([brick.corners_m for brick in made.bricks]).reshape(-1, 8, 3)
        )
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
    kinds = {"inner": module.Grid, "outer": module.Grid, "rocks": module.Rocks, "boards": module.Boards}

    def part(name: str) -> Any:
        # private pages: a process that writes into one gets a copy of its own
        return facts[name] if name in facts else np.asarray(np.load(folder / f"{name}.npy", mmap_mode="c"))

    def of_world(field: str) -> Any:
        if field == "sun":
            return part("world.sun")
        kind = kinds.get(field, module.Texture)
        return kind(*(part(f"world.{field}.{name}") for name in kind._fields))

    world = module.World(*(of_world(field) for field in module.World._fields))
    corners_m = np.load(folder / "bricks.npy")
    with contextlib.suppress(OSError):
        os.utime(folder)  # used last
    return Scene(settings, world, tuple(Brick(one) for one in corners_m))


@contextlib.contextmanager
def drawing_compiled_beside() -> Iterator[None]:
    """Let another process compile what draws while the block runs, and wait for it at its end.

    A block inside another one waits for the process of the outer one: whoever knows early that pictures will
    be drawn has it begin before the rest is imported. Nothing happens where it is compiled already, where
    there is one processor only, or where nothing can be kept. Whether it went well or not,
    `drivers.sim.render.compile_renderer` has to follow.
    """
    mine = [] if _compiling or is_compiled() else _begun()
    _compiling.extend(mine)
    try:
        yield
        for beside in tuple(_compiling):
            with contextlib.suppress(subprocess.TimeoutExpired):
                beside.wait(PATIENCE_S)
    finally:
        for beside in mine:
            _compiling.remove(beside)
            assert beside.stdin is not None
            beside.stdin.close()
            beside.kill()
            beside.wait()


def _begun() -> list[subprocess.Popen[bytes]]:
    """The process that compiles; none where it is of no use."""
    if len(os.sched_getaffinity(0)) < 2 or not sys.executable:
        return []
    folder = _folder()
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        return []
    command = [sys.executable, "-P", "-m", "drivers.sim.quick_start"]
    path = os.pathsep.join(str(Path(place).absolute()) for place in sys.path)
    try:
        beside = subprocess.Popen(
            command,
            env={**os.environ, "PYTHONPATH": path},
            stdin=subprocess.PIPE,  # it ends with whoever holds the other end
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the one who waits
        )
    except OSError:
        return []
    return [beside]


def _folder() -> Path:
    """Where compiled code is kept."""
    return Path(kernels().render_tiles.stats.cache_path)


def _ends_with_its_maker() -> None:
    """End when nobody waits any more."""
    while os.read(0, 1):
        pass
    os._exit(1)


def main() -> None:
    """Compile what draws, if nobody else has."""
    gc.disable()  # a tenth less to do, for 100 MB of a process that ends soon
    threading.Thread(target=_ends_with_its_maker, daemon=True).start()
    with (_folder() / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # goes with the process, however it ends
        compile_drawing()


if __name__ == "__main__":
    main()

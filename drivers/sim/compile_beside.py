"""What draws pictures takes most of the compiling: another process does it while this one makes the scene.

    python -m drivers.sim.compile_beside

compiles it into the folder where compiled code is kept, for as long as its stdin is open. However many of
these run at once, as for the workers of a test run, it is compiled once: the others wait, and find it.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from drivers.sim.compiled import is_compiled, kernels
from drivers.sim.render import compile_drawing

PATIENCE_S = 120.0
"""After so long it is left to this process."""


_compiling: list[subprocess.Popen[bytes]] = []
"""The process that compiles for this one, as long as a block wants it."""


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
    command = [sys.executable, "-P", "-m", "drivers.sim.compile_beside"]
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

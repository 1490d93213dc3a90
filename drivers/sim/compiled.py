"""The one place that loads numba: says when it is missing, and whether compiling is still to come."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

from drivers.errors import BadOptions


def kernels() -> ModuleType:
    """Return the module of compiled functions.

    Raises
    ------
    BadOptions
        If numba is not installed.
    """
    try:
        return importlib.import_module("drivers.sim.kernels")
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in ("numba", "llvmlite"):
            raise
        raise BadOptions("the simulated rover needs numba: pip install 'mastctl[sim]'") from error


def is_compiled() -> bool:
    """Return whether the renderer starts at once: compiled in this process, or on disk and up to date.

    When it does not, the first scene takes some ten to twenty seconds of compiling.

    Raises
    ------
    BadOptions
        If numba is not installed.
    """
    module = kernels()
    source_time_s = Path(str(module.__file__)).stat().st_mtime
    for name in ("render_tiles", "cast_rays", "shadow_rays", "lay_pebbles"):
        function = getattr(module, name)
        if function.signatures:
            continue
        folder = function.stats.cache_path
        indexes = list(Path(folder).glob(f"kernels.{name}-*.nbi")) if folder else []
        if not any(index.stat().st_mtime >= source_time_s for index in indexes):
            return False
    return True

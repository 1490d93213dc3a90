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
    for function in kernels().ENTRIES:
        folder = Path(function.stats.cache_path)
        if not function.signatures and not any(folder.glob(f"*.{function.__name__}-*.nbi")):
            return False
    return True

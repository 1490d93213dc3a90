"""Loads the compiled functions: importing numba takes long, and it may not be installed."""

from __future__ import annotations

from types import ModuleType

from drivers.errors import BadOptions


def kernels() -> ModuleType:
    """Return the module of compiled functions. Raises BadOptions if numba is not installed."""
    try:
        import drivers.sim.kernels as module
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in ("numba", "llvmlite"):
            raise
        raise BadOptions("the simulated rover needs numba: pip install 'mastctl[sim]'") from error
    return module

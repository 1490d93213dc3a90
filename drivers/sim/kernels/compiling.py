"""How the functions of this room are compiled, and where what was compiled is kept.

numba keeps compiled code beside the source by default and looks only at the file of the function called, not
at the files of what that calls. Here the digest of the whole room decides, so that a changed part is never
missed and a fresh installation of the same sources finds what an earlier one compiled.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import caching as numba_caching

from drivers.sim.kept import digest_of, keep_newest, kept_folder

log = logging.getLogger(__name__)

caching: Any = numba_caching
Function = TypeVar("Function", bound=Callable[..., Any])

SOURCES = digest_of(Path(__file__).parent.glob("*.py"))


class CodePlace:
    """What numba asks for the folder of a function's compiled code."""

    def __init__(self, function: Any) -> None:
        self._line = function.__code__.co_firstlineno
        self.folder = kept_folder("compiled", SOURCES)

    @classmethod
    def from_function(cls, function: Any, _file: str) -> CodePlace:
        """Return the place of a function; there is one for every function."""
        return cls(function)

    def ensure_cache_path(self) -> None:
        """Make the folder, if need be."""
        self.folder.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        """Return the folder."""
        return str(self.folder)

    def get_source_stamp(self) -> str:
        """Return what has to be the same for compiled code to be good."""
        return SOURCES

    def get_disambiguator(self) -> str:
        """Return what tells functions of one name apart."""
        return str(self._line)


class _Implementation(caching.CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = (CodePlace,)


class KeptCode(caching.FunctionCache):  # type: ignore[misc]
    """Compiled code on disk; a folder that cannot be written is read, and nothing is added to it."""

    _impl_class = _Implementation

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the compiled function, or None."""
        try:
            return super().load_overload(signature, target_context)
        except OSError:
            return None
        except (EOFError, ValueError, pickle.UnpicklingError):  # damaged
            with contextlib.suppress(OSError):
                self.flush()
            return None

    def save_overload(self, signature: Any, data: Any) -> None:
        """Keep the compiled function, if that can be done."""
        try:
            super().save_overload(signature, data)
            keep_newest(Path(self.cache_path))
        except OSError as error:
            _say_once(self.cache_path, error.strerror)


@functools.cache
def _say_once(folder: str, reason: str | None) -> None:
    """Say that the next start compiles again."""
    log.warning(
        "cannot write to %s (%s): the simulator compiles at every start; XDG_CACHE_HOME names another folder",
        folder,
        reason,
    )


_ALL: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_INSIDE = {**_ALL, "no_cpython_wrapper": True}  # packing and unpacking a world is much code, for nobody


def entry(function: Function) -> Function:
    """Compile what Python calls, without the interpreter lock; kept on disk."""
    made: Any = numba.njit(**_ALL)(function)
    made._cache = KeptCode(function)
    return cast(Function, made)


def part(function: Function) -> Function:
    """Compile what only other compiled functions call."""
    return cast(Function, numba.njit(**_INSIDE)(function))


def inlined(function: Function) -> Function:
    """Compile into the callers."""
    return cast(Function, numba.njit(**_INSIDE, forceinline=True)(function))

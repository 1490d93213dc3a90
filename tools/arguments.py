"""What the tools share: arguments that make sense, and one sentence instead of a traceback."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Callable
from pathlib import Path

from calib.errors import CalibError
from drivers.errors import DriverError
from mastctl import signals
from mastctl.cli.output import CommandError, as_command_error, one_line
from mastctl.errors import MastctlError


def new_file(text: str) -> Path:
    """Read the name of a file that can be written, before minutes are spent on it (argparse ``type``)."""
    path = Path(text)
    try:
        path.touch()
    except OSError as error:
        raise argparse.ArgumentTypeError(f"{path}: {error.strerror}") from None
    return path


def end(main: Callable[[], int | None]) -> None:
    """Run a tool and exit with its code; a signal ends it in order, with its folders and processes.

    A refusal of the project's own is one sentence and the exit code that `mastctl` has for it; a file that
    cannot be read or written is one sentence and 2. What refuses in its own way carries its exit code.
    """
    try:
        with signals.raised():
            sys.exit(_by_its_name(main)())
    except signals.Ended as ended:
        sys.exit(128 + ended.number)
    except (CalibError, DriverError, MastctlError, CommandError) as error:
        words, code = str(error), as_command_error(error).exit_code
    except OSError as error:
        if error.filename is None:
            raise
        words, code = f"{error.filename}: {error.strerror}", 2
    sys.stderr.write(f"{one_line(words)}\n")
    sys.exit(code)


def _by_its_name(main: Callable[[], int | None]) -> Callable[[], int | None]:
    """The same function of the module's own name: tasks and results travel by it, and by no ``__main__``."""
    spec = main.__globals__.get("__spec__")
    if main.__module__ != "__main__" or spec is None:
        return main
    named: Callable[[], int | None] = getattr(importlib.import_module(spec.name), main.__name__)
    return named

"""Which mast file is in use, and which was before: changed while the head rests, or not at all."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mastctl.config import Config
from mastctl.devices.devices import Devices
from mastctl.errors import NotNow
from mastctl.operations.operations import Operations
from mastctl.service.mast_in_use import MastInUse, read_next
from mastctl.state.machine import Machine

log = logging.getLogger(__name__)


class Masts:
    """The mast files of one daemon; safe to use from any thread.

    Parameters
    ----------
    config
        Names the folder, and the cameras that each must have.
    first
        The one that the configuration names.
    devices, operations
        Ask the head whether it rests, and let what was stopped end before.
    machine
        Says whether anything runs; its publisher tells which is in use.
    follow
        Has everything use another one from now on.

    Attributes
    ----------
    in_use, former
        Replaced as a whole, never edited; read without a lock.
    """

    def __init__(
        self,
        config: Config,
        first: MastInUse,
        devices: Devices,
        operations: Operations,
        machine: Machine,
        follow: Callable[[MastInUse], None],
    ) -> None:
        self.in_use = first
        self.former: MastInUse | None = None
        self._config = config
        self._devices = devices
        self._operations = operations
        self._machine = machine
        self._follow = follow
        self._lock = threading.Lock()
        machine.publisher.publish("mast", "in_use", first.told())

    @contextmanager
    def unchanged(self) -> Iterator[MastInUse]:
        """Let no other come into use inside the block: nothing starts between one and the next."""
        with self._lock:
            yield self.in_use

    def load(self, name: str) -> MastInUse:
        """Use another mast file of the configured one's folder from now on, and return it.

        Frames taken before are refused from then on. The file before it stays at hand for `back`.

        Raises
        ------
        BadMastFile
            If it cannot be used; nothing has changed.
        NotNow
            ``busy``, ``moving``: if an operation runs or the head moves.
        DriverError
            If the head does not say whether it moves.
        """
        return self._use(read_next(name, self._config, self.in_use))

    def back(self) -> MastInUse:
        """Go back to the mast file that was in use before, as it was then; the second time forth again.

        Raises
        ------
        NotNow, DriverError
            ``no_former_mast`` if none was loaded since the start; else as for `load`.
        """
        former = self.former
        if former is None:
            raise NotNow("no_former_mast", "no other mast file was in use since the daemon started")
        return self._use(former)

    @contextmanager
    def resting(self) -> Iterator[Callable[[MastInUse], None]]:
        """Let nothing start inside the block, which begins with a head that rests and nothing that runs.

        What it gets puts another mast file into use. Raises NotNow ``busy``, ``moving``; DriverError.
        """
        self._operations.let_stopped_end()
        self._devices.read()  # the machine knows whether it moves now
        with self._lock:
            refusal = self._machine.refusal("rest")
            if refusal is not None:
                raise refusal
            yield self._put

    def use_config(self, config: Config) -> None:
        """Read further mast files for another configuration, inside `resting`."""
        self._config = config

    def _use(self, mast: MastInUse) -> MastInUse:
        with self.resting() as put:
            put(mast)
        return mast

    def _put(self, mast: MastInUse) -> None:
        self._follow(mast)
        self.in_use, self.former = mast, self.in_use
        self._machine.publisher.publish("mast", "in_use", mast.told())
        for note in mast.stored.notes:
            log.warning("%s", note)
        log.info("mast file %s (%s) is in use", mast.path.name, mast.stored.digest[:12])

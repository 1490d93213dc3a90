"""What ROS asks the head to do: one thing at a time, under a lease of its own, stopped when ROS is gone.

A wish is an operation of the daemon: joint angles, or a point of the rover frame. A new wish takes the place
of the one before, which is stopped first. The lease is held from a wish's beginning to its end and renewed
meanwhile, so that others can steer in between; when nobody renews it, the daemon stops what runs.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from mastctl.client import Client, ClientError

log = logging.getLogger(__name__)

LEASE_S = 2.0
WAIT_S = 600.0
"""Longest time of one wish; the daemon's own deadline is sooner."""
CODES_OF_LOSS = ("no_daemon", "timeout", "lease_over", "lease_unknown", "closing")


@dataclass(frozen=True)
class GoalOutcome:
    """How a wish ended: ``state`` is ``done``, ``failed``, ``stopped``, ``refused`` or ``replaced``.

    ``operation`` is the daemon's record, where there is one.
    """

    state: str
    code: str = ""
    message: str = ""
    operation: Mapping[str, Any] | None = None


@dataclass(eq=False)
class Wish:
    """One thing asked by ROS.

    Attributes
    ----------
    what
        In words, for logs.
    request
        Returns the arguments of `Client.point`; may wait, and raises ValueError with a sentence.
    on_end
        Told how it ended, once, from the worker's thread.
    """

    what: str
    request: Callable[[Client], Mapping[str, Any]]
    on_end: Callable[[GoalOutcome], None] = lambda outcome: None
    over: threading.Event = field(default_factory=threading.Event)


class RosSteering:
    """Carries out wishes in a thread of its own; `close` stops what runs.

    Parameters
    ----------
    connect
        Makes a client of the daemon; called for each thread that needs one.
    """

    def __init__(self, connect: Callable[[], Client]) -> None:
        self._connect = connect
        self._changed = threading.Condition()
        self._next: Wish | None = None
        self._now: Wish | None = None
        self._operation = ""  # of the daemon, for what runs now
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="steering", daemon=True)
        self._thread.start()

    def ask(self, wish: Wish) -> None:
        """Take a wish; what runs is stopped for it, and what waited is told that it was replaced."""
        with self._changed:
            closed = self._closed
            if not closed:
                waiting, self._next = self._next, wish
                self._changed.notify_all()
        if closed:
            self._end(wish, GoalOutcome("stopped", message="the adapter ends"))
            return
        if waiting is not None:
            self._end(waiting, GoalOutcome("replaced", message="a newer wish came"))
        self._stop_running()

    def withdraw(self, wish: Wish) -> None:
        """Do a wish no longer: it is stopped, or never begun."""
        with self._changed:
            waiting = self._next is wish
            if waiting:
                self._next = None
            running = self._now is wish
        if waiting:
            self._end(wish, GoalOutcome("stopped", message="it was canceled"))
        elif running:
            wish.over.set()
            self._stop_running()

    def stop(self) -> None:
        """Do no wish any longer: what runs is stopped, what waits is never begun."""
        with self._changed:
            wishes = [one for one in (self._next, self._now) if one is not None]
        for wish in wishes:
            self.withdraw(wish)

    def close(self) -> None:
        """Stop what was begun, and wait until the lease is given back."""
        with self._changed:
            self._closed = True
            waiting, self._next = self._next, None
            self._changed.notify_all()
        if waiting is not None:
            self._end(waiting, GoalOutcome("stopped", message="the adapter ends"))
        self._stop_running()
        self._thread.join()

    def _stop_running(self) -> None:
        """Stop what ROS has begun, and nothing else: the head may be another client's by now."""
        with self._changed:
            operation = self._operation
        if operation:
            with contextlib.suppress(ClientError), self._connect() as client:
                client.stop_operation(operation)

    def _superseded(self, wish: Wish) -> bool:
        return self._closed or self._next is not None or wish.over.is_set()

    # In the worker's thread

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._next is not None)
                if self._next is None:
                    return
                wish, self._next = self._next, None
                self._now = wish
            outcome = self._done(wish)
            with self._changed:
                self._now, self._operation = None, ""
            self._end(wish, outcome)

    def _done(self, wish: Wish) -> GoalOutcome:
        """Carry a wish out."""
        try:
            with self._connect() as client:
                asked = wish.request(client)
                with client.lease(for_s=LEASE_S, ends_with_stop=True):
                    return self._carried_out(client, wish, asked)
        except ValueError as error:
            return GoalOutcome("refused", "bad_request", str(error))
        except ClientError as error:
            return GoalOutcome("refused", error.code, str(error))
        except Exception:  # the thread goes on: the next wish, and the stop at the end, need it
            log.exception("'%s' met a defect of the program", wish.what)
            return GoalOutcome("failed", "defect", "a defect of the program; the log has it")

    def _carried_out(self, client: Client, wish: Wish, asked: Mapping[str, Any]) -> GoalOutcome:
        if self._superseded(wish):
            return GoalOutcome("replaced", message="a newer wish came")
        operation = client.point(**asked)
        with self._changed:
            self._operation = operation
        if self._superseded(wish):  # it came before this one could be stopped
            client.stop_operation(operation)
        try:
            record = client.wait(operation, WAIT_S)
        except ClientError as error:
            log.warning("lost sight of '%s' (%s); the head is stopped", wish.what, error)
            with contextlib.suppress(ClientError):
                client.stop_operation(operation)
            return GoalOutcome("failed", error.code, str(error))
        why = record["error"] or {"code": "", "message": ""}
        return GoalOutcome(record["state"], why["code"], why["message"], record)

    def _end(self, wish: Wish, outcome: GoalOutcome) -> None:
        if outcome.state != "done":
            log.warning("%s: %s %s", wish.what, outcome.state, outcome.message)
        try:
            wish.on_end(outcome)
        except Exception:
            log.exception("the end of '%s' met a defect of the program", wish.what)

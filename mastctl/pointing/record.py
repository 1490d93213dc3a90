"""The record of a request: each step with its numbers, done or failed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from drivers.clock import Clock
from mastctl.pointing.results import Step


class Recorder:
    """Hands every step to ``tell`` when it ends, and remembers which one it was."""

    def __init__(self, tell: Callable[[Step], None], clock: Clock, before: Callable[[], None]) -> None:
        self._tell = tell
        self._clock = clock
        self._before = before
        self.last = "request"

    @contextmanager
    def step(self, name: str, **known: Any) -> Iterator[dict[str, Any]]:
        """Record what happens inside as one step; ``before`` runs first and may refuse it.

        The dict that is handed out, begun with what is known, becomes the step's detail. A failed step gets
        the error's code and message too, and the error goes on.
        """
        self.last = name
        started_s = self._clock.now_s()
        detail: dict[str, Any] = dict(known)
        try:
            self._before()
            yield detail
        except BaseException as error:
            detail.update(code=getattr(error, "code", "internal"), message=" ".join(str(error).split()))
            self._tell(Step(name, "failed", started_s, self._clock.now_s() - started_s, detail))
            raise
        self._tell(Step(name, "done", started_s, self._clock.now_s() - started_s, detail))

"""Answers kept by key, so that a command which is sent twice acts once.

Answers are kept, and failures of a device or of the program, which may have acted. A refusal changed nothing
and is forgotten, so the same key may be sent again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from drivers.clock import Clock, SystemClock
from mastctl.errors import BadRequest, MastctlError, NotNow

Answer = TypeVar("Answer", bound=Mapping[str, Any])

KEPT_S = 600.0
KEPT = 4096  # keys; for more, the oldest is forgotten before its time
LONGEST_KEY = 200
WAIT_S = 30.0  # for the first of two, longer than any command takes that is accepted or refused


@dataclass(eq=False)
class _Kept:
    """The request that came with a key, and its answer or its error."""

    request: Mapping[str, Any]
    since_s: float
    answer: Any = None
    error: BaseException | None = None

    @property
    def done(self) -> bool:
        return self.answer is not None or self.error is not None


class Answers:
    """The answers by their keys; safe to use from any thread.

    ``clock`` is that by which answers are forgotten; the second of two waits on ``waits_on``, the service's,
    while the first is at work.
    """

    def __init__(self, clock: Clock, waits_on: Clock | None = None) -> None:
        self._clock = clock
        self._changed = (waits_on or SystemClock()).signal()
        self._kept: dict[tuple[str, str], _Kept] = {}  # oldest first

    def once(
        self, client: str, key: str, request: Mapping[str, Any], act: Callable[[], Answer]
    ) -> tuple[Answer, bool]:
        """Return what ``act()`` returns, or returned before, and whether it was before.

        A key is 1 to 200 signs of printable ASCII; another client's is another key, and ``request`` the same
        whenever the key is. Raises BadRequest ``key_reused`` if it came with another request, ``bad_request``
        for what is no key; NotNow ``key_in_use`` if the first is still at work after 30 s.
        """
        if not (0 < len(key) <= LONGEST_KEY and key.isascii() and key.isprintable()):
            expected = f"1 to {LONGEST_KEY} printable ASCII characters are expected"
            raise BadRequest("bad_request", f"Idempotency-Key is '{key[:40]}' where {expected}")
        place = client, key
        with self._changed:
            now_s = self._clock.now_s()
            for old, one in list(self._kept.items()):
                if not one.done:
                    continue
                if now_s - one.since_s < KEPT_S and len(self._kept) < KEPT:
                    break
                del self._kept[old]
            known = self._kept.get(place)
            if known is not None:
                return self._answer_of(known, key, request), True
            mine = self._kept[place] = _Kept(request, now_s)
        try:
            answer = act()
            mine.answer = answer
        except BaseException as error:
            mine.error = error
            raise
        finally:
            with self._changed:
                if isinstance(mine.error, MastctlError):
                    del self._kept[place]
                self._changed.notify_all()
        return answer, False

    def _answer_of(self, known: _Kept, key: str, request: Mapping[str, Any]) -> Any:
        """Return the answer that the first got, or gets; the lock is kept."""
        if known.request != request:
            message = f"Idempotency-Key '{key[:40]}' came before with another request; take a new one"
            raise BadRequest("key_reused", message)
        until_s = self._clock.now_s() + WAIT_S
        while not known.done:
            left_s = until_s - self._clock.now_s()
            if left_s <= 0:
                message = f"the request that came first with Idempotency-Key '{key[:40]}' is still at work"
                raise NotNow("key_in_use", message)
            self._changed.wait(left_s, idle=True)
        if known.error is not None:
            raise known.error
        return known.answer

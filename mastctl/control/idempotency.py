"""Answers kept by key, so that a command which is sent twice acts once.

What is kept is what acted, or may have: answers, and failures of a device or of the program. A refusal
changed nothing and is forgotten, so the same key may ask again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from drivers.clock import Clock, SystemClock
from mastctl.errors import BadRequest, MastctlError, NotNow

Answer = TypeVar("Answer", bound=Mapping[str, Any])

KEPT_S = 600.0
KEPT, KEPT_BYTES = 4096, 4 << 20  # keys, and their answers; for more, the oldest is forgotten before its time
LONGEST_KEY = 200
WAIT_S = 30.0  # for the first of two, longer than any command takes that is accepted or refused


@dataclass(eq=False)
class _Kept:
    """What became of one key."""

    digest: bytes
    since_s: float
    done: bool = False
    answer: bytes = b""
    error: BaseException | None = None


class Answers:
    """What was answered to each key; safe to use from any thread.

    Parameters
    ----------
    clock
        By which answers are forgotten.
    waits_on
        What the second of two waits on while the first is at work; the service's clock.
    """

    def __init__(self, clock: Clock, waits_on: Clock | None = None) -> None:
        self._clock = clock
        self._changed = (waits_on or SystemClock()).signal()
        self._kept: dict[tuple[str, str], _Kept] = {}  # oldest first
        self._bytes = 0

    def once(
        self, who: str, key: str, request: Mapping[str, Any], act: Callable[[], Answer]
    ) -> tuple[Answer, bool]:
        """Return what ``act()`` returns, or returned before, and whether it was before.

        Parameters
        ----------
        who
            Whose key it is: another's is another key.
        key
            Printable ASCII, up to 200 signs.
        request
            What is asked, as JSON: the same whenever the key is.

        Raises
        ------
        BadRequest
            ``key_reused`` if the key came with another request, ``bad_request`` for what is no key.
        NotNow
            ``key_in_use`` if the first is still at work after 30 s.
        """
        if not (0 < len(key) <= LONGEST_KEY and key.isascii() and key.isprintable()):
            words = f"Idempotency-Key is '{key[:40]}' where up to {LONGEST_KEY} signs of ASCII are expected"
            raise BadRequest("bad_request", words)
        digest = hashlib.sha256(json.dumps(request, sort_keys=True).encode()).digest()
        with self._changed:
            known = self._kept.get((who, key))
            if known is not None and not self._old(known):
                return self._answered(known, key, digest), True
            self._leave((who, key))  # an old one, so that the order stays
            self._make_room()
            mine = self._kept[(who, key)] = _Kept(digest, self._clock.now_s())
        text = b""
        try:
            answer = act()
            text = json.dumps(answer).encode()
        except BaseException as error:
            mine.error = error
            raise
        finally:
            with self._changed:
                mine.done, mine.answer = True, text
                self._bytes += len(text)
                if isinstance(mine.error, MastctlError):
                    self._leave((who, key))
                self._changed.notify_all()
        return answer, False

    def _answered(self, known: _Kept, key: str, digest: bytes) -> Any:
        """Return the answer that the first got, or gets; the lock is held."""
        if known.digest != digest:
            words = f"Idempotency-Key '{key[:40]}' came before with another request; take a new one"
            raise BadRequest("key_reused", words)
        until_s = self._clock.now_s() + WAIT_S
        while not known.done:
            left_s = until_s - self._clock.now_s()
            if left_s <= 0:
                words = f"the request that came first with Idempotency-Key '{key[:40]}' is still at work"
                raise NotNow("key_in_use", words)
            self._changed.wait(left_s, idle=True)
        if known.error is not None:
            raise known.error
        return json.loads(known.answer)

    def _old(self, one: _Kept) -> bool:
        return one.done and self._clock.now_s() - one.since_s >= KEPT_S

    def _make_room(self) -> None:
        """Forget what is old, and the oldest of too many; never what is at work. The lock is held."""
        leave: list[tuple[str, str]] = []
        left_bytes = self._bytes
        for key, one in self._kept.items():
            crowded = len(self._kept) - len(leave) >= KEPT or left_bytes > KEPT_BYTES
            if one.done and (crowded or self._old(one)):
                leave.append(key)
                left_bytes -= len(one.answer)
            elif not crowded:
                break
        for key in leave:
            self._leave(key)

    def _leave(self, key: tuple[str, str]) -> None:
        """Forget a key; the lock is held."""
        one = self._kept.pop(key, None)
        self._bytes -= 0 if one is None else len(one.answer)

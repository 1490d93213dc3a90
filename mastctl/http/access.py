"""Who a token or a page's session belongs to. In memory there are digests only, compared in constant time.

Wrong tokens are counted, and no further ones are heard of an address that tries many. What is counted is
different wrong tokens: a forgotten script that repeats an old one is no guessing. Known tokens are never
asked about here, so that a guesser shuts out nobody who shares its address. What keeps guessing hopeless is a
token's 256 random bits; this keeps it rare and known.
"""

from __future__ import annotations

import hmac
import ipaddress
import logging
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime

from calib.errors import BadFile
from drivers.clock import Clock, SystemClock
from mastctl.errors import NotLetIn, TooMany
from mastctl.http.tokens import TOKEN_BYTES, Token, TokenList, digest_of

log = logging.getLogger(__name__)

WINDOW_S = 60.0
MOST_OF_ONE = 10  # different wrong tokens from one address in a window
MOST_OF_ALL = 100  # from all; then no wrong one is heard from any address that gave one
MOST_ADDRESSES = 1000


def neighbourhood(address: str) -> str:
    """Return what counts as one address: of IPv6 the network of 64 bits, in which one may choose freely."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv4Address):
        return str(parsed)
    if parsed.ipv4_mapped is not None:
        return str(parsed.ipv4_mapped)
    return str(ipaddress.ip_network((parsed, 64), strict=False).network_address)


class Guesses:
    """The wrong tokens of the last minute; used on one thread. Times are seconds of any clock."""

    def __init__(self) -> None:
        self._wrong: OrderedDict[str, dict[str, float]] = OrderedDict()  # address: digest: when first

    def wait_s(self, address: str, now_s: float) -> float:
        """Return how long an address is not heard yet, seconds; 0.0 if it is heard."""
        self._forget(now_s)
        own = self._wrong.get(neighbourhood(address), {})
        if not own:
            return 0.0
        if len(own) < MOST_OF_ONE and sum(map(len, self._wrong.values())) < MOST_OF_ALL:
            return 0.0
        return max(0.0, min(own.values()) + WINDOW_S - now_s)

    def wrong(self, address: str, digest: str, now_s: float) -> bool:
        """Take note of a wrong token; return whether it is this address's first in the window."""
        self._forget(now_s)
        address = neighbourhood(address)
        first = address not in self._wrong
        self._wrong.setdefault(address, {}).setdefault(digest, now_s)
        while len(self._wrong) > MOST_ADDRESSES:
            self._wrong.popitem(last=False)
        return first

    def _forget(self, now_s: float) -> None:
        for address, digests in list(self._wrong.items()):
            for digest in [one for one, at_s in digests.items() if now_s - at_s >= WINDOW_S]:
                del digests[digest]
            if not digests:
                del self._wrong[address]


REREAD_S = 0.5  # how late a new or a revoked token may be known
SESSION_S = 12 * 3600.0
SESSIONS_OF_ONE = 20  # token; the one that was not used for longest goes


@dataclass(frozen=True)
class PageSession:
    """A page that was let in by a token; it ends with that token, or at ``until_s`` of the clock."""

    token_sha256: str
    until_s: float


class Access:
    """The tokens of a daemon, read again when they change, and the sessions of pages.

    What is asked of it belongs to one thread, the event loop's, and touches no file, where nothing else is
    said; `reread` is the other's.

    Parameters
    ----------
    tokens
        The list; made at the first run.
    clock
        For sessions and guesses; the machine's by default.

    Raises
    ------
    BadFile
        If the list cannot be read or made.
    """

    def __init__(self, tokens: TokenList, clock: Clock | None = None) -> None:
        self._list = tokens
        self._clock = clock or SystemClock()
        self._tokens = tokens.first_run()
        self._lent: tuple[Token, ...] = ()
        self._seen = self._stamp()
        self._guesses = Guesses()
        self._sessions: OrderedDict[str, PageSession] = OrderedDict()  # last used first
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="tokens", daemon=True)
        self._thread.start()

    @property
    def folder(self) -> str:
        """Where the tokens lie."""
        return str(self._list.folder)

    def token_of(self, text: str, address: str) -> Token:
        """Return whose token a text is. A known one passes from anywhere; only others are counted and locked.

        Raises
        ------
        NotLetIn, TooMany
            ``wrong_token`` if it is nobody's, ``too_many_guesses`` if ``address`` has tried too many such.
        """
        digest = digest_of(text)
        found = self._find(digest)
        if found is not None:
            return found
        now_s = self._clock.now_s()
        wait_s = self._guesses.wait_s(address, now_s)
        if wait_s > 0.0:
            words = f"too many wrong tokens came from {address[:60]}; it is heard again in {wait_s:.0f} s"
            raise TooMany("too_many_guesses", words, max(1.0, wait_s))
        if self._guesses.wrong(address, digest, now_s):
            log.warning("a wrong token came from %s", address[:60])
        raise NotLetIn("wrong_token", "the token is unknown; perhaps it was revoked")

    def lend(self, name: str) -> tuple[str, Callable[[], None]]:
        """Return a new token of the role operate for a program of this daemon's own, and what takes it back.

        It is in memory only. Safe to use from any thread, as long as one lends at a time.
        """
        text = secrets.token_urlsafe(TOKEN_BYTES)
        token = Token(name, "operate", digest_of(text), datetime.now(UTC).isoformat(timespec="seconds"))
        self._lent = (*self._lent, token)

        def take_back() -> None:
            self._lent = tuple(one for one in self._lent if one is not token)

        return text, take_back

    def known(self, text: str) -> Token | None:
        """Return whose token a text is, if it is one; nothing is counted."""
        return self._find(digest_of(text))

    def log_in(self, text: str, address: str) -> tuple[str, Token, PageSession]:
        """Begin a session by a token; return the session's secret. Raises NotLetIn, TooMany as `token_of`."""
        token = self.token_of(text, address)
        secret = secrets.token_urlsafe(TOKEN_BYTES)
        now_s = self._clock.now_s()
        session = PageSession(token.sha256, now_s + SESSION_S)
        self._forget_ended(now_s)
        own = [key for key, one in self._sessions.items() if one.token_sha256 == token.sha256]
        for key in own[: max(0, len(own) + 1 - SESSIONS_OF_ONE)]:
            del self._sessions[key]
        self._sessions[digest_of(secret)] = session
        return secret, token, session

    def session_of(self, secret: str) -> tuple[Token, float] | None:
        """Return whose session it is, and the seconds that are left of it; None if it has ended."""
        digest = digest_of(secret)
        session = self._sessions.get(digest)
        if session is None:
            return None
        token = self._find(session.token_sha256)
        left_s = session.until_s - self._clock.now_s()
        if token is None or left_s <= 0.0:
            del self._sessions[digest]
            return None
        self._sessions.move_to_end(digest)
        return token, left_s

    def stands(self, credential: str) -> bool:
        """Return whether a token or a session, by its digest, still lets in. Safe to use from any thread."""
        session = self._sessions.get(credential)
        if session is not None and self._clock.now_s() < session.until_s:
            credential = session.token_sha256
        return any(one.sha256 == credential for one in (*self._tokens, *self._lent))

    def log_out(self, secret: str) -> None:
        """End a session, if there is one."""
        self._sessions.pop(digest_of(secret), None)

    def reread(self) -> None:
        """Take the list as it is now, if it has changed; a damaged one leaves everything as it was."""
        stamp = self._stamp()
        if stamp == self._seen:
            return
        self._seen = stamp
        try:
            tokens = self._list.read()
        except BadFile as error:
            log.error("the tokens stay as they were: %s", error)
            return
        if tokens is None:
            log.error("the tokens stay as they were: %s is gone", self._list.path)
            return
        self._tokens = tokens
        log.info("%d tokens: %s", len(tokens), ", ".join(one.name for one in tokens) or "none")

    def close(self) -> None:
        """Look at the list no longer."""
        self._closing.set()

    def _forget_ended(self, now_s: float) -> None:
        """Keep no session whose time is over or whose token is gone."""
        there = {one.sha256 for one in (*self._tokens, *self._lent)}
        for key, one in list(self._sessions.items()):
            if one.until_s <= now_s or one.token_sha256 not in there:
                del self._sessions[key]

    def _find(self, digest: str) -> Token | None:
        """The token of a digest; as slow for one that is not there as for one that is."""
        found = None
        for token in (*self._tokens, *self._lent):
            if hmac.compare_digest(token.sha256, digest):
                found = token
        return found

    def _watch(self) -> None:
        while not self._closing.wait(REREAD_S):
            self.reread()

    def _stamp(self) -> tuple[int, int, int] | None:
        """What changes when the list does."""
        try:
            found = self._list.path.stat()
        except OSError:
            return None
        return found.st_mtime_ns, found.st_size, found.st_ino

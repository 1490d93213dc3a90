"""The owners of tokens. Memory holds digests only, which are compared in constant time."""

from __future__ import annotations

import hmac
import logging
import secrets
import threading
from collections.abc import Callable
from datetime import UTC, datetime

from calib.errors import BadFile
from mastctl.errors import NotLetIn
from mastctl.http.tokens import TOKEN_BYTES, Token, TokenList, digest_of

log = logging.getLogger(__name__)

REREAD_S = 0.5  # how late a new or a revoked token may be known


class Access:
    """The tokens of a daemon, read again when they change. Only `reread` touches a file.

    Parameters
    ----------
    tokens
        The list; made at the first run.

    Raises
    ------
    BadFile
        If the list cannot be read or made.
    """

    def __init__(self, tokens: TokenList) -> None:
        self._list = tokens
        self._tokens = tokens.first_run()
        self._lent: tuple[Token, ...] = ()
        self._seen = self._stamp()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="tokens", daemon=True)
        self._thread.start()

    @property
    def folder(self) -> str:
        """Where the tokens lie."""
        return str(self._list.folder)

    def token_of(self, text: str) -> Token:
        """Return the token of a text. Raises NotLetIn ``wrong_token``."""
        found = self.known(text)
        if found is None:
            raise NotLetIn("wrong_token", "the token is unknown; perhaps it was revoked")
        return found

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
        """Return the token of a text, if it is one; as slow for a text that is none."""
        digest, found = digest_of(text), None
        for token in (*self._tokens, *self._lent):
            if hmac.compare_digest(token.sha256, digest):
                found = token
        return found

    def stands(self, credential: str) -> bool:
        """Return whether a token, by its digest, still lets in. Safe to use from any thread."""
        return any(one.sha256 == credential for one in (*self._tokens, *self._lent))

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

"""The tokens that a daemon accepts. Memory has digests only, which are compared in constant time."""

from __future__ import annotations

import hmac
import logging
from collections.abc import Callable

from calib.errors import BadFile
from mastctl.errors import NotLetIn
from mastctl.http.tokens import Token, TokenList, digest_of, new_token

log = logging.getLogger(__name__)


class Access:
    """The tokens of a daemon, made at the first run, read again by `reread`. Raises BadFile."""

    def __init__(self, tokens: TokenList) -> None:
        self._list = tokens
        self._tokens = tokens.first_run()
        self._lent: tuple[Token, ...] = ()
        self._seen = self._stamp()

    @property
    def folder(self) -> str:
        """The folder of the tokens."""
        return str(self._list.folder)

    def token_of(self, text: str) -> Token:
        """Return the token of a text. Raises NotLetIn ``wrong_token``."""
        found = self.known(text)
        if found is None:
            raise NotLetIn("wrong_token", "the token is unknown; perhaps it was revoked")
        return found

    def lend(self, name: str) -> tuple[str, Callable[[], None]]:
        """Return a new token of the role operate for a program of this daemon's own, and its revocation.

        It is in memory only. Safe to use from any thread, one call at a time.
        """
        text, token = new_token(name, "operate")
        self._lent = (*self._lent, token)

        def take_back() -> None:
            self._lent = tuple(one for one in self._lent if one is not token)

        return text, take_back

    def known(self, text: str) -> Token | None:
        """Return the token of a text, None for another text; takes the same time for both."""
        digest, found = digest_of(text), None
        for token in (*self._tokens, *self._lent):
            if hmac.compare_digest(token.sha256, digest):
                found = token
        return found

    def stands(self, credential: str) -> bool:
        """Return whether a token, by its digest, is still valid. Safe to use from any thread."""
        return any(one.sha256 == credential for one in (*self._tokens, *self._lent))

    def reread(self) -> None:
        """Read the list again if it has changed; a damaged one changes nothing."""
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

    def _stamp(self) -> tuple[int, int, int] | None:
        """A value that changes with the list."""
        try:
            found = self._list.path.stat()
        except OSError:
            return None
        return found.st_mtime_ns, found.st_size, found.st_ino

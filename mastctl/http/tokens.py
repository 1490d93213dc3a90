"""Tokens: 256 random bits each, with a name and a role; the list of them keeps digests only.

The first run of a daemon that needs tokens makes one for each role, each in a file of its own beside the list
(``admin.token``), for its user only. A token of ``mastctl rig token new`` is shown once and kept nowhere.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import hmac
import logging
import secrets
import stat
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from pydantic import Field

from calib.errors import BadFile
from calib.files import remove, replace_bytes
from calib.files.records import Record, read_value
from mastctl.answers import Role
from mastctl.control.lease import ROLES
from mastctl.errors import MastctlError, NotLetIn
from mastctl.safety.state_folder import StateFile

log = logging.getLogger(__name__)

TOKEN_BYTES = 32
LIST_NAME = "tokens.json"
SCHEMA = "mastctl/tokens/1"
MOST_TOKENS = 200
LONGEST_NAME = 40

_OTHERS_MAY = stat.S_IRWXG | stat.S_IRWXO


class TokenRefused(MastctlError):
    """A token cannot be made or revoked under this name."""

    code = "token_refused"
    exit_code = 2


class Token(Record):
    """One token, as it is kept: its name and rights, and the digest of its text."""

    name: str
    role: Role
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$", description="64 hexadecimal digits")]
    made: str  # ISO 8601, UTC


_TOKENS = Annotated[list[Token], Field(max_length=MOST_TOKENS)]


class TokenList:
    """The tokens of one daemon, in its state folder. Each call reads the file anew."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path = folder / LIST_NAME
        self._file = StateFile(self.path, SCHEMA)

    def file_of(self, role: Role) -> Path:
        """Return the file of the token that the first run made for a role."""
        return self.folder / f"{role}.token"

    def read(self) -> tuple[Token, ...] | None:
        """Return the tokens; None before the first run.

        Raises BadFile if the list, or a token beside it, is damaged or open to other users of this machine.
        """
        for path in (self.path, *(self.file_of(role) for role in ROLES)):
            _check_private(path)
        document = self._file.read()
        if document is None:
            return None
        tokens = tuple(read_value(_TOKENS, document.get("tokens"), self.path, "tokens"))
        if len({one.name for one in tokens}) != len(tokens):
            raise BadFile(self.path, "tokens", "contains one name twice")
        return tokens

    def first_run(self) -> tuple[Token, ...]:
        """Return the tokens, after making one for each role if there is no list yet. Raises BadFile."""
        with self._locked() as tokens:
            if tokens is not None:
                return tokens
            made = []
            for role in ROLES:
                text, token = _new_token(role, role)
                replace_bytes(self.file_of(role), f"{text}\n".encode(), 0o600)
                made.append(token)
            return self._write(made)

    def new(self, name: str, role: Role) -> str:
        """Make a token and return it; it is kept nowhere else. Raises TokenRefused, BadFile."""
        if not name or len(name) > LONGEST_NAME or not all(c.isalnum() or c in "._-" for c in name):
            expected = f"1 to {LONGEST_NAME} letters, digits, dots, dashes are expected"
            raise TokenRefused(f"'{name[:60]}' where {expected}")
        with self._locked() as tokens:
            if any(one.name == name for one in tokens or ()):
                raise TokenRefused(f"there is a token '{name}' already; revoke it first")
            if len(tokens or ()) >= MOST_TOKENS:
                raise TokenRefused(f"there are {MOST_TOKENS} tokens; revoke one first")
            text, token = _new_token(name, role)
            self._write([*(tokens or ()), token])
            return text

    def revoke(self, name: str) -> Token:
        """Revoke a token; it is valid no longer. Raises TokenRefused, BadFile."""
        with self._locked() as tokens:
            by_name = {one.name: one for one in tokens or ()}
            if name not in by_name:
                known = ", ".join(by_name) or "none"
                raise TokenRefused(f"there is no token '{name[:60]}'; there are: {known}")
            found = by_name.pop(name)
            self._write(by_name.values())
            if name in ROLES:
                remove(self.file_of(found.role))
            return found

    def _write(self, tokens: Iterable[Token]) -> tuple[Token, ...]:
        kept = tuple(tokens)
        self._file.write({"tokens": [one.model_dump() for one in kept]})
        return kept

    @contextlib.contextmanager
    def _locked(self) -> Iterator[tuple[Token, ...] | None]:
        """Yield the tokens while no second command changes the list."""
        lock = self.folder / "tokens.lock"
        try:
            lock.touch(0o600)
            with lock.open() as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                yield self.read()
        except OSError as error:
            raise BadFile(self.folder, "", f"no tokens can be kept here: {error.strerror or error}") from None


class Access:
    """The tokens that a running daemon accepts, compared in constant time; safe to use from any thread.

    They are made at the first run, and read again by `reread`. Raises BadFile.
    """

    def __init__(self, tokens: TokenList) -> None:
        self._list = tokens
        self._tokens = tokens.first_run()
        self._temporary: tuple[Token, ...] = ()
        self._problem = ""

    @property
    def folder(self) -> str:
        """The folder of the tokens."""
        return str(self._list.folder)

    def token_of(self, text: str) -> Token:
        """Return the token of a text; takes the same time for any other. Raises NotLetIn ``wrong_token``."""
        digest, found = _digest_of(text), None
        for token in (*self._tokens, *self._temporary):
            if hmac.compare_digest(token.sha256, digest):
                found = token
        if found is None:
            raise NotLetIn("wrong_token", "the token is unknown; perhaps it was revoked")
        return found

    def is_valid(self, digest: str) -> bool:
        """Return whether the token of this digest is still valid."""
        return any(one.sha256 == digest for one in (*self._tokens, *self._temporary))

    def temporary(self, name: str) -> tuple[str, Callable[[], None]]:
        """Return a token of the role operate for a program of this daemon's own, and its revocation.

        It is in memory only. One call at a time.
        """
        text, token = _new_token(name, "operate")
        self._temporary = (*self._temporary, token)

        def revoke() -> None:
            self._temporary = tuple(one for one in self._temporary if one is not token)

        return text, revoke

    def reread(self) -> None:
        """Read the list again; a damaged one changes nothing."""
        problem, tokens = "", None
        try:
            tokens = self._list.read()
            problem = f"{self._list.path} is gone" if tokens is None else ""
        except BadFile as error:
            problem = str(error)
        if problem and problem != self._problem:
            log.error("the tokens stay as they were: %s", problem)
        self._problem = problem
        if tokens is not None and tokens != self._tokens:
            self._tokens = tokens
            log.info("%d tokens: %s", len(tokens), ", ".join(one.name for one in tokens) or "none")


def _digest_of(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).hexdigest()


def _new_token(name: str, role: Role) -> tuple[str, Token]:
    """A new token's text, and the token as it is kept."""
    text = secrets.token_urlsafe(TOKEN_BYTES)
    made = datetime.now(UTC).isoformat(timespec="seconds")
    return text, Token(name=name, role=role, sha256=_digest_of(text), made=made)


def _check_private(path: Path) -> None:
    """Pass a file that only its user may touch, or that does not exist. Raises BadFile."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return
    except OSError as error:
        raise BadFile(path, "", f"cannot be read: {error.strerror or error}") from None
    if mode & _OTHERS_MAY:
        found = f"mode {stat.S_IMODE(mode):04o}"
        raise BadFile(path, "", f"other users of this machine may touch it ({found}); 'chmod 600' mends it")

"""The daemon that a command is for: the options that name it, a client of it, and its operations followed."""

from __future__ import annotations

import argparse
import atexit
import getpass
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from mastctl import signals
from mastctl.cli import output
from mastctl.cli.options import option
from mastctl.cli.output import WrongUse

if TYPE_CHECKING:
    from mastctl.answers import OperationAnswer, Step
    from mastctl.client import Client
    from mastctl.config import Listen

URL = option("--url ADDRESS", "the daemon's address (default: that of the configuration)")
CONFIG = option("--config FILE", "the configuration that the daemon runs with")
LEASE = option("--lease ID", "the lease to steer under ('mastctl rig lease take')")
DAEMON = (URL, CONFIG, LEASE)
"""The options that `client_of` reads."""

TIMEOUT = option("--timeout S", "how long to wait (default 120 s)", default=120.0)


def queue_output() -> None:
    """Let no output of the daemon wait for its reader, on stderr as on stdout."""
    from mastctl.logs import QueuedText, writer_to

    for name in ("stdout", "stderr"):
        try:
            descriptor = getattr(sys, name).fileno()
        except OSError:  # a stream of a test
            continue
        writer = writer_to(descriptor)
        setattr(sys, name, QueuedText(writer))
        atexit.register(writer.flush)
    signals.write_from_background()


@contextmanager
def client_of(
    args: argparse.Namespace, *, default_address: bool = False, timeout_s: float = 30.0
) -> Iterator[Client]:
    """Give a client of the daemon that the options, or MASTCTL_URL, name.

    Where nothing names one, it is that of the packaged configuration, and a daemon of another user is only
    read there. ``default_address``: where the configuration cannot be read, the default address is used.
    """
    from calib.errors import BadFile
    from mastctl.client import Client
    from mastctl.config import Listen, load_config

    url, reads_only = args.url or os.environ.get("MASTCTL_URL"), ""
    if url is None:
        named = args.config is not None
        try:
            listen = load_config(args.config).listen
        except BadFile as error:
            if not default_address:
                raise
            listen, named = Listen(), False
            output.tell(f"{error}; using the default address {listen.url}")
        if listen.socket is None and listen.port == 0:
            raise WrongUse("the configuration listens at any free port (0); give --url")
        url = listen.url
        if not named:
            reads_only = _not_ours(listen)
    with Client(url, timeout_s, name=_person(), reads_only=reads_only) as client:
        client.use_lease(getattr(args, "lease", None))
        yield client


def _not_ours(listen: Listen) -> str:
    """The reason not to command an unnamed daemon; empty if this user started it, or none listens."""
    owner = listener_of(listen.host, listen.port)
    if owner is None or owner == os.getuid():
        return ""
    return (
        f"the daemon at {listen.url} was started by {output.user_name(owner)}, not by this user; "
        f"if it is meant, name it: --url {listen.url}"
    )


LISTENING = "0A"  # the state TCP_LISTEN of Linux, include/net/tcp_states.h


def listener_of(host: str, port: int) -> int | None:
    """Return the user id of the process that listens at an IPv4 address of this machine, if any (proc(5))."""
    found = None
    for table in (Path("/proc/net/tcp"), Path("/proc/net/tcp6")):
        lines = table.read_text(encoding="ascii").splitlines()[1:] if table.exists() else []
        for _, local, _, state, _, _, _, owner, *_ in map(str.split, lines):
            address, _, number = local.partition(":")
            if state != LISTENING or int(number, 16) != port:
                continue
            if address == socket.inet_aton(host)[::-1].hex().upper():
                return int(owner)
            if set(address) == {"0"}:  # every address of the machine
                found = int(owner)
    return found


def _person() -> str:
    """The client's name: all processes of one user of a machine are one client."""
    try:
        return f"{getpass.getuser()}@{socket.gethostname()}"
    except (OSError, KeyError):  # a user without a name
        return f"{os.getuid()}@{socket.gethostname()}"


def followed(client: Client, operation_id: str, as_json: bool, timeout_s: float) -> OperationAnswer:
    """Wait for an operation, and show its steps to a person meanwhile."""
    if as_json:
        return client.wait(operation_id, timeout_s)

    def show(step: Step) -> None:
        mark = "✓" if step["state"] == "done" else "✗"
        output.tell(f"{mark} {step['name']} ({step['duration_s']:.2f} s)")

    try:
        return client.wait(operation_id, timeout_s, show)
    except KeyboardInterrupt:
        output.tell(f"operation {operation_id} goes on; 'mastctl stop' stops it")
        raise

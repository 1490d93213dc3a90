"""The daemon that a command is for: its options, a client of it, and how it is stopped whatever else fails.

A stop works with a configuration that cannot be read, and when the web side of the daemon does not answer, by
its stop socket.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import getpass
import os
import socket
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl import signals
from mastctl.cli import output
from mastctl.cli.options import command, option
from mastctl.cli.output import Answer, CommandError, WrongUse

if TYPE_CHECKING:
    from mastctl.answers import OperationAnswer, Step
    from mastctl.client import Client

URL = option("--url ADDRESS", "the daemon's address (default: that of the configuration)")
CONFIG = option("--config FILE", "the configuration that the daemon runs with")
LEASE = option("--lease ID", "the lease to steer under ('mastctl rig lease take')")
DAEMON = (URL, CONFIG, LEASE)
"""The options that `client_of` reads."""

TIMEOUT = option("--timeout S", "how long to wait (default 120 s)", default=120.0)

WITHOUT_DAEMON = (
    "if the head moves, end the program that moves it ('camera sync', 'pytest') with Ctrl-C, "
    "or stop it with 'mastctl stop --without-daemon --config FILE'"
)

HUNG_DAEMON = (
    "if the head moves, switch its power off, or kill the daemon's process (kill -9) and then stop the head "
    "with 'mastctl stop --without-daemon --config FILE'"
)


def queue_output() -> None:
    """Let no output of the daemon wait for its reader, on stderr as on stdout."""
    from mastctl.logs import queued

    for name in ("stdout", "stderr"):
        try:
            descriptor = getattr(sys, name).fileno()
        except OSError:  # a stream of a test
            continue
        stream = queued(descriptor)
        setattr(sys, name, stream)
        atexit.register(stream.written)
    signals.write_from_background()


@contextmanager
def client_of(
    args: argparse.Namespace, *, default_address: bool = False, timeout_s: float = 30.0
) -> Iterator[Client]:
    """Give a client of the daemon that the options, or MASTCTL_URL, name.

    Where nothing names one, it is that of the packaged configuration. ``default_address``: where the
    configuration cannot be read, the default address is used.
    """
    from calib.errors import BadFile
    from mastctl.client import Client
    from mastctl.config import Listen, load_config

    url = args.url or os.environ.get("MASTCTL_URL")
    if url is None:
        try:
            listen = load_config(args.config).listen
        except BadFile as error:
            if not default_address:
                raise
            listen = Listen()
            output.show_line(f"{error}; using the default address {listen.url}")
        if listen.socket is None and listen.port == 0:
            raise WrongUse("the configuration listens at any free port (0); give --url")
        url = listen.url
    try:
        person = f"{getpass.getuser()}@{socket.gethostname()}"  # all processes of one user are one client
    except (OSError, KeyError):  # a user without a name
        person = f"{os.getuid()}@{socket.gethostname()}"
    with Client(url, timeout_s, name=person) as client:
        client.use_lease(getattr(args, "lease", None))
        yield client


def followed(client: Client, operation_id: str, as_json: bool, timeout_s: float) -> OperationAnswer:
    """Wait for an operation, and show its steps to a person meanwhile."""

    def show(step: Step) -> None:
        mark = "✓" if step["state"] == "done" else "✗"
        output.show_line(f"{mark} {step['name']} ({step['duration_s']:.2f} s)")

    try:
        return client.wait(operation_id, timeout_s, None if as_json else show)
    except KeyboardInterrupt:
        if not as_json:
            output.show_line(f"operation {operation_id} goes on; 'mastctl stop' stops it")
        raise


def not_done(record: OperationAnswer, more: str = "") -> CommandError:
    """Return the error of an operation that ended as failed or stopped, with ``more`` after its message."""
    message = f"operation {record['id']} ended as {record['state']}"
    error = record["error"] or {"code": record["state"], "message": message}
    return CommandError(error["code"], f"{error['message']}{more}", detail={"operation": record})


@command(
    "stop",
    option("--without-daemon", "of a head whose daemon is dead: stop on the servo line of --config"),
    *DAEMON,
)
def _stop(args: argparse.Namespace) -> Answer:
    if args.without_daemon:
        from drivers.open_hardware import halt_head
        from mastctl.config import load_head

        if args.config is None:
            raise WrongUse("--config is missing; the configuration of the head is expected")
        lines = halt_head(load_head(args.config))
        return Answer({"halted": True, "said": lines}, "; ".join(lines))
    answer = _by_any_path(args, "stop", lambda client: client.stop())
    operation = answer.get("operation")
    return Answer(
        answer, f"stopped at {answer['reached']}{f', operation {operation} too' if operation else ''}"
    )


@command(
    "estop",
    option("--reason TEXT", "the reason, for the person who resets it"),
    option("--name NAME", "the name of the person who stops it"),
    *DAEMON,
    example='--name Ana --reason "sparks at the mast"',
)
def _estop(args: argparse.Namespace) -> Answer:
    reason, name = (" ".join((text or "").split()) for text in (args.reason, args.name))
    line = f"estop {name.replace(':', ' ')}: {reason}"
    answer = _by_any_path(args, line, lambda client: client.estop(reason=reason or None, name=name or None))
    latched = f"stopped at {answer['reached']} and latched ({answer.get('name')}: {answer.get('reason')})"
    if answer.get("message"):
        latched += f"; {answer['message']}"
    return Answer(answer, f"{latched}; 'mastctl reset --reason ... --name ...' releases it")


@command(
    "reset",
    option("--reason TEXT", "why it is safe to move again", required=True),
    option("--name NAME", "the name of the person who releases it", required=True),
    *DAEMON,
    example='--name Ana --reason "cable mended"',
)
def _reset(args: argparse.Namespace) -> Answer:
    with client_of(args, default_address=True) as client:
        answer = client.reset(reason=args.reason, name=args.name)
    was = answer["released"]
    return Answer(answer, f"released (it was latched by {was['name']}, {was['at']}: {was['reason']})")


def _by_any_path(
    args: argparse.Namespace, line: str, request: Callable[[Client], Mapping[str, Any]]
) -> Mapping[str, Any]:
    """Stop by the stop socket where there is one, else over HTTP; ``reached``: the socket or address."""
    from mastctl.client import ClientError
    from mastctl.client.client import STOP_ANSWER_S
    from mastctl.safety.stop_socket import NoAnswer
    from mastctl.safety.stop_socket import request as request_stop

    for paths in _sockets(args):
        answer: Mapping[str, Any] | None = None
        failed = ""
        for path in paths:
            try:
                answer = {**request_stop(path, line), "reached": str(path)}
            except NoAnswer:
                continue
            except ValueError as error:
                failed = str(error)
        if failed:  # one of them could not; another path would meet the same head
            raise CommandError("stop_failed", failed)
        if answer is not None:
            return answer
    try:
        with client_of(args, default_address=True, timeout_s=STOP_ANSWER_S) as client:
            return {**request(client), "reached": client.url}
    except ClientError as error:
        if error.code == "timeout":
            raise CommandError(error.code, f"{error}; {HUNG_DAEMON}") from None
        if error.code != "no_daemon":
            raise
        why = str(error).partition(";")[0]  # to start a daemon is no help here
        raise CommandError(error.code, f"{why}; {WITHOUT_DAEMON}") from None


def _sockets(args: argparse.Namespace) -> Iterator[list[Path]]:
    """The stop sockets of the daemon that is meant; the next ones if the ones before do not answer."""
    from mastctl.packaged import default_config
    from mastctl.safety.state_folder import head_folders, usual_folder
    from mastctl.safety.stop_socket import sockets_of

    url = args.url or os.environ.get("MASTCTL_URL")
    if url is not None:
        yield sockets_of(None, None if args.config is None else Path(args.config), url)
        return
    config = default_config() if args.config is None else Path(args.config)
    known = sockets_of(None, config, None)
    if len(known) == 1:  # found without reading the configuration, which takes longer than the stop
        yield known
    from calib.errors import BadFile
    from mastctl.config import load_config, load_head

    with contextlib.suppress(BadFile):
        loaded = load_config(config)
        if loaded.state_folder is not None:
            yield sockets_of(loaded.state_folder, None, None)
        else:
            yield sockets_of(None, config, loaded.listen.url)
            yield sockets_of(usual_folder(config, loaded.listen.url), None, None)
    from drivers.hardware import head_name

    with contextlib.suppress(BadFile):  # a daemon of this head by another configuration
        name = head_name(load_head(config))
        for folder in [] if name is None else head_folders(name):
            yield sockets_of(folder, None, None)
    yield known  # or this configuration, by --listen

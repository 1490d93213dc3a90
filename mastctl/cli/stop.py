"""Commands that stop: ``stop``, ``estop``, its ``reset``, and ``halt``, which asks no daemon.

A stop works whatever else does not: with a configuration that cannot be read, and when the web side of the
daemon does not answer, by its stop socket.
"""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli.output import CommandError
from mastctl.cli.service import add_daemon_options, client_of, tell_result

if TYPE_CHECKING:
    from mastctl.client import Client

WITHOUT_DAEMON = (
    "if the head moves, end the program that moves it ('camera sync', 'pytest') with Ctrl-C, "
    "or stop it with 'mastctl halt --config FILE'"
)


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add stop, estop, reset and halt."""
    stop = subparsers.add_parser("stop", help="stop the mast at once")
    stop.set_defaults(run=_stop)

    estop = subparsers.add_parser(
        "estop", help="stop the mast at once, and let nothing move it until 'mastctl reset'"
    )
    estop.add_argument("--reason", metavar="WORDS", help="the reason, for the person who resets it")
    estop.add_argument("--name", metavar="WHO", help="who stops it")
    estop.set_defaults(run=_estop)

    reset = subparsers.add_parser("reset", help="release an emergency stop; nothing moves by that")
    reset.add_argument("--reason", required=True, metavar="WORDS", help="why it is safe to move again")
    reset.add_argument("--name", required=True, metavar="WHO", help="who says so")
    reset.set_defaults(run=_reset)

    halt = subparsers.add_parser(
        "halt",
        help="stop a head whose daemon is dead: opens its servo line, says stop on it, and nothing else",
    )
    halt.add_argument("--config", required=True, metavar="FILE", help="the daemon's configuration")
    halt.set_defaults(run=_halt)

    for client in (stop, estop, reset):
        add_daemon_options(client)


def _stop(args: argparse.Namespace) -> int:
    answer = _by_any_way(args, "stop", lambda client: client.stop())
    operation = answer.get("operation")
    line = f"stopped at {answer['reached']}{f', operation {operation} too' if operation else ''}"
    tell_result(args, answer, line)
    return 0


def _estop(args: argparse.Namespace) -> int:
    reason, name = (" ".join((words or "").split()) for words in (args.reason, args.name))
    line = f"estop {name.replace(':', ' ')}: {reason}"
    answer = _by_any_way(args, line, lambda client: client.estop(reason=reason or None, name=name or None))
    words = f"stopped at {answer['reached']} and latched ({answer.get('name')}: {answer.get('reason')})"
    if answer.get("message"):
        words += f"; {answer['message']}"
    tell_result(args, answer, f"{words}; 'mastctl reset --reason ... --name ...' releases it")
    return 0


def _reset(args: argparse.Namespace) -> int:
    with client_of(args, whatever_configured=True) as client:
        answer = client.reset(reason=args.reason, name=args.name)
    was = answer["released"]
    tell_result(args, answer, f"released (it was latched by {was['name']}, {was['at']}: {was['reason']})")
    return 0


def _by_any_way(
    args: argparse.Namespace, line: str, ask: Callable[[Client], Mapping[str, Any]]
) -> Mapping[str, Any]:
    """Ask by the stop socket where there is one, else over HTTP; ``reached``: the socket or address."""
    from mastctl.safety.stop_line import NoAnswer
    from mastctl.safety.stop_line import ask as ask_socket

    answer: Mapping[str, Any] | None = None
    failed = ""
    for paths in _sockets(args):
        for path in paths:
            try:
                answer = {**ask_socket(path, line), "reached": str(path)}
            except NoAnswer:
                continue
            except ValueError as error:
                failed = str(error)
        if answer is not None or failed:
            break
    if failed:  # one of them could not; another way would meet the same head
        raise CommandError("stop_failed", failed)
    if answer is not None:
        return answer
    from mastctl.client import ClientError

    try:
        with client_of(args, whatever_configured=True) as client:
            return {**ask(client), "reached": client.url}
    except ClientError as error:
        if error.code != "no_daemon":
            raise
        why = str(error).partition(";")[0]  # to start a daemon is no help here
        raise CommandError(error.code, f"{why}; {WITHOUT_DAEMON}") from None


def _sockets(args: argparse.Namespace) -> Iterator[list[Path]]:
    """The stop sockets of the daemon that is meant; the next ones if nobody answers at the ones before."""
    from calib.errors import BadFile
    from mastctl.config import load_config, load_head
    from mastctl.packaged import default_config
    from mastctl.safety.state_folder import usual_folder
    from mastctl.safety.stop_line import sockets_of

    url = args.url or os.environ.get("MASTCTL_URL")
    if url is not None:
        yield sockets_of(None, None if args.config is None else Path(args.config), url)
        return
    config = default_config() if args.config is None else Path(args.config)
    with contextlib.suppress(BadFile):
        loaded = load_config(config)
        if loaded.state_folder is not None:
            yield sockets_of(loaded.state_folder, None, None)
        else:
            yield sockets_of(None, config, loaded.listen.url)
            yield sockets_of(usual_folder(config, loaded.listen.url), None, None)
    from drivers.hardware import head_name  # only where nobody answered yet: a stop is quick
    from mastctl.safety.heads import head_folders

    with contextlib.suppress(BadFile):  # whoever drives this head, by whatever configuration
        name = head_name(load_head(config))
        for folder in [] if name is None else head_folders(name):
            yield sockets_of(folder, None, None)
    yield sockets_of(None, config, None)  # or this configuration, by --listen


def _halt(args: argparse.Namespace) -> int:
    from drivers.open_hardware import halt_head
    from mastctl.config import load_head

    said = halt_head(load_head(args.config))
    tell_result(args, {"halted": True, "said": said}, "; ".join(said))
    return 0

"""What a running daemon is run with: its lease, tokens, mast file, configuration, and simulated faults."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from mastctl.cli import output
from mastctl.cli.daemon import CONFIG, DAEMON, URL, client_of
from mastctl.cli.options import GROUPS, command, finite_number, option
from mastctl.cli.output import Answer, CommandError, Shown, WrongUse, cell
from mastctl.cli.service import steers

if TYPE_CHECKING:
    from mastctl.answers import FaultSet, MastChange
    from mastctl.http.tokens import TokenList

GROUPS |= {
    "rig lease": "the lease: the right to steer the rover, and its holder",
    "rig token": "tokens of a daemon that is reached from other machines",
    "rig mast": "the mast file that a running daemon points by",
    "rig fault": "the faults of a simulated rover",
}


@command("rig lease show", *DAEMON, help="show the client that steers")
def _show_lease(args: argparse.Namespace) -> Answer:
    with client_of(args) as client:
        control = client.control()
    return Answer({"control": control}, steers(control))


@command(
    "rig lease take",
    option("--name NAME", "the holder's name (default: user@host)"),
    option("--reason TEXT", "take the lease from its holder, and show the holder this reason"),
    option("--for S", "how long, seconds up to 3600", dest="for_s", default=30.0),
    *DAEMON,
    help="acquire the lease and print its id, for --lease; with --reason from its holder",
    example="--for 60",
)
def _take(args: argparse.Namespace) -> Answer:
    with client_of(args) as client:
        granted = client.acquire_lease(args.name, args.for_s, args.reason)
    return Answer(granted, granted["lease_id"])


@command(
    "rig lease renew",
    option("--for S", "how long, seconds up to 3600 (default: as long as at first)", dest="for_s"),
    *DAEMON,
    help="have a lease run on from now",
    example="--lease 0f3c --for 60",
)
def _renew(args: argparse.Namespace) -> Answer:
    _check_named(args)
    with client_of(args) as client:
        granted = client.renew_lease(args.for_s)
    return Answer(granted, steers(granted))


@command("rig lease release", *DAEMON, help="let others steer", example="--lease 0f3c")
def _release(args: argparse.Namespace) -> Answer:
    _check_named(args)
    with client_of(args) as client:
        client.release_lease()
    return Answer({"released": True}, "released")


def _check_named(args: argparse.Namespace) -> None:
    if args.lease is None:
        raise WrongUse("--lease is missing; the id that 'mastctl rig lease take' printed is expected")


TOKEN = (URL, CONFIG, option("--state FOLDER", "state folder of a daemon that does not run now"))


@command(
    "rig token new",
    option("--name NAME", "the name of its user, in the record of commands", required=True),
    option("--role view|operate|admin", "what it allows", required=True),
    *TOKEN,
    help="make a token and print it; it is shown once and kept nowhere",
    example="--name wall --role view",
)
def _new(args: argparse.Namespace) -> Answer:
    text = _tokens(args).new(args.name, args.role)
    return Answer({"name": args.name, "role": args.role, "token": text}, text)


@command("rig token list", *TOKEN, help="show names and roles of the tokens")
def _list(args: argparse.Namespace) -> Answer:
    return Answer({"tokens": [one.model_dump(exclude={"sha256"}) for one in _tokens(args).read() or ()]})


@command(
    "rig token revoke",
    option("NAME", "as 'mastctl rig token list' shows it"),
    *TOKEN,
    help="let a token open nothing any more; sessions by it end too",
    example="wall",
)
def _revoke(args: argparse.Namespace) -> Answer:
    revoked = _tokens(args).revoke(args.name)
    document = {"revoked": revoked.name, "role": revoked.role}
    return Answer(document, f"{revoked.name} ({revoked.role}) opens nothing any more")


def _tokens(args: argparse.Namespace) -> TokenList:
    """The list that the daemon reads."""
    from mastctl.http.tokens import LIST_NAME, TokenList

    folder = args.state or _folder_of_running(args)
    if args.state is not None and not (folder / LIST_NAME).exists():
        missing = "no daemon has kept its state here that requires tokens; its first run makes them"
        raise output.unusable(str(folder), missing)
    owner = folder.stat().st_uid
    if owner != os.geteuid():  # what root writes there the daemon could not read
        user = output.user_name(owner)
        message = f"{folder} belongs to {user}, whose daemon reads it: sudo -u {user} mastctl rig token ..."
        raise CommandError("another_user", message)
    return TokenList(folder)


def _folder_of_running(args: argparse.Namespace) -> Path:
    """Where the running daemon reads tokens."""
    from mastctl.client import ClientError

    with client_of(args) as client:
        try:
            folder = client.live().get("token_folder")
        except ClientError as error:
            if error.code != "no_daemon":
                raise
            message = (
                f"no daemon answers at {client.url}, and only a running one knows where it reads its tokens: "
                "start it, or name the folder of one that has run by --state FOLDER"
            )
            raise CommandError(error.code, message) from None
    if folder is None:
        message = f"the daemon at {client.url} requires no token, or is on another machine: make it there"
        raise CommandError("no_tokens", message)
    return Path(folder)


@command(
    "rig mast show",
    option("--out FILE", "write the one in use to this file too, byte for byte"),
    *DAEMON,
    help="show which is in use, and which was before",
    example="--out now.yaml",
)
def _show_mast(args: argparse.Namespace) -> Answer:
    if args.out is not None:
        output.check_file(args.out, "--out")
    with client_of(args) as client:
        status = client.status()
        if args.out is not None:
            args.out.write_bytes(client.mast_file())
    return _masts({"mast": status["mast"], "former_mast": status["former_mast"]})


@command(
    "rig mast use",
    option("NAME", "its name, without a folder"),
    *DAEMON,
    help="use another of the same folder; pictures taken before are refused",
    example="rocky8-refined.yaml",
)
def _use(args: argparse.Namespace) -> Answer:
    with client_of(args) as client:
        return _masts(client.use_mast(args.name))


@command("rig mast back", *DAEMON, help="go back to the one that was in use before")
def _back(args: argparse.Namespace) -> Answer:
    with client_of(args) as client:
        return _masts(client.use_former_mast())


def _masts(masts: MastChange) -> Answer:
    now, former = masts["mast"], masts["former_mast"]
    line = f"{now['file']} ({now['name']}, {now['digest'][:8]}...)"
    if former is not None:
        line += f", before {former['file']} ({former['digest'][:8]}...)"
    return Answer(masts, line)


@command("rig fault list", *DAEMON, help="show which are switched on")
def _faults(args: argparse.Namespace) -> Answer:
    with client_of(args) as client:
        return _switched_on(client.faults())


@command(
    "rig fault set",
    option("DEVICE", "pan_tilt, a camera, ... (docs/how-to/simulation.md)"),
    option("FAULT", "its name: off, stuck, dark, ..."),
    option("[NAME=VALUE...]", "how much of it", dest="parameters"),
    *DAEMON,
    help="switch one on",
    example="navcam_left dark for_s=5",
)
def _set_fault(args: argparse.Namespace) -> Answer:
    parameters = dict(map(_parameter, args.parameters))
    with client_of(args) as client:
        return _switched_on(client.set_fault(args.device, args.fault, **parameters))


@command(
    "rig fault clear",
    option("[DEVICE]", "only its faults (default: all)"),
    *DAEMON,
    help="switch those of a device off, or all",
    example="navcam_left",
)
def _clear(args: argparse.Namespace) -> Answer:
    with client_of(args) as client:
        client.clear_faults(args.device)
        return _switched_on(client.faults())


def _parameter(text: str) -> tuple[str, float]:
    name, equals, value = text.partition("=")
    try:
        if equals and name.isidentifier():
            return name, finite_number(value)
    except argparse.ArgumentTypeError:
        pass
    raise WrongUse(f"'{text}' where NAME=VALUE with a finite number is expected, such as sigma=8")


def _switched_on(faults: list[FaultSet]) -> Answer:
    return Answer({"faults": faults}, None if faults else "no fault is switched on")


@command(
    "rig reload",
    *DAEMON,
    help="have the daemon read its configuration again; all of it comes into use, or nothing",
)
def _reload(args: argparse.Namespace) -> Answer:
    with client_of(args) as client:
        answer = client.reload()
    mast, changed = answer["mast"], answer["changed"]
    title = f"mastctl at {client.url}: {'changed' if changed else 'nothing changed'}"
    rows = [(one["key"], cell(one["before"]), cell(one["after"])) for one in changed]
    notes = [f"mast file {mast['file']} ({mast['digest'][:8]}...)", *answer["notes"]]
    return Answer(answer, Shown(title, ("key", "before", "now"), rows, notes))

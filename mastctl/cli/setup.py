"""Setting up: ``doctor``, ``schema``, ``token``, ``completion``."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import CommandError, WrongUse

if TYPE_CHECKING:
    from mastctl.client.answers import Status
    from mastctl.http.tokens import TokenList


SHELLS = ("bash", "zsh", "tcsh")
MARKS = {"good": "✓", "unsure": "?", "bad": "✗"}


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add doctor, schema, token and completion."""
    for add in (_add_doctor, _add_schema, _add_token, _add_completion):
        add(subparsers)


def _add_doctor(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add doctor."""
    doctor = subparsers.add_parser(
        "doctor", help="look for what this machine lacks for a configuration; opens and moves nothing"
    )
    doctor.add_argument(
        "--config", metavar="FILE", help="configuration (default: the packaged simulated rover)"
    )
    doctor.set_defaults(run=_doctor)


def _doctor(args: argparse.Namespace) -> int:
    from mastctl.setup.doctor import examine, next_command

    found = []
    for finding in examine(args.config, _asked):
        found.append(finding)
        if args.json:
            continue
        told = f"{MARKS[finding.level]} {finding.what}: {finding.sentence}"
        sys.stdout.write(output.one_line(told) + "\n")
        if finding.advice:
            sys.stdout.write(f"    {output.one_line(finding.advice)}\n")
    bad = sum(finding.level == "bad" for finding in found)
    unsure = sum(finding.level == "unsure" for finding in found)
    if args.json:
        output.print_json(
            {
                "bad": bad,
                "unsure": unsure,
                "findings": [vars(finding) for finding in found],
                "next": next_command(args.config, found),
            }
        )
    else:
        words = "nothing stands in the way" if not bad else f"{bad} to be mended before the daemon can work"
        sys.stdout.write(f"{words}{f'; {unsure} to think about' if unsure else ''}\n")
        sys.stdout.write(output.one_line(f"next: {next_command(args.config, found)}") + "\n")
    return 1 if bad else 0


def _asked(url: str) -> Status | None:
    """The status of a daemon, if one answers."""
    from mastctl.client import Client, ClientError

    try:
        with Client(url) as client:
            return client.status()
    except ClientError:
        return None


def _add_schema(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add schema."""
    schema = subparsers.add_parser(
        "schema",
        help="print the JSON Schema of a file that people write, for editors; without NAME: a list",
    )
    schema.add_argument("name", nargs="?", metavar="NAME", help="config, mast, board ...")
    schema.set_defaults(run=_schema)


def _schema(args: argparse.Namespace) -> int:
    import json

    from mastctl.packaged import schema_files

    files = schema_files()
    if args.name is None:
        titles = {name: json.loads(file.read_bytes())["title"] for name, file in files.items()}
        if args.json:
            output.print_json({"schemas": titles})
        else:
            output.print_table("schemas", ("name", "of"), list(titles.items()))
        return 0
    if args.name not in files:
        raise WrongUse(f"'{args.name}' is not a valid schema; there are {', '.join(files)}")
    sys.stdout.write(files[args.name].read_text(encoding="utf-8"))
    return 0


def _add_token(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add token new, token list and token revoke."""
    token = subparsers.add_parser("token", help="tokens of a daemon that is reached from other machines")
    verbs = token.add_subparsers(dest="verb", metavar="VERB", required=True)
    new = verbs.add_parser("new", help="make a token and print it; it is shown once and kept nowhere")
    new.add_argument("--name", required=True, help="whose it is; the record of commands names it")
    new.add_argument("--role", required=True, choices=("view", "operate", "admin"), help="what it allows")
    new.set_defaults(run=_new)
    shown = verbs.add_parser("list", help="show names and roles of the tokens")
    shown.set_defaults(run=_list)
    revoke = verbs.add_parser("revoke", help="let a token open nothing any more; sessions by it end too")
    revoke.add_argument("name", metavar="NAME", help="as 'mastctl token list' shows it")
    revoke.set_defaults(run=_revoke)
    for one in (new, shown, revoke):
        one.add_argument("--url", help="the running daemon's address (default: that of the configuration)")
        one.add_argument("--config", metavar="FILE", help="the configuration that the daemon runs with")
        one.add_argument("--state", metavar="FOLDER", help="state folder of a daemon that does not run now")


def _new(args: argparse.Namespace) -> int:
    text = _tokens(args).new(args.name, args.role)
    if args.json:
        output.print_json({"name": args.name, "role": args.role, "token": text})
    else:
        sys.stdout.write(f"{text}\n")
    return 0


def _list(args: argparse.Namespace) -> int:
    tokens = _tokens(args)
    held = tokens.read() or ()
    if args.json:
        output.print_json({"tokens": [one.model_dump(exclude={"sha256"}) for one in held]})
        return 0
    rows = [(one.name, one.role, one.made) for one in held]
    output.print_table(f"tokens in {tokens.folder}", ("name", "role", "made"), rows)
    return 0


def _revoke(args: argparse.Namespace) -> int:
    revoked = _tokens(args).revoke(args.name)
    if args.json:
        output.print_json({"revoked": revoked.name, "role": revoked.role})
    else:
        sys.stdout.write(output.one_line(f"{revoked.name} ({revoked.role}) opens nothing any more") + "\n")
    return 0


def _tokens(args: argparse.Namespace) -> TokenList:
    """The list that the daemon reads."""
    from mastctl.http.tokens import TokenList

    folder = _folder_of_running(args) if args.state is None else _folder_kept(args.state)
    owner = folder.stat().st_uid
    if owner != os.geteuid():  # what root writes there the daemon could not read
        user = output.user_name(owner)
        words = f"{folder} belongs to {user}, whose daemon reads it: sudo -u {user} mastctl token ..."
        raise CommandError("another_user", words)
    return TokenList(folder)


def _folder_of_running(args: argparse.Namespace) -> Path:
    """Where the running daemon says that it reads tokens."""
    from mastctl.cli.service import client_of
    from mastctl.client import ClientError

    with client_of(args) as client:
        try:
            folder = client.live().get("token_folder")
        except ClientError as error:
            if error.code != "no_daemon":
                raise
            words = (
                f"no daemon answers at {client.url}, and only a running one knows where it reads its tokens: "
                "start it, or name the folder of one that has run by --state FOLDER"
            )
            raise CommandError(error.code, words) from None
    if folder is None:
        words = f"the daemon at {client.url} requires no token, or is on another machine: make it there"
        raise CommandError("no_tokens", words)
    return Path(folder)


def _folder_kept(named: str) -> Path:
    """The folder of --state, if a daemon that requires tokens has kept its state there."""
    from mastctl.http.tokens import LIST_NAME

    folder = Path(named)
    if not (folder / LIST_NAME).exists():
        words = "no daemon has kept its state here that requires tokens; its first run makes them"
        raise output.unusable(str(folder), words)
    return folder


def _add_completion(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add completion."""
    completion = subparsers.add_parser(
        "completion", help="print what makes a shell complete commands and options, or install it"
    )
    completion.add_argument("shell", choices=SHELLS, help="shell that completes the commands")
    completion.add_argument(
        "--install",
        action="store_true",
        help="write it where the shell finds it, for this user (bash and zsh)",
    )
    completion.set_defaults(run=_completion)


def _completion(args: argparse.Namespace) -> int:
    from mastctl.cli.main import build_parser

    try:
        import shtab
    except ImportError:
        words = "shtab is not installed, which writes completions: pip install 'mastctl[completion]'"
        raise CommandError("no_shtab", words) from None
    script = shtab.complete(build_parser([]), shell=args.shell)
    if not args.install:
        sys.stdout.write(script)
        return 0
    if args.shell not in PLACES:
        raise WrongUse(f"--install knows no place for {args.shell}; bash or zsh is expected")
    data = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    file = Path(data) / PLACES[args.shell]
    _write(file, script)
    advice = f"; add to ~/.zshrc before compinit: fpath+=({file.parent})" if args.shell == "zsh" else ""
    output.tell(f"written: {file}; it works in the next {args.shell}{advice}")
    return 0


PLACES = {"bash": "bash-completion/completions/mastctl", "zsh": "zsh/site-functions/_mastctl"}
"""Under $XDG_DATA_HOME; bash-completion looks there by itself."""


def _write(file: Path, text: str) -> None:
    """Write a file and the folders to it."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise output.unusable(str(file), str(error.strerror)) from None

"""Commands on a daemon whose answer is a record: most send one request; tokens; the drift sentinel."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

from mastctl.cli import output
from mastctl.cli.daemon import CONFIG, DAEMON, URL, client_of
from mastctl.cli.options import GROUPS, Option, command, finite_number, option
from mastctl.cli.output import Answer, CommandError, WrongUse, tables_at

if TYPE_CHECKING:
    from mastctl.client import Client
    from mastctl.http.tokens import TokenList

GROUPS |= {
    "rig lease": "the lease: the right to steer the rover, and its holder",
    "rig token": "tokens of a daemon that is reached from other machines",
    "rig mast": "the mast file that a running daemon points by",
    "rig fault": "the faults of a simulated rover",
    "rig sentinel": "notice a bumped camera, a slipped joint, a lens refocused",
}

TRACK = "state pair range_m position_m predicted operation reason"
"""What people see of a track."""


Send = Callable[["Client", argparse.Namespace], Mapping[str, Any]]


class Request(NamedTuple):
    """A command of one request: ``POST /mast file`` has a path, with the values of arguments in braces, and
    the arguments that its body has; or a function sends it.

    People see ``line``, with keys of the answer in braces, or else its values at ``keys``, or all of it.
    """

    name: str
    help: str
    send: str | Send
    options: tuple[Option, ...] = ()
    example: str = ""
    line: str = ""
    keys: str = ""

    def run(self, args: argparse.Namespace) -> Answer:
        """Send it and return the answer."""
        with client_of(args) as client:
            if isinstance(self.send, str):
                method, path, *names = self.send.split()
                texts = {name: quote(str(value), safe="") for name, value in vars(args).items()}
                body = {name: getattr(args, name) for name in names}
                answer = client.request(method, path.format_map(texts), **body)
            else:
                answer = dict(self.send(client, args))
        if self.line:
            return Answer(answer, self.line.format_map(answer))
        return Answer(answer, tables_at(answer, self.keys))


def _clear_faults(client: Client, args: argparse.Namespace) -> Mapping[str, Any]:
    client.clear_faults(args.device)
    return {"faults": client.faults()}


def _parameter(text: str) -> tuple[str, float]:
    """Read ``NAME=VALUE`` (argparse ``type``)."""
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"'{text}' where NAME=VALUE is expected, such as sigma=8")
    return name, finite_number(value)


def _settings(client: Client, args: argparse.Namespace) -> Mapping[str, Any]:
    from drivers.interfaces import SETTINGS

    if not args.changes:
        return client.camera_settings(args.camera)
    for name, _ in args.changes:
        if name not in SETTINGS:
            raise WrongUse(f"'{name}' where one of {', '.join(SETTINGS)} is expected")
    return client.set_camera(args.camera, **dict(args.changes))


CHANGED_MAST = "{mast[file]} ({mast[name]}) is in use, before {former_mast[file]}"

REQUESTS = (
    Request("rig lease show", "show the client that steers", "GET /lease"),
    Request(
        "rig lease take",
        "acquire the lease and print its id, for --lease; with --reason from its holder",
        lambda client, args: client.acquire_lease(args.name, args.for_s, args.reason),
        (
            option("--name NAME", "the holder's name (default: user@host)"),
            option("--reason TEXT", "take the lease from its holder, and show the holder this reason"),
            option("--for S", "how long, seconds up to 3600", dest="for_s", default=30.0),
        ),
        "--for 60",
        line="{lease_id}",
    ),
    Request("rig lease release", "let others steer", "DELETE /lease", (), "--lease 0f3c", "released"),
    Request(
        "rig mast use",
        "use another of the same folder; pictures taken before are refused",
        "POST /mast file",
        (option("NAME", "its name, without a folder", dest="file"),),
        "rocky8-refined.yaml",
        CHANGED_MAST,
    ),
    Request(
        "rig mast back",
        "go back to the one that was in use before",
        "POST /mast/back",
        line=CHANGED_MAST,
    ),
    Request("rig fault list", "show which are switched on", "GET /simulation/faults"),
    Request(
        "rig fault set",
        "switch one on",
        lambda client, args: {"faults": client.set_fault(args.device, args.fault, **dict(args.parameters))},
        (
            option("DEVICE", "pan_tilt, a camera, ... (docs/how-to/simulation.md)"),
            option("FAULT", "its name: off, stuck, dark, ..."),
            option("[NAME=VALUE...]", "how much of it", dest="parameters", type=_parameter),
        ),
        "navcam_left dark for_s=5",
    ),
    Request(
        "rig fault clear",
        "switch those of a device off, or all",
        _clear_faults,
        (option("[DEVICE]", "only its faults (default: all)"),),
        "navcam_left",
    ),
    Request(
        "record start",
        "have the daemon record until 'record stop'",
        "POST /recordings/start name",
        (option("[NAME]", "part of the file's name", default=""),),
        "afternoon",
        "recording {run} in {folder}; 'mastctl record stop' ends it",
    ),
    Request(
        "record stop",
        "end the recording that 'record start' began",
        "POST /recordings/stop",
        keys="file size_mb dropped",
    ),
    Request(
        "record list",
        "list the daemon's recordings: runs, what faults kept, the ring",
        "GET /recordings",
        keys="recordings.kind recordings.name recordings.size_mb recordings.files recorder",
    ),
    Request(
        "camera settings",
        "show a daemon's camera's exposure, gain, white balance and focus, or change them",
        _settings,
        (
            option("CAMERA", "the camera's name in the configuration"),
            option("[NAME=VALUE...]", "as exposure_s=0.004 or gain=20", dest="changes", type=_parameter),
        ),
        "navcam_left exposure_s=0.004 gain=20",
    ),
    Request(
        "track status",
        "show the track, and offsets found by hand-offs",
        "GET /track",
        keys=TRACK,
    ),
    Request(
        "panorama list",
        "list a daemon's panoramas, the newest first",
        "GET /panoramas",
    ),
    Request(
        "panorama delete",
        "delete a panorama of a daemon with its pictures",
        "DELETE /panoramas/{id}",
        (option("ID", "as 'mastctl panorama list' shows it", dest="id"),),
        "20260101-120000-1a2b",
    ),
    Request(
        "panorama forget",
        "forget a target",
        "DELETE /targets/{name}",
        (option("NAME", "of the target"),),
        "outcrop",
    ),
    Request("track stop", "end the track", "POST /track/stop", keys=TRACK),
)  # fmt: skip

for _one in REQUESTS:
    command(_one.name, *_one.options, *DAEMON, help=_one.help, example=_one.example)(_one.run)


TOKEN = (URL, CONFIG)


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
    return Answer({"revoked": revoked.name, "role": revoked.role})


def _tokens(args: argparse.Namespace) -> TokenList:
    """The list that the daemon reads: only a running one knows where."""
    from mastctl.http.tokens import TokenList

    with client_of(args) as client:
        folder = client.request("GET", "/health/live").get("token_folder")
    if folder is None:
        message = f"the daemon at {client.url} requires no token, or is on another machine: make it there"
        raise CommandError("no_tokens", message)
    owner = Path(folder).stat().st_uid
    if owner != os.geteuid():  # what root writes there the daemon could not read
        message = f"{folder} belongs to user {owner}: sudo -u '#{owner}' mastctl rig token ..."
        raise CommandError("another_user", message)
    return TokenList(Path(folder))


FOLDER = option("--folder DIR", "the folder of references and results", required=True)


@command(
    "rig sentinel reference",
    option("--pose PAN TILT", "a pose, radians; may be repeated (default: six)", repeat=True),
    FOLDER,
    *DAEMON,
    help="take the reference images",
    example="--folder sentinel --pose 0 -0.3",
)
def _reference(args: argparse.Namespace) -> Answer:
    from mastctl.drift.looks import head_cameras, steering, take_pictures, usual_rests
    from mastctl.drift.pictures import now_utc, save_reference

    with client_of(args) as client, steering(client, args.lease):
        rests = args.pose or usual_rests(client)
        _, cameras = head_cameras(client)
        if not cameras:
            raise CommandError("no_camera", "the daemon has no camera on the head")
        with output.waiting(args.json, f"taking images at {len(rests)} poses"):
            pictures, missing = take_pictures(client, rests, cameras)
    if missing:
        place, reason = next(iter(missing.items()))
        raise CommandError("no_picture", f"no reference was taken: {place}: {reason}")
    saved = save_reference(args.folder, now_utc(), rests, pictures)
    return Answer({"folder": str(args.folder), "pictures": len(saved.views), "rests": saved.rests})


@command(
    "rig sentinel look",
    option("--idle-s S", "how long the head must have been idle (default: 0)", default=0.0),
    FOLDER,
    *DAEMON,
    help="take them again and report changes; 1 if there is one",
    example="--folder sentinel",
)
def _look(args: argparse.Namespace) -> Answer:
    from mastctl.drift.looks import look
    from mastctl.drift.pictures import read_looks, read_reference, standing

    with client_of(args) as client, output.waiting(args.json, "taking the reference images again"):
        line = look(client, args.folder, args.lease, args.idle_s)
    reference = read_reference(args.folder)
    now = standing(reference, read_looks(args.folder, reference))
    document = {name: now[name] for name in ("level", "sentence", "since", "looks")} | {"look": line}
    missing = [f"{place}: no image: {reason}" for place, reason in line["missing"].items()]
    return Answer(document, [now["sentence"], *missing], 1 if now["level"] == "bad" else 0)

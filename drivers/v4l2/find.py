"""Which node is which camera: by a stable link or by name, never by its number, which changes.

Only a person who just read a number at the command line may give one: `options_for` turns it into names.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from drivers.errors import BadOptions, DriverError, NoCamera, NoPermission, UnsupportedFormat
from drivers.pixels import FORMATS
from drivers.registry import ProbedCamera
from drivers.v4l2.controls import Value
from drivers.v4l2.node import Node, capture_nodes

LINKS = Path("/dev/v4l")
SYSFS = Path("/sys/class/video4linux")

_NUMBERED = re.compile(r"/dev/video\d+")


class Address(NamedTuple):
    """How a configuration names a camera: by a link that udev keeps, or by card, bus, or both."""

    device: str = ""
    card: str = ""
    bus: str = ""

    def __str__(self) -> str:
        card = f"card {self.card!r}" if self.card else "any card"
        return self.device or (f"{card} at {self.bus}" if self.bus else card)


@dataclass(frozen=True)
class FoundCamera:
    """One connected camera: its node now, its names, and its stable links."""

    node: Path
    driver: str
    card: str
    bus: str
    links: tuple[Path, ...]


def check_address(address: Address, name: str) -> None:
    """Refuse a bare node number, and name what is stable instead. Raises BadOptions."""
    if not any(address):
        raise BadOptions("'device', 'card' or 'bus' is expected: which camera it is", device=name)
    if _NUMBERED.fullmatch(address.device):
        links = stable_links(Path(address.device))
        instead = f"give {links[0]}" if links else "give a link under /dev/v4l/by-id, or 'card' and 'bus'"
        raise BadOptions(
            f"{address.device} is a number that changes when cameras are plugged in; {instead} "
            "(mastctl camera list shows them)",
            device=name,
        )


def open_node(address: Address, name: str) -> Node:
    """Open the camera of an address.

    Raises NoCamera if nothing of that name is connected; BadOptions if several cameras bear it; DriverError.
    """
    if address.device:
        return Node(address.device, name)
    matches = list(_named(address, name))
    if len(matches) == 1:
        return matches[0]
    busses = ", ".join(node.identity.bus for node in matches)
    for node in matches:
        node.close()
    if matches:
        raise BadOptions(f"several cameras match {address}: at {busses}; add 'bus'", device=name)
    raise NoCamera(f"no camera matches {address}; connected are {_connected()}", device=name)


def list_cameras() -> list[FoundCamera]:
    """Return the cameras that are connected and may be opened, in the kernel's order."""
    found = []
    for path in capture_nodes():
        try:
            with Node(path) as node:
                identity = node.identity
        except DriverError:
            continue  # an output, a metadata node, or one without permission
        found.append(
            FoundCamera(path, identity.driver, identity.card, identity.bus, tuple(stable_links(path)))
        )
    return found


def refused_nodes(nodes: Iterable[Path]) -> Iterator[str]:
    """Yield a sentence for each node that this user may not open."""
    for path in nodes:
        try:
            Node(path).close()
        except NoPermission as error:
            yield str(error)
        except DriverError:
            continue


def stable_links(node: Path) -> list[Path]:
    """Return the links under /dev/v4l that lead to a node now: by identity first, then by socket."""
    found = []
    for kind in ("by-id", "by-path"):
        folder = LINKS / kind
        if folder.is_dir():
            found += [link for link in sorted(folder.iterdir()) if link.resolve() == node]
    return found


def _named(address: Address, name: str) -> Iterable[Node]:
    """Open the nodes that bear the address's names."""
    refused: NoPermission | None = None
    any_match = False
    for path in capture_nodes():
        label = _sysfs_name(path)
        try:
            node = Node(path, name)
        except NoPermission as error:
            refused = error
            continue
        except DriverError:
            continue
        identity = node.identity
        if address.card in ("", identity.card, label) and address.bus in ("", identity.bus):
            any_match = True
            yield node
        else:
            node.close()
    if refused is not None and not any_match:
        raise refused


def _sysfs_name(path: Path) -> str:
    """The name that the kernel gives a node; it tells the nodes of one card apart."""
    try:
        return (SYSFS / path.name / "name").read_text().strip()
    except OSError:
        return ""


def _connected() -> str:
    """The connected cameras, as text."""
    return ", ".join(f"{c.card!r} at {c.bus}" for c in list_cameras()) or "none"


def options_for(
    word: str,
    code: str | None,
    size_px: tuple[int, int] | None,
    rate_hz: float | None,
    controls: Mapping[str, Value],
) -> dict[str, Any]:
    """Return options for `open_camera` from a link, a node, a card name or a bus.

    A node's number is good for now, so here, where a person just read it, it is taken and turned into card
    and bus. What is not given stays as the camera has it: size and rate, and the format if it can be read.
    Raises NoCamera if nothing of that name is connected; DriverError if it cannot be opened or has no format
    that can be read.
    """
    path = _node_path(word)
    with Node(path, word) as node:
        now = node.current_format()
        if code is None:
            offered = [now.code, *node.formats()]
            code = next((c for c in offered if c in FORMATS), None)
            if code is None:
                raise UnsupportedFormat(
                    f"the camera has only formats that are not read: {', '.join(offered)}", device=word
                )
        identity = node.identity
        address = (
            {"device": word}
            if path == Path(word) and path.is_symlink()
            else {"bus": identity.bus, "card": identity.card}
        )
    return {
        **address,
        "format": code,
        "size_px": list(size_px or now.size_px),
        "controls": dict(controls),
        "rate_hz": rate_hz,
    }


def _node_path(word: str) -> Path:
    """The node that a word means now."""
    if "/" in word:
        return Path(word)
    matches = [c for c in list_cameras() if word in (c.card, c.bus)]
    if len(matches) == 1:
        return matches[0].node
    if matches:
        busses = ", ".join(c.bus for c in matches)
        raise DriverError(f"several cameras have this name; give a bus instead: {busses}", device=word)
    raise NoCamera(f"no camera of this card or bus is connected; connected are {_connected()}", device=word)


LEAST_PX, USUAL_HZ = (640, 480), 30.0


def probe() -> tuple[list[ProbedCamera], list[str], str]:
    """Return cameras as `drivers.registry.Driver.probe`."""
    cameras: list[ProbedCamera] = []
    others = list(refused_nodes(capture_nodes()))
    found = list_cameras()
    for one in found:
        try:
            cameras.append(ProbedCamera(one.card, one.bus, one.node, _usual(one, found), "v4l2"))
        except DriverError as error:
            others.append(f"{one.card} at {one.bus}: {error}")
    return cameras, others, ""


def _usual(camera: FoundCamera, found: list[FoundCamera]) -> dict[str, Any]:
    """A camera's options: its stable link, or card and bus; its format, size and rate, of now or usual.

    Cameras with one serial number have one link by-id together, which can tell none of them.
    """
    alike = [one for one in found if one.card == camera.card]
    by_id = len({link.name for one in alike for link in one.links if link.parent.name == "by-id"}) >= len(
        alike
    )
    now = options_for(str(camera.node), None, None, None, {})
    code, size_px = now["format"], tuple(now["size_px"])
    with Node(camera.node) as node:
        small = any(side < least for side, least in zip(size_px, LEAST_PX, strict=True))
        if small and LEAST_PX in node.sizes(code)[0]:
            size_px = LEAST_PX
        rates_hz = node.rates_hz(code, size_px)
    slow_hz = [rate for rate in rates_hz if rate <= USUAL_HZ + 1e-3]
    rate = {"rate_hz": round(max(slow_hz or rates_hz), 3)} if rates_hz else {}
    links = [link for link in camera.links if by_id or link.parent.name != "by-id"]
    address = {"device": str(links[0])} if links else {"card": camera.card, "bus": camera.bus}
    return {**address, "format": code, "size_px": list(size_px), **rate}


def table() -> tuple[list[dict[str, Any]], list[str]]:
    """Return the connected cameras, as `drivers.registry.CameraBench`."""
    rows = [
        {
            "card": c.card, "bus": c.bus, "driver": c.driver, "node": str(c.node),
            "links": [str(link) for link in c.links],
        }
        for c in list_cameras()
    ]  # fmt: skip
    return rows, list(refused_nodes(capture_nodes()))

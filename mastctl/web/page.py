"""The operator page: its files, read once and compressed, and what of the rig it draws; the site of docs/.

`tools/docs` builds the site, which comes from the wheel or from the checkout.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import math
import re
from collections.abc import Collection, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
from fastapi import FastAPI, Request, Response
from starlette.exceptions import HTTPException
from starlette.responses import RedirectResponse
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from calib.files import is_plain_file
from calib.geometry.rig import RigCamera
from mastctl.answers import CameraMount, RigSummary
from mastctl.as_json import readable
from mastctl.errors import NotKnown
from mastctl.http import PREFIX
from mastctl.packaged import site_folder
from mastctl.service.service import Service
from mastctl.web.commands import Here

ASK_AGAIN = "no-cache"
"""A browser keeps it, and checks each time whether it is still so."""
FOR_GOOD = "public, max-age=31536000, immutable"
"""What stands at this address will never be another text."""
PACKED = {"Content-Encoding": "gzip"}


def text_answer(sent: Mapping[str, str], data: bytes, kind: str, keep: str = ASK_AGAIN) -> Response:
    """Return a text that stays the same while the daemon runs; 304 without it where the client has it.

    ``sent`` are the request's headers, names in lower case; ``kind`` is the media type, ``keep`` the answer's
    Cache-Control.
    """
    tag = f'W/"{digest(data)}"'  # the same for both forms
    headers = {"Cache-Control": keep, "ETag": tag, "Vary": "Accept-Encoding"}
    if tag in sent.get("if-none-match", ""):
        # A browser takes its headers for those of what it has, the policy that goes by the kind too.
        return Response(status_code=304, headers=headers, media_type=kind)
    if _takes_packed(sent):
        return Response(_packed(data), media_type=kind, headers=headers | PACKED)
    return Response(data, media_type=kind, headers=headers)


@cache
def digest(data: bytes) -> str:
    """Return 16 hexadecimal digits that tell a text from others."""
    return hashlib.sha256(data).hexdigest()[:16]


def _takes_packed(sent: Mapping[str, str]) -> bool:
    return "gzip" in sent.get("accept-encoding", "")


@cache
def _packed(data: bytes) -> bytes:
    return gzip.compress(data, mtime=0)


FIRST = "index.html"
KINDS = {
    "html": "text/html; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "svg": "image/svg+xml",
}
MOST_MAST_FILES = 100

Stereo = Mapping[str, tuple[str, str]]


def page_files() -> dict[str, bytes]:
    """Return the page's files by name."""
    folder = files("mastctl.web") / "operator"
    return {one.name: one.read_bytes() for one in folder.iterdir() if one.name.rpartition(".")[2] in KINDS}


def add_page(app: FastAPI) -> None:
    """The page at ``/``, its files below ``/page/``, and ``GET /rig``.

    The page names its files by an address that changes with any of them, so that a browser keeps them.
    """
    known = page_files()
    version = digest(b"".join(known.values()))
    first = known[FIRST].replace(b'"/page/', f'"/page/{version}/'.encode())

    @app.get("/", include_in_schema=False)
    async def page(request: Request) -> Response:
        return text_answer(request.headers, first, KINDS["html"])

    @app.get("/page/{name:path}", include_in_schema=False)
    async def file(name: str, request: Request) -> Response:
        keep = ASK_AGAIN
        if name.startswith(f"{version}/"):
            name, keep = name.removeprefix(f"{version}/"), FOR_GOOD
        if name not in known:
            raise HTTPException(404)
        return text_answer(request.headers, known[name], KINDS[name.rpartition(".")[2]], keep)

    @app.get(f"{PREFIX}/rig", summary="The configured cameras by the mast file in use")
    async def rig(here: Here) -> RigSummary:
        return await here.waiting.run(lambda: rig_summary(here.service))


def rig_summary(service: Service) -> RigSummary:
    """Return what of the rig is drawn. Reads the folder of the mast file."""
    stored = service.stored
    names = service.config.hardware.cameras
    folder = service.masts.in_use.path.parent
    made = stored.rig.provenance.get("date")
    found = sorted(
        one.name for one in folder.glob("*.yaml") if is_plain_file(one) and one.name == readable(one.name)
    )
    return {
        "digest": stored.digest,
        "mast_date": None if made is None else str(made)[:40],
        "modified_s": _modified_s(service.masts.in_use.path),
        "cameras": {
            name: _mount(name, camera, stored.rig.stereo, names)
            for name, camera in stored.rig.cameras.items()
            if name in names
        },
        "mast_files": found[:MOST_MAST_FILES],
    }


def _modified_s(path: Path) -> float | None:
    try:
        return path.stat().st_mtime
    except OSError:  # it was moved since it was read
        return None


def _mount(name: str, camera: RigCamera, stereo: Stereo, names: Collection[str]) -> CameraMount:
    model = camera.model
    width, height = model.size_px
    x, y = (width - 1) / 2, (height - 1) / 2
    places = [(x, y), (0, y), (width - 1, y), (x, 0), (x, height - 1)]
    pair, side, partner = _partners(name, stereo)
    middle, left, right, top, bottom = model.ray(np.array(places, dtype=float)).directions
    return {
        "on": camera.on,
        "size_px": [int(width), int(height)],
        "azimuth_rad": math.atan2(middle[1], middle[0]),
        "elevation_rad": math.asin(float(np.clip(-middle[2], -1.0, 1.0))),
        "width_rad": _between(left, right),
        "height_rad": _between(top, bottom),
        "pair": pair,
        "side": side,
        "partner": partner if partner in names else None,
    }


def _between(one: np.ndarray, other: np.ndarray) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(one, other))), float(one @ other))


def _partners(name: str, stereo: Stereo) -> tuple[str | None, Literal["left", "right"] | None, str | None]:
    """The pair of a camera, which side of it, and the other one."""
    for pair, (left, right) in stereo.items():
        if name in (left, right):
            return pair, "left" if name == left else "right", right if name == left else left
    return None, None, None


_SCRIPT = re.compile(r"<script>(.*?)</script>", re.DOTALL)
"""In the site of docs/."""


def add_site(app: FastAPI) -> None:
    """The site below ``/docs/``; where it was not built, a refusal that says how to build it."""

    @app.get("/docs", include_in_schema=False)
    async def docs() -> Response:
        return RedirectResponse("docs/")  # relative: a proxy may serve the daemon below a path of its own

    app.mount("/docs/", _Site(site_folder()))


class _Site(StaticFiles):
    """Files of a folder that may appear later."""

    def __init__(self, folder: Path) -> None:
        super().__init__(directory=folder, html=True, check_dir=False)
        self._first = folder / "index.html"
        self.config_checked = True  # a folder that is absent is refused below

    async def get_response(self, path: str, scope: Scope) -> Response:
        try:
            return await super().get_response(path, scope)
        except HTTPException as refused:
            if refused.status_code == 404 and not self._first.is_file():
                message = "this installation has no documentation; `tools/docs` in a checkout builds it"
                raise NotKnown("no_docs", message) from None
            raise

    def file_response(self, *args: Any, **options: Any) -> Response:
        answer = super().file_response(*args, **options)
        answer.headers["Cache-Control"] = ASK_AGAIN
        if answer.headers.get("Content-Type", "").startswith("text/html"):
            answer.headers["Content-Security-Policy"] = _policy(self._first)
        return answer


@cache
def _policy(first: Path) -> str:
    """The Content-Security-Policy of the site: of scripts inside a page only the theme's, by its digest."""
    inside = set(_SCRIPT.findall(first.read_text(encoding="utf-8")))
    digests = (base64.b64encode(hashlib.sha256(one.encode()).digest()).decode() for one in sorted(inside))
    scripts = " ".join(["'self'", *(f"'sha256-{one}'" for one in digests)])
    return (
        f"default-src 'self'; script-src {scripts}; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
        "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    )

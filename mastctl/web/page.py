"""The operator page and the site of docs/, which `tools/docs` builds; what of the rig the page draws."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
from fastapi import FastAPI, Request, Response
from starlette.middleware.gzip import GZipMiddleware
from starlette.responses import RedirectResponse
from starlette.staticfiles import StaticFiles

from calib.files import is_plain_file
from calib.geometry.rig import RigCamera
from mastctl.answers import CameraMount, RigSummary
from mastctl.as_json import readable
from mastctl.errors import NotKnown
from mastctl.http import PREFIX
from mastctl.packaged import site_folder
from mastctl.service.service import Service
from mastctl.web.commands import Here

PAGE_FOLDER = Path(__file__).parent / "operator"
MOST_MAST_FILES = 100

Stereo = Mapping[str, tuple[str, str]]


def add_page(app: FastAPI) -> None:
    """The page at ``/``, its files below ``/page/``, and ``GET /rig``."""
    page = StaticFiles(directory=PAGE_FOLDER)
    app.mount("/page/", GZipMiddleware(page))

    @app.get("/", include_in_schema=False)
    async def first(request: Request) -> Response:
        return await page.get_response("index.html", request.scope)

    @app.get(f"{PREFIX}/rig", summary="The configured cameras by the mast file in use")
    async def rig(here: Here) -> RigSummary:
        return await here.waiting.run(lambda: rig_summary(here.service))


def add_site(app: FastAPI) -> None:
    """The site below ``/docs/``; where it was not built, a refusal that says how to build it."""

    @app.get("/docs", include_in_schema=False)
    async def docs() -> Response:
        return RedirectResponse("docs/")  # relative: a proxy may serve the daemon below a path of its own

    if (folder := site_folder()).is_dir():
        app.mount("/docs/", StaticFiles(directory=folder, html=True))
        return

    @app.get("/docs/{path:path}", include_in_schema=False)
    async def absent(path: str) -> Response:
        message = "this installation has no documentation; `tools/docs` in a checkout builds it"
        raise NotKnown("no_docs", message)


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
        "cameras": {
            name: _mount(name, camera, stored.rig.stereo, names)
            for name, camera in stored.rig.cameras.items()
            if name in names
        },
        "mast_files": found[:MOST_MAST_FILES],
    }


def _mount(name: str, camera: RigCamera, stereo: Stereo, names: Collection[str]) -> CameraMount:
    model = camera.model
    width, height = model.size_px
    x, y = (width - 1) / 2, (height - 1) / 2
    places = [(x, y), (0, y), (width - 1, y), (x, 0), (x, height - 1)]
    pair = next((pair for pair, both in stereo.items() if name in both), None)
    left, right = (None, None) if pair is None else stereo[pair]
    partner = right if name == left else left
    middle, *sides = model.ray(np.array(places, dtype=float)).directions
    return {
        "on": camera.on,
        "size_px": [int(width), int(height)],
        "azimuth_rad": math.atan2(middle[1], middle[0]),
        "elevation_rad": math.asin(float(np.clip(-middle[2], -1.0, 1.0))),
        "width_rad": _between(sides[0], sides[1]),
        "height_rad": _between(sides[2], sides[3]),
        "pair": pair,
        "side": None if pair is None else "left" if name == left else "right",
        "partner": partner if partner in names else None,
    }


def _between(one: np.ndarray, other: np.ndarray) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(one, other))), float(one @ other))

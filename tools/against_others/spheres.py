"""Hold what other programs show of a panorama against the project's own map of its pixels.

    npm install pannellum && mastctl panorama compose PANORAMA --surface infinity --raw
    .venv/bin/python -m tools.against_others.spheres PANORAMA --pannellum node_modules/pannellum

Hugin's ``pano_trafo`` (Debian's hugin-tools) maps pixels of each view by the exported project; pannellum
shows the exported sphere in chromium, and parts of what it shows are found in the mosaic by phase
correlation. It puts the middle of a part of a sphere straight ahead, which is allowed for.
"""

from __future__ import annotations

import functools
import http.server
import itertools
import math
import re
import subprocess
import tempfile
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from playwright.sync_api import sync_playwright

from calib.geometry.rigid import FloatArray
from mastctl.panorama import exports
from mastctl.panorama.folder import Folder
from tools.browser import chromium
from tools.command import end, options, rms, show

WEBGL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
PAGE = """<!doctype html><style>body {margin: 0}</style><link rel=stylesheet href=build/pannellum.css>
<script src=build/pannellum.js></script><div id=sphere style="width:900px;height:600px"></div><script>
const options = {type: "equirectangular", panorama: "sphere.jpg", autoLoad: true, showControls: false};
const viewer = pannellum.viewer("sphere", options); viewer.on("load", () => window.loaded = true);</script>"""
SIZE_PX, PART_PX = (900, 600), 128
VIEWS_DEG = ((0, -10, 50), (30, -15, 50), (-40, -5, 50))


def by_hugin(folder: Folder, files: Path) -> FloatArray:
    """Return how far Hugin has pixels of all views from where the mosaic has them, (n, 2) px."""
    assert folder.index.mosaic is not None
    canvas, cameras, project = folder.index.mosaic.canvas, folder.cameras(), files / "sphere.pto"
    exports.hugin(cameras, ["view.png"] * len(cameras), canvas, project)
    crop = re.search(r"S(\d+),\d+,(\d+)", project.read_text())
    assert crop is not None
    off = []
    for number, camera in enumerate(cameras):
        grid = np.array([*itertools.product(*(np.linspace(0, side - 1, 15) for side in camera.size_px))])
        command = ["pano_trafo", str(project), str(number)]
        given = "\n".join(f"{x} {y}" for x, y in grid) + "\n"
        done = subprocess.run(command, input=given, capture_output=True, text=True, check=True)
        found = np.array([line.split() for line in done.stdout.splitlines()], np.float64)
        off.append(found - [int(crop[1]), int(crop[2])] - canvas.of_camera(camera, grid))
    return np.concatenate(off)


def by_pannellum(folder: Folder, files: Path, pannellum: Path) -> FloatArray:
    """Return how far parts of what pannellum shows are from the mosaic's, (n, 2) screen pixels."""
    assert folder.index.mosaic is not None
    canvas, mosaic = folder.index.mosaic.canvas, folder.mosaic()
    exports.gpano(mosaic, canvas, files / "sphere.jpg")
    (files / "build").symlink_to((pannellum / "build").resolve())
    (files / "index.html").write_text(PAGE)
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(files))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    width, height = SIZE_PX
    middle_rad, off = canvas.azimuth_rad + (canvas.size_px[0] - 1) / 2.0 / canvas.px_per_rad, []
    u, v = np.meshgrid(np.arange(width) - (width - 1) / 2.0, np.arange(height) - (height - 1) / 2.0)
    correlate: Any = cv2.phaseCorrelate
    window: Any = cv2.createHanningWindow((PART_PX, PART_PX), cv2.CV_32F)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=WEBGL)
        page = browser.new_page(viewport={"width": width, "height": height})
        page.goto(f"http://127.0.0.1:{server.server_port}/index.html")
        page.wait_for_function("window.loaded", timeout=60_000)
        for yaw, pitch, field in VIEWS_DEG:
            page.evaluate(f"viewer.lookAt({pitch}, {yaw}, {field}, false)")
            page.wait_for_timeout(2000)
            seen = np.radians(page.evaluate("[viewer.getYaw(), viewer.getPitch(), viewer.getHfov()]"))
            shown: Any = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE)
            rays = np.stack([np.full_like(u, width / 2.0 / math.tan(seen[2] / 2.0)), u, v], axis=-1)
            level = rays @ cv2.Rodrigues(np.array([0.0, seen[1], 0.0]))[0].T
            local = level @ cv2.Rodrigues(np.array([0.0, 0.0, seen[0] + middle_rad]))[0].T
            places = canvas.pixels(canvas.rover_from_mosaic.vectors(local)).astype(np.float32)
            ours: Any = cv2.remap(mosaic, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
            ours = ours if ours.ndim == 2 else cv2.cvtColor(ours, cv2.COLOR_BGR2GRAY)
            for x, y in itertools.product(range(60, width - 200, 150), range(60, height - 200, 120)):
                part: Any = np.s_[y : y + PART_PX, x : x + PART_PX]
                pair = np.float32(shown[part]), np.float32(ours[part])
                shift, response = correlate(*pair, window)
                if response > 0.5:
                    off.append(shift)
        browser.close()
    server.shutdown()
    return np.array(off)


def main() -> int:
    """Export, have both programs read it, and print how far they are off."""
    parser = options(__doc__, seed=None, tasks=False, as_json=True)
    parser.add_argument("panorama", type=Path, metavar="PANORAMA", help="its folder")
    parser.add_argument("--pannellum", type=Path, help="folder of the npm package")
    args = parser.parse_args()
    folder, rows = Folder(args.panorama), []
    with tempfile.TemporaryDirectory() as files:
        found = {"Hugin": by_hugin(folder, Path(files))}
        if args.pannellum is not None:
            found["pannellum"] = by_pannellum(folder, Path(files), args.pannellum)
    for name, off in found.items():
        worst_px = np.abs(off).max(axis=0).tolist()
        rows.append({"program": name, "places": len(off), "rms_px": rms(off), "worst_px": worst_px})
    show(args, rows, COLUMNS)
    return 0


COLUMNS: dict[str, Any] = {
    "program": "{program}", "places": "{places}",
    "rms, px": "{rms_px:.3f}", "worst, px": "{worst_px[0]:.3f}, {worst_px[1]:.3f}",
}  # fmt: skip

if __name__ == "__main__":
    end(main)

"""A true daemon on quick devices, and a proxy before it that tells one lie at a time."""

from __future__ import annotations

import http.client
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

from calib.files.mast_file import save_rig
from drivers.clock import Clock, SystemClock
from drivers.errors import NoFreshFrame, NoReply
from drivers.faults import FaultPanel
from drivers.interfaces import Camera, CameraInfo, CameraSetting, Frame
from drivers.sim.axis import AxisSettings
from drivers.sim.heads import HeadModel
from drivers.sim.pan_tilt import SimulatedPanTilt
from hil_tests.mastctl.service_fakes import CONFIG, SIZE_PX, rig
from hil_tests.waiting import NET_S
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon

REPOSITORY = Path(__file__).resolve().parents[3]
HERE = "hil_tests.mastctl.conform.conform_world"
PERIOD_S = 0.02
KEPT_S = 30.0
COUNT_RAD, FASTEST_RAD_PER_S = 1e-4, 2.0
SPEED_RAD_PER_S = 0.5
CRAWLING_RAD_PER_S = 0.001
"""Nothing that a check asks for is reached within a minute: what is done meanwhile is done in the move."""


def open_head(
    low_rad: float = -2.0, high_rad: float = 2.0, name: str = "", clock: Clock | None = None
) -> SimulatedPanTilt:
    """A head in memory; ``name`` tells it from those of other daemons in this process."""
    axis = AxisSettings(COUNT_RAD, 0.0, low_rad, high_rad, FASTEST_RAD_PER_S, 20.0)
    clock = clock or SystemClock()
    return SimulatedPanTilt(HeadModel("in memory", axis, axis), clock, FaultPanel(clock.now_s, ()))


class NoiseCamera(Camera):
    """A free-running camera of 50 Hz that sees noise, and gives the first frame after the moment asked for.

    It has a gain in steps of 4, and a focus.

    It keeps the frames of some seconds, so that both cameras of a pair give frames of one moment,
    however late on a busy machine the second one is asked.
    """

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed
        self.gain = 8.0
        self._closed = threading.Event()

    @property
    def info(self) -> CameraInfo:
        return CameraInfo(period_s=PERIOD_S)

    def settings(self) -> list[CameraSetting]:
        focus = CameraSetting("focus", 30.0, 0.0, 250.0)
        return [CameraSetting("gain", self.gain, 0.0, 100.0, 4.0), focus]

    def adjust(self, wanted: Mapping[str, float]) -> list[str]:
        assert list(wanted) == ["gain"]
        self.gain = wanted["gain"]
        return []

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        now_s = time.monotonic()
        # a thousandth of a period more: what begins at the very moment asked for must not count as before it
        sequence = int(max(exposed_after_s, now_s - KEPT_S) / PERIOD_S + 0.001) + 1
        wait_s = sequence * PERIOD_S + 0.002 - now_s
        if self._closed.wait(max(0.0, min(wait_s, timeout_s))):
            raise NoReply("it is closed")
        if wait_s > timeout_s:
            raise NoFreshFrame(f"no frame within {timeout_s:g} s")
        random = np.random.default_rng((self._seed, sequence))
        image = random.integers(0, 255, SIZE_PX[::-1], dtype=np.uint8)
        settings = {"gain": self.gain}
        return Frame(image, sequence, sequence * PERIOD_S + 0.001, 0.002, settings=settings)

    def close(self) -> None:
        self._closed.set()


def configuration(folder: Path, speed_rad_per_s: float = SPEED_RAD_PER_S) -> Path:
    """A configuration of devices from outside that never wait."""
    save_rig(rig(), folder / "little.yaml")
    head = f"{{driver: '{HERE}:open_head', options: {{name: '{folder.name}'}}}}"
    text = CONFIG.format(listen="{port: 0}").replace("{driver: fake}", head, 1)
    text = re.sub(r"(speed_rad_per_s: )[\d.]+", rf"\g<1>{speed_rad_per_s}", text)
    (folder / "daemon.yaml").write_text(text.replace("{driver: fake}", f"{{driver: '{HERE}:NoiseCamera'}}"))
    return folder / "daemon.yaml"


def accepted(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run the acceptance of drivers as a program of its own, in a folder."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-rs", "--pyargs"]
    path = {**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY), str(folder)])}
    whole = [*command, "mastctl.testing.drivers", *words]
    return subprocess.run(whole, cwd=folder, env=path, capture_output=True, text=True, timeout=NET_S)


@contextmanager
def true_daemon(folder: Path, speed_rad_per_s: float = SPEED_RAD_PER_S) -> Iterator[str]:
    """A daemon as it is, on such devices; its address."""
    with RunningDaemon(load_config(configuration(folder, speed_rad_per_s))) as daemon:
        yield daemon.url


@dataclass
class Passing:
    """A request and its answer as they pass; a lie edits the answer."""

    method: str
    path: str
    body: bytes
    status: int = 0
    headers: dict[str, str] | None = None
    data: bytes = b""


class Proxy:
    """Passes everything on. ``before(passing)`` may answer in the daemon's place by returning true;
    ``after(passing)`` may edit what it answered.
    """

    def __init__(self, url: str) -> None:
        self.target = urlsplit(url).netloc
        self.honest()
        proxy = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, *ignored: object) -> None: ...

            def serve(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
                told = Passing(self.command, self.path, body)
                if not proxy.before(told):
                    proxy.ask(told, dict(self.headers))
                    proxy.after(told)
                if told.status == 0:  # the line is cut
                    self.close_connection = True
                    return
                self.send_response_only(told.status)
                for name, value in (told.headers or {}).items():
                    if name.lower() not in ("content-length", "connection", "transfer-encoding"):
                        self.send_header(name, value)
                self.send_header("Content-Length", str(len(told.data)))
                self.end_headers()
                self.wfile.write(told.data)

            do_GET = do_POST = do_PATCH = do_DELETE = serve

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True)
        self._thread.start()

    def honest(self) -> None:
        """Tell no lie from now on."""
        self.before: Callable[[Passing], object] = lambda passing: False
        self.after: Callable[[Passing], object] = lambda passing: None

    def ask(self, told: Passing, headers: dict[str, str]) -> None:
        """Pass a request on, and take the answer."""
        line = http.client.HTTPConnection(self.target, timeout=60)
        try:
            line.request(told.method, told.path, told.body or None, headers)
            answer = line.getresponse()
            told.status, told.headers, told.data = answer.status, dict(answer.getheaders()), answer.read()
        finally:
            line.close()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

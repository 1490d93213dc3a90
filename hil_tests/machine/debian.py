"""A Debian that has nothing, made by debootstrap, and containers that run in it (systemd-nspawn).

A container has a network of its own with nothing but its loopback. A port of it is published as a container
engine without root does it: a program outside listens, and connects from within the container's network.
"""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import signal
import socket
import subprocess
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from hil_tests.support.virtual_machine import apt
from hil_tests.waiting import until

PROGRAMS = {"debootstrap": "debootstrap", "systemd-nspawn": "systemd-container"}
SUITE = "bookworm"
TIMEOUT_S = 900.0
CERTIFICATES = "/etc/certificates_of_this_network.pem"  # inside the container
CLONE_NEWNET = 0x40000000
# systemd-nspawn wants a /run of its own, whether systemd runs on this machine or not.
APART = 'mount -t tmpfs tmpfs /run && exec systemd-nspawn "$@"'


def bare(folder: Path) -> Path:
    """Make the root of a Debian with nothing but what is essential; skip where that cannot be done."""
    if os.geteuid() != 0:
        pytest.skip("debootstrap and systemd-nspawn need root")
    if missing := apt.install(PROGRAMS, print):
        pytest.skip(f"without {missing}")
    quick = folder / "etc/dpkg/dpkg.cfg.d/quick"  # a machine that is thrown away need not survive a power cut
    quick.parent.mkdir(parents=True)
    quick.write_text("force-unsafe-io\n")
    done = subprocess.run(
        ["debootstrap", "--variant=minbase", SUITE, folder],
        capture_output=True, text=True, timeout=TIMEOUT_S,
    )  # fmt: skip
    if done.returncode != 0:
        pytest.skip(f"debootstrap cannot make {SUITE} here: {done.stdout[-300:]} {done.stderr[-300:]}")
    if told := os.environ.get("PIP_CERT") or os.environ.get("SSL_CERT_FILE"):  # this network has its own
        shutil.copy(told, folder / CERTIFICATES.lstrip("/"))
    return folder


def run(root: Path, *command: str, network: bool = False, **kept: str) -> subprocess.CompletedProcess[str]:
    """Run a command as root in a container to its end; ``kept`` are variables of its environment."""
    words = _options(root, network=network, environment=kept)
    with subprocess.Popen(
        [*words, "--pipe", *command],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process, ended(process):  # fmt: skip
        out, err = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, f"{command} exited {process.returncode}\n{out[-3000:]}\n{err[-3000:]}"
    return subprocess.CompletedProcess(command, 0, out, err)


@contextmanager
def running(
    root: Path, *command: str, user: str = "root", environment: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[str]]:
    """Start a container's program as its first process; its output is to be read from ``stdout``."""
    words = _options(root, user=user, environment=environment or {})
    with subprocess.Popen(
        [*words, "--pipe", *command], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
    ) as process, ended(process):  # fmt: skip
        yield process


@contextmanager
def booted(root: Path, console: Path) -> Iterator[int]:
    """Boot systemd in a container; yield the number of its first process, for `inside`.

    It may load programs into the kernel: by these systemd allows a unit its devices and addresses alone.
    """
    may = ["--capability=all", "--system-call-filter=bpf", "--boot", "--console=read-only"]
    with console.open("wb") as out, subprocess.Popen(
        [*_options(root), *may], stdin=subprocess.DEVNULL, stdout=out, stderr=out,
        env={**os.environ, "SYSTEMD_NSPAWN_UNIFIED_HIERARCHY": "1"},
    ) as process, ended(process):  # fmt: skip
        first = first_process(process)
        until(
            lambda: subprocess.run(
                inside(first, "systemctl", "is-system-running", "--wait"), capture_output=True
            ).stdout.strip() in (b"running", b"degraded"),
            "systemd is up",
        )  # fmt: skip
        yield first  # then it is ended from outside: its own way down takes a minute


def inside(first: int, *command: str) -> list[str]:
    """Return the words that run a command in a container that runs."""
    return ["nsenter", "--target", str(first), "--all", *command]


def first_process(container: subprocess.Popen[str] | subprocess.Popen[bytes]) -> int:
    """Wait for a container's first process, and return its number outside."""
    apart = Path("/proc/self/ns/net").stat().st_ino

    def found() -> int | None:
        for number in _children(container.pid):
            with suppress(OSError):
                if Path(f"/proc/{number}/ns/net").stat().st_ino != apart:
                    return number
        assert container.poll() is None, f"the container ended with {container.returncode}"
        return None

    return until(found, "the container's first process") or 0


@contextmanager
def published(first: int, port: int) -> Iterator[int]:
    """Publish a container's port on this machine's loopback; yield the number that it has here."""
    libc = ctypes.CDLL(None, use_errno=True)

    def carry(outer: socket.socket) -> None:
        network = os.open(f"/proc/{first}/ns/net", os.O_RDONLY)
        try:
            if libc.setns(network, CLONE_NEWNET):  # of this thread alone
                raise OSError(ctypes.get_errno(), "setns")
        finally:
            os.close(network)
        with outer, suppress(OSError), socket.create_connection(("127.0.0.1", port)) as inner:
            back = threading.Thread(target=_pass_on, args=(inner, outer))
            back.start()
            _pass_on(outer, inner)
            back.join()

    def listen() -> None:
        with suppress(OSError):  # closed: nothing is published any more
            while True:
                connections.append(threading.Thread(target=carry, args=(outside.accept()[0],)))
                connections[-1].start()

    connections: list[threading.Thread] = []
    with socket.create_server(("127.0.0.1", 0)) as outside:
        listener = threading.Thread(target=listen)
        listener.start()
        try:
            yield int(outside.getsockname()[1])
        finally:
            outside.shutdown(socket.SHUT_RDWR)
            for thread in (listener, *connections):
                until(lambda thread=thread: not thread.is_alive(), "the end of a published connection")  # type: ignore[misc]


@contextmanager
def ended(container: subprocess.Popen[str] | subprocess.Popen[bytes]) -> Iterator[None]:
    """End a container with everything in it, however this is left."""
    try:
        yield
    finally:
        if container.poll() is None:
            for number in _children(
                container.pid
            ):  # the kernel ends all of a container with its first process
                with suppress(ProcessLookupError):
                    os.kill(number, signal.SIGKILL)
            until(lambda: container.poll() is not None, "the container's end")


def _children(number: int) -> list[int]:
    try:
        return [int(child) for child in Path(f"/proc/{number}/task/{number}/children").read_text().split()]
    except OSError:  # it has ended
        return []


def _pass_on(source: socket.socket, to: socket.socket) -> None:
    with suppress(OSError):
        while piece := source.recv(65536):
            to.sendall(piece)
        to.shutdown(socket.SHUT_WR)


def _options(
    root: Path, user: str = "root", network: bool = False, environment: Mapping[str, str] | None = None
) -> list[str]:
    own = {"PIP_CERT": CERTIFICATES} if network and (root / CERTIFICATES.lstrip("/")).exists() else {}
    words = [
        "-q", "--register=no", "--keep-unit", "--link-journal=no", "--kill-signal=SIGTERM", "-D", str(root),
        "--resolv-conf=copy-host" if network else "--private-network", f"--user={user}",
        *(f"--setenv={name}={value}" for name, value in {**own, **(environment or {})}.items()),
    ]  # fmt: skip
    return ["unshare", "--mount", "--propagation", "private", "sh", "-c", APART, "sh", *words]


def instructions(containerfile: Path) -> dict[str, list[str]]:
    """Return what a Containerfile says, by instruction; only what its own tests use is understood."""
    found: dict[str, list[str]] = {}
    for line in containerfile.read_text().splitlines():
        if line and not line.startswith("#"):
            word, _, rest = line.partition(" ")
            found.setdefault(word, []).append(rest)
    return found


def words_of(instruction: str) -> list[str]:
    """Return the words of an instruction in the form of a list, or of a shell."""
    if instruction.startswith("["):
        return [word.strip(' "') for word in instruction.strip("[]").split(",")]
    return shlex.split(instruction)

"""Builds and finds the User Mode Linux kernel with the virtual cameras of the kernel's own vivid driver.

The source is Debian's package linux-source-6.1, fetched by apt-get and checked against the digest in
hil_tests/vm/kernel/source.txt; when Debian offers none of the versions there any more, it is the newest that
it does offer, checked against Debian's signed index. The result is kept outside the tree, in
``~/.cache/mastctl/vm/DIGEST/linux``, where DIGEST is over the source's digest, configuration and patches.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import subprocess
import tempfile
import time
from collections import deque
from pathlib import Path

from drivers.sim.kept import keep_newest, kept_folder
from hil_tests.support.virtual_machine.apt import TOLD_AGAIN_S, Busy, Tell, apt_get, install

INPUTS = Path(__file__).resolve().parents[3] / "hil_tests" / "vm" / "kernel"
PACKAGE = "linux-source-6.1"
USUAL_FILES = 700
BUILD_PROGRAMS = {
    "flex": "flex",
    "bison": "bison",
    "bc": "bc",
    "gcc": "gcc",
    "make": "make",
    "xz": "xz-utils",
}
BUILD_PROGRAMS |= {"patch": "patch", "strip": "binutils", "dpkg-deb": "dpkg", "tar": "tar"}


SECOND_READER = {"v4l2-ctl": "v4l-utils"}
"""The camera tests compare our reader with this one."""
ARAVIS = {"arv-tool-0.8": "aravis-tools-cli"}
"""Brings the library of GigE Vision cameras, and with it the fake camera of its tests."""


class CannotBuild(Exception):
    """The kernel cannot be built here; the message says why in one sentence."""


def sources() -> dict[str, str]:
    """Return the known source packages, best first: digest by version."""
    lines = (line.split() for line in (INPUTS / "source.txt").read_text().splitlines())
    return {words[0]: words[1] for words in lines if words and not words[0].startswith("#")}


def offered() -> dict[str, str]:
    """Return the source packages that apt offers, digest by version, by Debian's signed index."""
    if not shutil.which("apt-cache"):
        return {}
    told = _run(["apt-cache", "show", PACKAGE], check=False).stdout
    fields = dict(re.findall(r"^Version: (\S+)$.*?^SHA256: ([0-9a-f]{64})$", told, re.MULTILINE | re.DOTALL))
    return {str(version): str(digest) for version, digest in fields.items()}


def path_for(source_digest: str) -> Path:
    """Return where the kernel that is built from a source package is kept."""
    digest = hashlib.sha256(source_digest.encode())
    for file in (INPUTS / "kernel.config", *sorted(INPUTS.glob("*.patch"))):
        digest.update(file.read_bytes())
    return kept_folder("vm", digest.hexdigest()) / "linux"


def find() -> Path | None:
    """Return the kernel if it has been built, from a known source or one that apt offers, else None."""
    for digests in (sources, offered):
        for digest in digests().values():
            if (path := path_for(digest)).is_file():
                return path
    return None


def why_not() -> str:
    """Return why this machine cannot run or build the kernel at all, or an empty string."""
    if platform.system() != "Linux" or platform.machine() != "x86_64":
        return f"the kernel runs on Linux x86-64 only, this is {platform.system()} {platform.machine()}"
    return ""


def build(package: Path | None, tell: Tell) -> Path:
    """Build the kernel unless it is there, and return it.

    Parameters
    ----------
    package
        The source package as a file; None fetches it by apt-get.
    tell
        Is given a sentence at each step, and while one takes long.

    Raises
    ------
    CannotBuild
        If something that it takes is not to be had.
    """
    if reason := why_not():
        raise CannotBuild(reason)
    if package is None and (found := find()):
        return found
    if package is not None and not package.is_file():
        raise CannotBuild(f"there is no file {package}")
    if package is None and (reason := _no_source()):
        raise CannotBuild(reason)
    if reason := install(BUILD_PROGRAMS, tell):
        raise CannotBuild(f"the build needs {reason}")
    with tempfile.TemporaryDirectory(prefix="mastctl-kernel-") as name:
        folder = Path(name)
        deb = _fetch(folder, tell) if package is None else package
        digest = hashlib.sha256(deb.read_bytes()).hexdigest()
        if digest not in sources().values() and digest not in offered().values():
            raise CannotBuild(
                f"{deb.name} has the digest {digest}, which neither {INPUTS / 'source.txt'} "
                "nor Debian's index knows"
            )
        kernel = path_for(digest)
        if not kernel.is_file():
            _make(deb, folder, kernel, tell)
            keep_newest(kernel.parent)
    return kernel


def _no_source() -> str:
    """Why there is no source package to fetch here; empty if there is one."""
    system = platform.freedesktop_os_release() if Path("/etc/os-release").exists() else {}
    if (system.get("ID"), system.get("VERSION_ID")) == ("debian", "12") and shutil.which("apt-get"):
        return ""
    here = system.get("PRETTY_NAME", "another system")
    return f"{PACKAGE} comes from Debian 12, this is {here}: give the package by tools/vm setup --source FILE"


def _fetch(folder: Path, tell: Tell) -> Path:
    """Fetch the first known source package that apt offers, or else the newest that it offers."""
    failed = ""
    tell(f"fetching {PACKAGE} (130 MB)")
    try:
        for update_first in (False, True):
            if update_first:
                if os.geteuid() != 0:
                    break
                apt_get("update", tell=tell)
            # With lists of yesterday a known version may be gone: only fresh ones say that none is left.
            for version in [*sources(), *(offered() if update_first else ())]:
                done = apt_get("download", f"{PACKAGE}={version}", cwd=folder, tell=tell)
                if deb := next(folder.glob("*.deb"), None):
                    return deb
                failed = " ".join(done.stderr.split())[-200:]
    except Busy as busy:
        raise CannotBuild(str(busy)) from None
    raise CannotBuild(f"apt-get fetches no {PACKAGE}: {failed}; give the package by --source FILE")


def _make(deb: Path, folder: Path, kernel: Path, tell: Tell) -> None:
    """Unpack, patch, configure, compile; the result appears under its name only when it is whole."""
    unpack = (
        'dpkg-deb --fsys-tarfile "$1" | tar -xO --wildcards "./usr/src/*.tar.xz" | xz -dc | tar -x -C "$2"'
    )
    tell("unpacking and configuring")
    _run(["bash", "-o", "pipefail", "-c", unpack, "unpack", str(deb.resolve()), str(folder)])
    tree = folder / PACKAGE
    for patch in sorted(INPUTS.glob("*.patch")):
        _run(["patch", "-p1", "--forward", "--fuzz=0", "-i", str(patch)], cwd=tree)
    make = ["nice", "make", "ARCH=um", "-s"]
    _run([*make, "tinyconfig"], cwd=tree)
    fragment = INPUTS / "kernel.config"
    _run(["scripts/kconfig/merge_config.sh", "-m", ".config", str(fragment)], cwd=tree)
    _run([*make, "olddefconfig"], cwd=tree)
    _check_configuration(fragment, tree / ".config")
    _compile(["nice", "make", "ARCH=um", f"-j{os.cpu_count() or 1}", "linux"], tree, tell)
    kernel.parent.mkdir(parents=True, exist_ok=True)
    partial = kernel.with_name(f"linux.{os.getpid()}")
    _run(["strip", "-o", str(partial), "linux"], cwd=tree)
    partial.replace(kernel)


def _compile(command: list[str], tree: Path, tell: Tell) -> None:
    """Run make, which names each file that it makes; now and then tell how many there are."""
    tell("compiling, which takes some minutes")
    told_s, files, tail = time.monotonic(), 0, deque[str](maxlen=15)
    process = subprocess.Popen(
        command, cwd=tree, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
    )
    with process, process.stdout as lines:  # type: ignore[union-attr]
        for line in lines:
            tail.append(line.rstrip())
            files += line.startswith("  CC ")
            if time.monotonic() - told_s >= TOLD_AGAIN_S:
                tell(f"compiling: {files} files of some {USUAL_FILES}")
                told_s = time.monotonic()
    if process.returncode != 0:
        raise CannotBuild(f"{' '.join(command)} failed with {process.returncode}:\n" + "\n".join(tail))


def _check_configuration(fragment: Path, result: Path) -> None:
    """Every option asked for must have come through: Kconfig silently drops what lacks a dependency."""
    got = set(result.read_text().splitlines())
    wanted = [line for line in fragment.read_text().splitlines() if line.startswith("CONFIG_")]
    if lost := [line for line in wanted if line not in got]:
        raise CannotBuild(f"the kernel's configuration does not take {', '.join(lost)}")


def _run(command: list[str], cwd: Path | None = None, check: bool = True) -> subprocess.CompletedProcess[str]:
    """Run a program quietly; one that fails tells its last lines."""
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, errors="replace")
    if check and done.returncode != 0:
        tail = "\n".join((done.stdout + done.stderr).splitlines()[-15:])
        raise CannotBuild(f"{' '.join(command[:4])} failed with {done.returncode}:\n{tail}")
    return done

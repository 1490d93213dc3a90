"""Boots Debian's own untouched kernel in QEMU and runs one command in it: a cross-check of `boot`.

Nothing is built and nothing of the kernel's package installed: it is fetched by apt-get, which checks it
against Debian's signed index, and unpacked. The machine sees this machine's files read-only over 9p. Every
instruction is emulated, some fifty times slower.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from drivers.sim.kept import keep_newest, kept_home
from tools.virtual_machine.boot import CAMERAS, INIT, Result, VmFailed

PROGRAMS = {
    "qemu-system-x86_64": "qemu-system-x86",
    "busybox": "busybox-static",
    "cpio": "cpio",
    "depmod": "kmod",
    "dpkg-deb": "dpkg",
}
META_PACKAGE = "linux-image-amd64"
MODULES = ("virtio_pci", "9pnet_virtio", "9p", "vivid")
MOUNT_9P = "trans=virtio,version=9p2000.L,msize=512000"

FIRST_PROCESS = f"""#!/bin/busybox sh
/bin/busybox mount -t devtmpfs none /dev
for module in $(/bin/busybox cat /modules/order); do
    options=
    [ $module = vivid.ko ] && options=$(echo "$VIVID" | /bin/busybox tr ';' ' ')
    /bin/busybox insmod /modules/$module $options
done
/bin/busybox mount -t 9p -o ro,{MOUNT_9P},cache=loose root /host
/bin/busybox mount -o move /dev /host/dev
exec /bin/busybox switch_root /host "$FIRST"
"""


class NoQemu(Exception):
    """QEMU or Debian's kernel is not to be had here; the message says why in one sentence."""


def prepare() -> Path:
    """Fetch and unpack the kernel unless it is there; return the folder with ``vmlinuz`` and ``initrd``.

    Raises
    ------
    NoQemu
        If a program or the package is missing.
    """
    missing = sorted(package for program, package in PROGRAMS.items() if not _program(program))
    if missing:
        raise NoQemu(f"apt-get install --no-install-recommends {' '.join(missing)}: it is needed for QEMU")
    told = _run(["apt-cache", "depends", META_PACKAGE])
    found = re.search(r"Depends: (linux-image-(\S+))", told)
    if found is None:
        raise NoQemu(f"apt-cache knows no {META_PACKAGE}; on Debian amd64 it does")
    package, version = found.groups()
    folder = kept_home() / "vm" / f"qemu-{version}"
    if not (folder / "initrd").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="mastctl-qemu-") as name:
            _unpack(package, version, Path(name), folder)
        keep_newest(folder)
    return folder


def _unpack(package: str, version: str, scratch: Path, folder: Path) -> None:
    """Take the kernel and the modules that it needs out of the package."""
    _run(["apt-get", "download", "-qq", package], cwd=scratch)
    _run(["dpkg-deb", "-x", str(next(scratch.glob("*.deb"))), str(scratch / "unpacked")])
    tree = scratch / "unpacked"
    _run(["depmod", "-b", str(tree), version])
    root = scratch / "initrd"
    for part in ("bin", "dev", "modules", "host"):
        (root / part).mkdir(parents=True)
    order: list[str] = []
    for module in MODULES:
        listed = _run(["modprobe", "-d", str(tree), "-S", version, "--show-depends", module])
        for line in listed.splitlines():
            path = Path(line.split()[1]) if line.startswith("insmod") else None
            if path is not None and path.name not in order:
                shutil.copy(path, root / "modules" / path.name)
                order.append(path.name)
    (root / "modules" / "order").write_text("\n".join(order))
    shutil.copy(str(_program("busybox")), root / "bin" / "busybox")
    (root / "init").write_text(FIRST_PROCESS)
    (root / "init").chmod(0o755)
    files = "\n".join(str(path.relative_to(root)) for path in sorted(root.rglob("*")))
    with (scratch / "packed").open("wb") as packed:
        subprocess.run(
            ["cpio", "-o", "-H", "newc", "--quiet"], cwd=root, input=files.encode(), stdout=packed, check=True
        )
    shutil.copy(tree / "boot" / f"vmlinuz-{version}", folder / "vmlinuz")
    shutil.move(scratch / "packed", folder / "initrd")


def run(
    kernel: Path,
    command: Sequence[str],
    out: Path,
    folder: Path | None = None,
    cameras: str = CAMERAS["webcams"],
    timeout_s: float = 3600.0,
    memory_mb: int = 1536,
    environment: Mapping[str, str] | None = None,
) -> Result:
    """Boot, run, power off, as `boot.run`; ``kernel`` is what `prepare` returned. Raises VmFailed."""
    status_file = out / ".status"
    status_file.unlink(missing_ok=True)
    place, more = str(folder or Path.cwd()), dict(environment or {})
    job = {"command": list(command), "folder": place, "environment": more}
    (out / ".job.json").write_text(json.dumps(job))
    vivid = cameras.replace(" ", ";")
    words = f"console=ttyS0 quiet panic=-1 mitigations=off VM_OUT=9p FIRST={INIT} VIVID={vivid}"
    shares = [
        part
        for tag, path, extra in (("root", Path("/"), ",readonly=on"), ("out", out.resolve(), ""))
        for part in (
            "-fsdev", f"local,id={tag},path={path},security_model=none,multidevs=remap{extra}",
            "-device", f"virtio-9p-pci,fsdev={tag},mount_tag={tag}",
        )
    ]  # fmt: skip
    arguments = [
        "qemu-system-x86_64", "-nodefaults", "-no-user-config", "-nographic", "-no-reboot", "-M", "q35",
        "-accel", "tcg", "-cpu", "max", "-smp", "1", "-m", str(memory_mb),
        "-kernel", str(kernel / "vmlinuz"), "-initrd", str(kernel / "initrd"), "-append", words,
        "-serial", "stdio", "-monitor", "none", *shares,
    ]  # fmt: skip
    try:
        done = subprocess.run(
            arguments, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, errors="replace", timeout=timeout_s,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise VmFailed(f"the machine did not end within {timeout_s:g} s") from None
    if not status_file.is_file():
        tail = "\n".join(done.stdout.splitlines()[-30:])
        raise VmFailed(f"the machine ended (with {done.returncode}) before the command did:\n{tail}")
    return Result(int(status_file.read_text()), done.stdout)


def _program(name: str) -> str | None:
    """A program, also where only root usually looks."""
    return shutil.which(name) or shutil.which(name, path="/usr/sbin:/sbin")


def _run(command: list[str], cwd: Path | None = None) -> str:
    """Run a program quietly; one that fails tells its last lines."""
    program = _program(command[0])
    if program is None:
        raise NoQemu(f"there is no program {command[0]}")
    done = subprocess.run([program, *command[1:]], cwd=cwd, capture_output=True, text=True, errors="replace")
    if done.returncode != 0:
        raise NoQemu(
            f"{' '.join(command[:4])} failed: {' '.join((done.stderr or done.stdout).split())[-300:]}"
        )
    return done.stdout

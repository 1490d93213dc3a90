"""A package manager that something else uses is waited for, aloud: Debian's own, on folders of the test's."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tools.virtual_machine import apt

HOLDER = (
    "import fcntl, sys; f = open(sys.argv[1], 'a'); fcntl.lockf(f, fcntl.LOCK_EX); print(); sys.stdin.read()"
)
LOCKS = {
    "lists/lock": "update",
    "dpkg/lock-frontend": "install",
    "dpkg/lock": "install",
    "cache/archives/lock": "clean",
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where apt-get keeps everything, without sources."""
    if not shutil.which("apt-get"):
        pytest.skip("there is no apt-get here")
    for name in ("lists/partial", "dpkg", "cache/archives/partial"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "dpkg" / "status").touch()
    places = {"State": "", "State::Lists": "lists", "State::status": "dpkg/status", "Cache": "cache"}
    lines = [f'Dir::{key} "{tmp_path / place}";' for key, place in places.items()]
    lines += ['Dir::Etc::sourcelist "/dev/null";', 'Dir::Etc::sourceparts "/dev/null";']
    (tmp_path / "apt.conf").write_text("\n".join(lines))
    monkeypatch.setenv("APT_CONFIG", str(tmp_path / "apt.conf"))
    return tmp_path


@contextmanager
def held(lock: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process holds a lock until it is told to end."""
    command = [sys.executable, "-c", HOLDER, str(lock)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == "\n"
        yield holder
        holder.communicate()


@pytest.mark.parametrize("lock", LOCKS)
def test_a_lock_is_waited_for_and_said_with_its_holder(folder: Path, lock: str) -> None:
    told: list[str] = []
    with held(folder / lock) as holder:

        def tell(words: str) -> None:
            told.append(words)
            if words.startswith("still"):
                holder.communicate()

        done = apt.apt_get(LOCKS[lock], tell=tell, again_s=0.01, told_again_s=0.0)
    assert done.returncode == 0, done.stderr
    who = f"process {holder.pid} ({Path(sys.executable).name}"
    assert told[0].startswith(f"waiting for {who}") and told[0].endswith(
        f"which holds {folder / lock}, for 10 min at most"
    )
    assert told[1].startswith(f"still waiting for {who}")
    assert told[-1].startswith("the package manager is free after")


def test_a_lock_that_is_never_given_up_ends_in_a_sentence(folder: Path) -> None:
    lock = folder / "dpkg" / "lock-frontend"
    with held(lock) as holder, pytest.raises(apt.Busy) as busy:
        apt.apt_get("install", tell=lambda words: None, wait_s=0.6, again_s=0.01)
    assert str(busy.value).startswith(
        f"the package manager was busy for 0.01 min, now process {holder.pid} ("
    )
    assert str(busy.value).endswith(f"holds {lock}")


def test_what_failed_for_another_reason_is_not_tried_again(folder: Path) -> None:
    told: list[str] = []
    done = apt.apt_get("install", "no-such-package", tell=told.append)
    assert done.returncode != 0 and "no-such-package" in done.stderr and not told


def test_programs_that_cannot_be_installed_for_it_are_named_with_the_command(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def busy(*arguments: str, tell: apt.Tell) -> None:
        raise apt.Busy("the package manager was busy")

    monkeypatch.setattr("os.geteuid", lambda: 0)
    monkeypatch.setattr(apt, "apt_get", busy)
    told: list[str] = []
    assert apt.install({"no-such-program": "a-package", "sh": "dash"}, told.append) == (
        "a-package; as root on Debian: apt-get install -y --no-install-recommends a-package; "
        "just now the package manager was busy"
    )
    assert told == ["installing a-package"]

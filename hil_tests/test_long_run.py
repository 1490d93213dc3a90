"""The long run: its markers, its page, and what the quick run does with a test that failed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent

CASES = """\
from pathlib import Path
import pytest

@pytest.mark.long(2, "takes long")
def test_long():
    pass

@pytest.mark.long(3, "takes longer")
def test_longer():
    pass

def test_quick():
    pass
"""


def _run(folder: Path, text: str, *options: str) -> subprocess.CompletedProcess[str]:
    """Run pytest on one file of tests with the suite's own conftest."""
    file = folder / "test_one.py"
    file.write_text(text)
    words = ["-q", "-rA", "-p", "no:cacheprovider", "--rootdir", str(folder), "-c", "/dev/null"]
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "hil_tests.conftest", *words, *options, str(file)],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(
    ("options", "passed"),
    [
        ((), ["test_quick"]),
        (("--long",), ["test_long", "test_longer"]),
        (("--long", "--long-part", "3"), ["test_longer"]),
    ],
)
def test_a_long_test_runs_only_in_the_long_run_and_in_its_part(
    options: tuple[str, ...], passed: list[str], tmp_path: Path
) -> None:
    done = _run(tmp_path, CASES, *options)
    lines = [line for line in done.stdout.splitlines() if line.startswith("PASSED")]
    assert [line.rpartition("::")[2] for line in lines] == passed
    assert done.returncode == 0


@pytest.mark.parametrize("marker", ['(5, "why")', '(1, "")'])
def test_a_marker_without_a_part_or_a_reason_is_refused(marker: str, tmp_path: Path) -> None:
    done = _run(tmp_path, f"import pytest\n\n@pytest.mark.long{marker}\ndef test_it():\n    pass\n")
    assert done.returncode == pytest.ExitCode.USAGE_ERROR
    assert "long needs a part of (1, 2, 3, 4) and a reason" in done.stdout + done.stderr


def test_a_file_that_is_not_there_is_said_before_anything_is_set_up(repository: Path) -> None:
    words = ["tools/test", "-q", "hil_tests/test_long_run.py", "hil_tests/nosuch.py::test_it"]
    done = subprocess.run(words, cwd=repository, capture_output=True, text=True, check=False)
    assert done.stderr == "tools/test: there is no hil_tests/nosuch.py\n" and not done.stdout
    assert done.returncode == pytest.ExitCode.USAGE_ERROR

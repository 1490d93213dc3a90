"""The tutorials are run as they are written, and print what they show; every option on a page is one.

A tutorial's `console` block holds commands (`$ `) and what each prints, standard error too. A command that
ends with `&` runs until the tutorial's end; the next one waits for what it prints. A block after a line that
ends with a file's name in backticks and a colon is that file. `...` stands for anything. Numbers may be
others than on the page, but those with a sign and decimals (pixels, radians, metres) only by `NEAR`. The
daemon listens at another port than the page's. pip installs from the wheels of this environment's set-up.
"""

from __future__ import annotations

import doctest
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from hil_tests.waiting import until
from mastctl.cli.main import COMMANDS, build_parser
from mastctl.cli.options import Parser

BLOCK = re.compile(r"(?:`((?!/)[\w./-]+)`:\n\n)?```(\w+)\n(.*?)```", re.DOTALL)
NUMBER = re.compile(r"(?:(?<!\w)[-+])?\d(?:[\d.:]*\d)?")
SIGNED = re.compile(r"(?<!\w)[-+]\d+\.\d+")
NEAR = 0.3
LOGGED = re.compile(r"^WARNING (?:drivers|mastctl)\.[\w.]+: .*\n", re.MULTILINE)
"""Logged by a real-time servo line on a machine with much else to do; results are compared all the same."""
LONGEST_S = 1800.0
"""A net for one command, on a machine with much else to do."""
REPOSITORY = Path(__file__).parents[1]
PAGES = ("first-pointing", "panorama", "servos-to-verdict", "first-ci-test", "recalibrate")


def blocks(text: str) -> list[tuple[str, str, str]]:
    """Return name (of a file, else empty), language and text of each fenced block of a page."""
    return [(name or "", language, body) for name, language, body in BLOCK.findall(text)]


def commands(block: str) -> list[tuple[str, str]]:
    """Return each command of a `console` block with what it prints."""
    found: list[list[str]] = []
    for line in block.replace("\\\n", "").splitlines():
        if line.startswith("$ "):
            found.append([line[2:], ""])
        else:
            found[-1][1] += line + "\n"
    return [(command, shown) for command, shown in found]


def words(text: str) -> str:
    """Return a text with its numbers, lines of tables and widths of columns made alike."""
    plain = re.sub(r"[━─┏┓┗┛┡┩┴┬┳┻╇┼└┘├┤]+", "-", NUMBER.sub("#", text))
    return "\n".join(" ".join(line.split()) for line in plain.splitlines() if line.strip())


def agrees(shown: str, printed: str) -> bool:
    """Return whether a page shows what was printed."""
    checker = doctest.OutputChecker()
    if not checker.check_output(words(shown) + "\n", words(printed) + "\n", doctest.ELLIPSIS):
        return False
    lines = iter(printed.splitlines())
    for line in shown.splitlines():
        if SIGNED.search(line) and "..." not in line:
            same = next((one for one in lines if words(one) == words(line)), "")
            pairs = zip(SIGNED.findall(line), SIGNED.findall(same), strict=False)
            if not same or any(abs(float(a) - float(b)) > NEAR for a, b in pairs):
                return False
    return True


class Walk:
    """One tutorial in a folder of its own, with the machine's own port left alone."""

    def __init__(self, folder: Path, temporary: str, stack: ExitStack) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"127.0.0.1:{self.port}"
        self.folder, self.stack = folder, stack
        self.environ = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST")}
        self.environ |= {
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "MASTCTL_URL": f"http://{self.address}",
            "XDG_STATE_HOME": f"{temporary}/state",  # short, for its sockets
            "MASTCTL_HEADS": f"{temporary}/heads",
            "TMPDIR": temporary,
            "PIP_NO_INDEX": "1",
            "PIP_FIND_LINKS": str(Path(sys.prefix) / "wheels"),
        }

    def here(self, text: str) -> str:
        text = re.sub(r"\bmastctl run\b", f"mastctl run --listen {self.address}", text)
        return text.replace("127.0.0.1:8420", self.address).replace("CHECKOUT", str(REPOSITORY))

    def run(self, command: str, shown: str) -> None:
        if selected := re.fullmatch(r"\. (\S+)/bin/activate", command):
            chosen = self.folder / selected[1]
            self.environ |= {"VIRTUAL_ENV": str(chosen), "PATH": f"{chosen}/bin:{self.environ['PATH']}"}
            assert (chosen / "bin" / "activate").is_file(), command
            return
        if command.endswith("&"):
            self.begin(command.removesuffix("&"), shown)
            return
        done = subprocess.run(
            ["bash", "-c", self.here(command)], cwd=self.folder, env=self.environ, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, timeout=LONGEST_S,
        )  # fmt: skip
        for config in self.folder.glob("*/config.yaml"):  # of `sim new`
            config.write_text(config.read_text().replace("port: 8420", f"port: {self.port}"))
        assert agrees(shown, LOGGED.sub("", done.stdout)), (
            f"$ {command}\n{done.stdout}\nwhere the page shows\n{shown}"
        )

    def begin(self, command: str, shown: str) -> None:
        log = self.folder / f"log-{len(list(self.folder.glob('log-*')))}"
        with log.open("w") as out:
            process = subprocess.Popen(
                ["bash", "-c", f"exec {self.here(command)}"], cwd=self.folder, env=self.environ,
                stdout=out, stderr=out, stdin=subprocess.DEVNULL,
            )  # fmt: skip
        self.stack.callback(process.wait, 60.0)
        self.stack.callback(process.send_signal, signal.SIGTERM)
        until(
            lambda: agrees(shown, log.read_text()) or process.poll() is not None,
            f"$ {command}\nprints\n{shown}",
            LONGEST_S,
        )
        assert process.poll() is None, log.read_text()


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("first-pointing", marks=pytest.mark.long(1, "a tutorial: a daemon and three pointings")),
        pytest.param("panorama", marks=pytest.mark.long(1, "a tutorial: a panorama and three pointings")),
        pytest.param("servos-to-verdict", marks=pytest.mark.long(2, "a tutorial: a bench by servo bytes")),
        pytest.param(
            "first-ci-test", marks=pytest.mark.long(3, "a tutorial: pytest on a project of its own")
        ),
        pytest.param(
            "recalibrate", marks=pytest.mark.long(4, "a tutorial: a bench, twelve pointings, what-if")
        ),
    ],
)
def test_a_tutorial_prints_what_it_shows(name: str, repository: Path, tmp_path: Path) -> None:
    page = (repository / "docs" / "tutorials" / f"{name}.md").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="p") as short, ExitStack() as stack:  # sockets
        walk = Walk(tmp_path, short, stack)
        for file, language, text in blocks(page):
            if file:
                (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
                (tmp_path / file).write_text(walk.here(text), encoding="utf-8")
            elif language == "console":
                for command, shown in commands(text):
                    walk.run(command, shown)


def test_every_block_of_a_tutorial_is_a_file_or_commands(repository: Path) -> None:
    folder = repository / "docs" / "tutorials"
    assert sorted(page.stem for page in folder.glob("*.md")) == sorted(PAGES)
    for page in PAGES:
        found = blocks((folder / f"{page}.md").read_text(encoding="utf-8"))
        assert [language for file, language, _ in found if not file and language != "console"] == [], page
        assert [file for file, _, _ in found if ".." in file] == [], page
        assert sum(len(commands(text)) for file, _, text in found if not file) > 2, page


def test_no_page_installs_mastctl_by_its_name_on_an_index(repository: Path) -> None:
    """The name is anybody's until the project is published there."""
    wrong, seen = [], 0
    for page in pages(repository):
        for line in re.findall(r"pip install [^\n`]*", page.read_text(encoding="utf-8")):
            seen += 1
            if re.search(r"['\s]mastctl(\[[\w,]+\])?(?! @ git\+)(?=['\s]|$)", line):
                wrong.append(f"{page.name}: {line}")
    assert seen > 10
    assert wrong == []


def pages(repository: Path) -> list[Path]:
    """Every page but the generated ones and the decisions."""
    found = [repository / "README.md", *sorted((repository / "docs").rglob("*.md"))]
    return [page for page in found if not {"generated", "decisions", "_build"} & set(page.parts)]


def shown_commands(text: str) -> Iterator[str]:
    """Yield each command of mastctl that a text shows, without its comment: a line, or in quotes."""
    text = re.sub(r"\\\n\s*", "", text)
    for line in re.findall(r"^(?:    |\$ |    \$ )?(?:\.venv/bin/)?(mastctl [a-z].*)$", text, re.MULTILINE):
        yield from (one.strip().removesuffix("&").strip() for one in line.split("  #")[0].split("; "))
    yield from re.findall(r"[`'](mastctl [a-z][^`'\n]*)[`']", text)


def parses(line: str, parser: Parser) -> bool:
    """Return whether every option of a command is one of its parser's."""
    try:
        asked = [word for word in shlex.split(line.split(" > ")[0].split(" | ")[0]) if word.startswith("--")]
    except ValueError:
        return True  # words of a sentence
    return all(option.split("=")[0] in parser._option_string_actions for option in asked)


def test_every_command_and_option_that_is_shown_is_one(repository: Path) -> None:
    wrong, seen = [], 0
    everything = build_parser()
    shown = [*pages(repository), *(repository / "configs").rglob("*"), repository / "CONTRIBUTING.md"]
    shown += [file for folder in ("mastctl", "drivers") for file in (repository / folder).rglob("*.py")]
    for file in shown:
        if file.suffix not in (".md", ".py", ".yaml", ".service", ".rules"):
            continue
        for line in shown_commands(file.read_text(encoding="utf-8")):
            words = line.split()[1:]
            if file.suffix == ".md" and words[0] not in COMMANDS and not line.count("--"):
                continue  # a sentence that begins with mastctl
            parser = of_command(everything, words)
            seen += 1
            if not parses(line, parser) or no_verb(parser, words):
                wrong.append(f"{file.name}: {line}")
    assert seen > 300
    assert wrong == []


def no_verb(parser: Parser, words: list[str]) -> bool:
    """Return whether a command's own verb is none, as in ``token add``."""
    at = len(parser.prog.split()) - 1
    has_verbs = parser._subparsers is not None
    return has_verbs and len(words) > at and re.fullmatch(r"[a-z][a-z-]*", words[at]) is not None


def of_command(parser: Parser, rest: list[str]) -> Parser:
    """Return the parser of the innermost command that these words name."""
    for action in parser._subparsers._group_actions if parser._subparsers else ():
        joined = " ".join(rest[:2])
        choices = action.choices
        assert isinstance(choices, dict)
        if joined in choices:
            return of_command(choices[joined], rest[2:])
        if rest and rest[0] in choices:
            return of_command(choices[rest[0]], rest[1:])
    return parser

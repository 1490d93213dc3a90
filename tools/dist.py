"""Builds what an index of packages takes: sdist and wheel of mastctl, and the wheel of mastctl-client.

The same commit gives the same bytes: files that git knows are copied, with the site where tools/docs built
it, and every time stamp is the commit's (or SOURCE_DATE_EPOCH). README's relative links and pictures work on
no index. With --at they become addresses of the tag vVERSION there; without it, pictures are left out and
links become plain words.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

from tools.command import end, options

ROOT = Path(__file__).resolve().parent.parent
CLIENT = Path("tools") / "mastctl-client"
SITE = Path("docs/_build/html")
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")


def for_an_index(readme: str, at: str | None, tag: str) -> str:
    """Return README's text without a relative link.

    Parameters
    ----------
    readme
        Markdown.
    at
        Address of the repository, as GitHub's are: pages under ``blob/TAG``, pictures under ``raw/TAG``.
    tag
        What is built.
    """

    def address(found: re.Match[str]) -> str:
        picture, words, target = found.groups()
        if "://" in target or target.startswith("#"):
            return found[0]
        if at is None:
            return "" if picture else words
        return f"{picture}[{words}]({at.rstrip('/')}/{'raw' if picture else 'blob'}/{tag}/{target})"

    return LINK.sub(address, readme)


def build(out: Path, at: str | None = None) -> list[Path]:
    """Build all three from the files that git knows, as they are now, into an existing folder; return them.

    Raises
    ------
    subprocess.CalledProcessError
        If git or the build fails; its ``stderr`` says why.
    """
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    with tempfile.TemporaryDirectory(prefix="mastctl-dist-") as name:
        copy = Path(name) / "mastctl"
        site = (str(file.relative_to(ROOT)) for file in (ROOT / SITE).rglob("*"))
        for file in (*_said("git", "ls-files", "-z").split("\0"), *site):
            if file and (ROOT / file).is_file():
                (copy / file).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / file, copy / file)
        readme = copy / "README.md"
        readme.write_text(for_an_index(readme.read_text(), at, f"v{version}"))
        when = os.environ.get("SOURCE_DATE_EPOCH") or _said("git", "log", "-1", "--format=%ct").strip()
        how: dict[str, Any] = {
            "env": {**os.environ, "SOURCE_DATE_EPOCH": when},
            "check": True,
            "capture_output": True,
        }
        command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out)]
        subprocess.run([*command, str(copy)], **how)  # the wheel is built from the sdist
        subprocess.run([*command, "--wheel", str(copy / CLIENT)], **how)
    return [
        out / f"mastctl-{version}.tar.gz",
        out / f"mastctl-{version}-py3-none-any.whl",
        out / f"mastctl_client-{version}-py3-none-any.whl",
    ]


def _said(*command: str) -> str:
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout


def main() -> int:
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("--at", metavar="URL", help="the repository's address, for README's links")
    parser.add_argument("out", type=Path, metavar="FOLDER", help="where to")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    try:
        built = build(args.out.resolve(), args.at)
    except subprocess.CalledProcessError as failed:
        print(f"{failed.cmd[0]} failed: {failed.stderr.decode(errors='replace')[-2000:]}", file=sys.stderr)
        return 1
    for file in built:
        print(f"{file} ({file.stat().st_size / 1e6:.2f} MB)")
    return 0


if __name__ == "__main__":
    end(main)

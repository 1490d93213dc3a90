"""Draw the rooms of the house: the three packages, the folders in each, and who imports whom.

    .venv/bin/python -m tools.rooms    # lines, modules, rooms, levels, arrows and circles of each
    .venv/bin/python -m tools.rooms --svg docs/img/rooms.svg

A room is a folder of a package, or a module that stands beside the folders. Its level is one above the
highest room that it imports; an arrow is a pair of rooms. Imports are read from the text, those for type
checkers too.
"""

from __future__ import annotations

import ast
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

from tools.command import end, new_file, options

REPOSITORY = Path(__file__).resolve().parent.parent
PACKAGES = ("mastctl", "drivers", "calib")
WIDTH_PX, ROOM_PX, GAP_PX, LEVEL_PX = 1180, 58, 12, 78
LETTER_PX = 6.0  # of the small print
COLOURS = {"mastctl": "#d9e8f6", "drivers": "#e3f1dc", "calib": "#f8ead2"}


@dataclass(frozen=True)
class Package:
    """One package: its modules with the modules that each imports, and the rooms they make.

    Attributes
    ----------
    name
        As it is imported.
    modules
        For each module, those of the same package that it imports.
    words
        For each module the first sentence of its docstring.
    lines
        Of all modules together.
    """

    name: str
    modules: Mapping[str, frozenset[str]]
    words: Mapping[str, str]
    lines: int

    @property
    def rooms(self) -> dict[str, set[str]]:
        """For each room the rooms that it imports."""
        rooms: dict[str, set[str]] = {}
        for module, imported in self.modules.items():
            rooms.setdefault(self.room(module), set()).update(map(self.room, imported))
        return {room: used - {room} for room, used in rooms.items()}

    def room(self, module: str) -> str:
        """Return the room that a module is in: the folder, or its own name."""
        return module.split(".")[1]

    @property
    def levels(self) -> dict[str, int]:
        """For each room how high it stands; rooms of a circle stand on one level, above what they use."""
        rooms = self.rooms
        levels = dict.fromkeys(rooms, 1)
        rings = self.circles
        together = {room: ring for ring in rings for room in ring}
        for _ in rooms:
            for room, used in rooms.items():
                below = used - together.get(room, frozenset())
                levels[room] = max([levels[room], *(levels[other] + 1 for other in below)])
            for ring in rings:
                levels |= dict.fromkeys(ring, max(levels[room] for room in ring))
        return levels

    @property
    def circles(self) -> list[frozenset[str]]:
        """Rooms that import each other, in however many steps."""
        rooms = self.rooms
        reached = {room: _reached(room, rooms) for room in rooms}
        rings = {frozenset(a for a in rooms if a in reached[b] and b in reached[a]) for b in rooms}
        return sorted((ring for ring in rings if len(ring) > 1), key=sorted)


def read_package(name: str) -> Package:
    """Read the imports of one package from its text."""
    files = {_module(file): file for file in sorted((REPOSITORY / name).rglob("*.py"))}
    texts = {module: file.read_text() for module, file in files.items()}
    inside = {module: ast.parse(text) for module, text in texts.items() if "." in module}
    return Package(
        name,
        {module: _imported(tree, inside) - {module} for module, tree in inside.items()},
        {module: _first_sentence(tree) for module, tree in inside.items()},
        sum(text.count("\n") for text in texts.values()),
    )


def _first_sentence(tree: ast.Module) -> str:
    return (ast.get_docstring(tree) or "").partition("\n")[0]


def _module(file: Path) -> str:
    parts = file.relative_to(REPOSITORY).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imported(tree: ast.Module, known: Mapping[str, ast.Module]) -> frozenset[str]:
    """Modules of the package that a text imports."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            within = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= within & known.keys() or {node.module}
    return frozenset(found & known.keys())


def _reached(room: str, rooms: Mapping[str, set[str]]) -> set[str]:
    """Every room that is reached from one by imports."""
    found: set[str] = set()
    waiting = list(rooms[room])
    while waiting:
        if (other := waiting.pop()) not in found:
            found.add(other)
            waiting += rooms[other]
    return found


def told(package: Package) -> str:
    """Return the figures of one package in a line."""
    rooms, levels = package.rooms, package.levels
    arrows = sum(map(len, rooms.values()))
    circles = "; ".join(" and ".join(sorted(ring)) for ring in package.circles) or "none"
    return (
        f"{package.name:8} {package.lines:6} lines {len(package.modules):4} modules {len(rooms):3} rooms "
        f"{max(levels.values()):3} levels {arrows:4} arrows  circles: {circles}"
    )


def drawn(packages: list[Package]) -> str:
    """Return the picture of the packages, the highest room on top."""
    parts: list[str] = []
    top_px = 10
    for package in packages:
        shelves: dict[int, list[str]] = {}
        for room, level in package.levels.items():
            shelves.setdefault(level, []).append(room)
        height_px = len(shelves) * LEVEL_PX + 34
        parts.append(
            f'<rect x="5" y="{top_px}" width="{WIDTH_PX - 10}" height="{height_px}" rx="8" '
            f'fill="{COLOURS[package.name]}" stroke="#888"/>'
            f'<text x="18" y="{top_px + 22}" font-weight="bold" font-size="16">{package.name}</text>'
        )
        parts += _shelves(package, shelves, top_px + 30)
        top_px += height_px + 12
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH_PX}" height="{top_px}" '
        f'viewBox="0 0 {WIDTH_PX} {top_px}" font-family="sans-serif" font-size="13">'
        f'<rect width="100%" height="100%" fill="white"/>{"".join(parts)}</svg>\n'
    )


def _shelves(package: Package, shelves: Mapping[int, list[str]], top_px: int) -> list[str]:
    """The rooms of one package, each level a row, and the arrows between them behind."""
    middles: dict[str, tuple[float, float]] = {}
    boxes: list[str] = []
    for row, level in enumerate(sorted(shelves, reverse=True)):
        rooms = sorted(shelves[level])
        width_px = min(420.0, (WIDTH_PX - 50 + GAP_PX) / len(rooms) - GAP_PX)
        left_px = (WIDTH_PX - len(rooms) * (width_px + GAP_PX) + GAP_PX) / 2
        for room in rooms:
            y_px = top_px + row * LEVEL_PX
            middles[room] = (left_px + width_px / 2, y_px + ROOM_PX / 2)
            boxes.append(_box(room, package.words[f"{package.name}.{room}"], left_px, y_px, width_px))
            left_px += width_px + GAP_PX
    arrows = [
        f'<line x1="{middles[room][0]:.0f}" y1="{middles[room][1]:.0f}" x2="{middles[other][0]:.0f}" '
        f'y2="{middles[other][1]:.0f}" stroke="#777" stroke-opacity="0.35"/>'
        for room, used in package.rooms.items()
        for other in sorted(used)
    ]
    return [*arrows, *boxes]


def _box(room: str, words: str, left_px: float, top_px: float, width_px: float) -> str:
    """One room: its name, and below it as much of what it says of itself as two lines hold."""
    middle_px = left_px + width_px / 2
    lines = textwrap.wrap(words, int(width_px / LETTER_PX), max_lines=2, placeholder=" ...")
    small = "".join(
        f'<text x="{middle_px:.0f}" y="{top_px + 34 + 14 * number}" text-anchor="middle" font-size="11" '
        f'fill="#444">{escape(line)}</text>'
        for number, line in enumerate(lines)
    )
    return (
        f'<rect x="{left_px:.0f}" y="{top_px}" width="{width_px:.0f}" height="{ROOM_PX}" rx="5" '
        f'fill="white" stroke="#444"/><text x="{middle_px:.0f}" y="{top_px + 18}" text-anchor="middle" '
        f'font-weight="bold">{room}</text>{small}'
    )


def main() -> int:
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("--svg", type=new_file, metavar="FILE", help="draw them")
    args = parser.parse_args()
    packages = [read_package(name) for name in PACKAGES]
    for package in packages:
        print(told(package))
    if args.svg:
        args.svg.write_text(drawn(packages))
    return 0


if __name__ == "__main__":
    end(main)

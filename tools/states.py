"""Draw the daemon's states from their table: the picture, and the tables of docs/explanation/safety.md.

    .venv/bin/python -m tools.states                                 # the tables, in Markdown
    .venv/bin/python -m tools.states --svg docs/img/states.svg       # the picture
    .venv/bin/python -m tools.states --page docs/explanation/safety.md  # the tables in the page

Both come from `mastctl.control.table`; only where a state stands in the picture is said here.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.sax.saxutils import escape

from mastctl.answers import Word
from mastctl.control.table import CHOICES, EVENTS, HAPPENS, MEANINGS, TABLE, WORDS, Event, leads_to
from tools.command import end

BEGIN, END = "<!-- states: begin -->", "<!-- states: end -->"
PLACES: dict[Word, tuple[int, int]] = {  # px, middle of the box
    "starting": (100, 205),
    "ready": (420, 95),
    "moving": (770, 95),
    "tracking": (770, 320),
    "holding": (420, 430),
    "fault": (1090, 95),
    "stopping": (1090, 430),
    "stopped": (1090, 590),
    "closing": (420, 590),
}
GROUP: tuple[Word, ...] = ("starting", "ready", "moving", "tracking", "holding")  # nothing is wrong
FRAME = (25, 45, 850, 475)  # px around them: left, top, right, bottom
BOX_PX = (112, 44)
SIZE_PX = (1250, 650)
LABELS = {
    ("moving", "holding"): 0.22,
    ("tracking", "ready"): 0.2,
    ("fault", "holding"): 0.55,
}  # along the arrow
GREY = frozenset[Word]({"stopping", "stopped", "fault", "closing"})


def tables() -> str:
    """Return the states, the events and the transitions as Markdown."""
    lines = ["| state | what it means |", "| --- | --- |"]
    lines += [f"| `{word}` | {MEANINGS[word]} |" for word in WORDS]
    lines += ["", "| event | what happened | leads to |", "| --- | --- | --- |"]
    lines += [f"| `{event}` | {HAPPENS[event]} | {_row(event)} |" for event in EVENTS]
    lines += ["", "| choice | the first that is true |", "| --- | --- |"]
    for choice, (follows, words) in CHOICES.items():
        summary = (follows.__doc__ or "").partition("\n")[0].removeprefix("Return the state ").rstrip(".")
        lines.append(f"| *{choice}* | {', '.join(f'`{word}`' for word in words)}: {summary} |")
    return "\n".join(lines)


def _row(event: Event) -> str:
    """What an event leads to, states with the same answer together."""
    froms: dict[str, list[Word]] = {}
    for word in WORDS:
        to = TABLE[word].get(event)
        if to is not None:
            froms.setdefault(to, []).append(word)
    told = []
    for to, words in froms.items():
        kept = "every state" if len(words) == len(WORDS) else ", ".join(f"`{word}`" for word in words)
        if to.startswith("refused: "):
            told.append(f"refused from {kept} with `{to.removeprefix('refused: ')}`")
        else:
            told.append(f"*{to}* from {kept}" if to in CHOICES else f"`{to}` from {kept}")
    return "; ".join(told)


def arrows() -> Iterator[tuple[Word | None, Word, tuple[Event, ...]]]:
    """Yield each arrow of the picture: from (None: from every state of the frame), to, the events."""
    common: dict[tuple[Event, Word], int] = {}
    for word in GROUP:
        for event in EVENTS:
            for to in leads_to(word, event):
                common[event, to] = common.get((event, to), 0) + (to != word)
    framed = {pair for pair, count in common.items() if count == len(GROUP)}
    for to in WORDS:
        events = tuple(event for event in EVENTS if (event, to) in framed)
        if events:
            yield None, to, events
    for word in WORDS:
        for to in WORDS:
            events = tuple(
                event
                for event in EVENTS
                if to != word
                and to in leads_to(word, event)
                and not (word in GROUP and (event, to) in framed)
                and event != "closing"
            )
            if events:
                yield word, to, events


def picture() -> str:
    """Return the picture as SVG."""
    left, top, right, bottom = FRAME
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {SIZE_PX[0]} {SIZE_PX[1]}" '
        'font-family="sans-serif" font-size="12">',
        '<defs><marker id="end" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" '
        'orient="auto"><path d="M0,0 L8,4 L0,8 z" fill="#555"/></marker></defs>',
        f'<rect width="{SIZE_PX[0]}" height="{SIZE_PX[1]}" fill="white"/>',
        f'<rect x="{left}" y="{top}" width="{right - left}" height="{bottom - top}" rx="14" '
        'fill="#f6f9fc" stroke="#9ab" stroke-dasharray="6 4"/>',
        f'<text x="{left + 14}" y="{top + 20}" fill="#567">from each of these</text>',
    ]
    labels: list[str] = []
    for word, to, events in arrows():
        if to == "closing":
            continue
        line, label = _arrow(word, to, events)
        parts.append(line)
        labels.append(label)
    x, y = PLACES["closing"]
    labels.append(
        f'<text x="{x}" y="{y + 42}" text-anchor="middle" fill="#567">from every state, by closing</text>'
    )
    parts += labels
    parts += [_box(word) for word in WORDS]
    return "\n".join([*parts, "</svg>", ""])


def _box(word: Word) -> str:
    x, y = PLACES[word]
    width, height = BOX_PX
    fill = "#f8e3de" if word in GREY else "#d9e8f6"
    return (
        f'<rect x="{x - width / 2:g}" y="{y - height / 2:g}" width="{width}" height="{height}" rx="9" '
        f'fill="{fill}" stroke="#345"/><text x="{x}" y="{y + 5}" text-anchor="middle" font-size="15" '
        f'font-weight="bold">{word}</text>'
    )


def _arrow(word: Word | None, to: Word, events: Sequence[Event]) -> tuple[str, str]:
    """A line and its label; those that go both ways between two states run beside each other."""
    x2, y2 = PLACES[to]
    if word is None:
        y2 += 14
    x1, y1 = (FRAME[2], y2) if word is None else PLACES[word]
    far = math.hypot(x2 - x1, y2 - y1)
    ahead, aside = ((x2 - x1) / far, (y2 - y1) / far), (-(y2 - y1) / far, (x2 - x1) / far)
    apart = 0 if word is None else 9
    bow = 75 if {word, to} == {"stopped", "fault"} else 0
    start = 0.0 if word is None else _edge(ahead, (apart * aside[0], apart * aside[1]))
    stop = far - _edge((-ahead[0], -ahead[1]), (apart * aside[0], apart * aside[1]))

    def at(way: float, off: float) -> tuple[float, float]:
        return x1 + way * ahead[0] + off * aside[0], y1 + way * ahead[1] + off * aside[1]

    (ax, ay), (bx, by) = at(start, apart), at(stop, apart)
    cx, cy = at(far / 2, apart + 2 * bow)
    line = (
        f'<path d="M{ax:.0f},{ay:.0f} Q{cx:.0f},{cy:.0f} {bx:.0f},{by:.0f}" fill="none" stroke="#555" '
        'marker-end="url(#end)"/>'
    )
    flat = abs(aside[1]) > 0.95
    way = 0.45 if word is None else LABELS.get((word, to), 0.36)
    lift = 6.5 * len(events) + 1 if flat else 0.0
    tx, ty = at(start + way * (stop - start), apart + bow + lift)
    rows = [
        f'<tspan x="{tx:.0f}" dy="{0 if number == 0 else 13}">{escape(event)}</tspan>'
        for number, event in enumerate(events)
    ]
    ty -= 6.5 * (len(events) - 1) - 4
    return line, (
        f'<text x="{tx:.0f}" y="{ty:.0f}" text-anchor="middle" font-size="11" fill="#123" stroke="white" '
        f'stroke-width="4" paint-order="stroke">{"".join(rows)}</text>'
    )


def _edge(ahead: tuple[float, float], off: tuple[float, float]) -> float:
    """How far it is to the edge of a box in a direction, from so far off its middle, px."""
    return min(
        (size / 2 - math.copysign(1.0, way) * beside) / abs(way)
        for size, way, beside in zip(BOX_PX, ahead, off, strict=True)
        if way
    )


def with_tables(page: str) -> str:
    """Return a page with the tables of now between its two marks."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n{tables()}\n{END}{after}"


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--svg", type=Path, metavar="FILE", help="write the picture there")
    parser.add_argument("--page", type=Path, metavar="FILE", help="put the tables into this page")
    args = parser.parse_args(argv)
    if args.svg is not None:
        args.svg.write_text(picture())
    if args.page is not None:
        args.page.write_text(with_tables(args.page.read_text()))
    if args.svg is None and args.page is None:
        print(tables())
    return 0


if __name__ == "__main__":
    end(main)

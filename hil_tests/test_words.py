"""Pages, help texts and messages keep the rules of docs/contribute/how-we-write.md, within a budget."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import pytest

from tools import words

REPLACED = words.replaced_words((words.REPOSITORY / words.GLOSSARY).read_text(encoding="utf-8"))


def test_no_page_and_no_package_breaks_the_rules_more_often_than_its_budget() -> None:
    found = words.findings(words.checked_files())
    assert len(found) < 5000 and len(words.checked_files()) > 400
    allowed = words.budget()
    counts = Counter(one.counted_under for one in found)
    worse = {place: counts[place] for place in counts if counts[place] > allowed.get(place, 0)}
    shown = [str(one) for one in found if one.counted_under in worse]
    assert not worse, "\n".join([f"more findings than the budget {words.BUDGET} allows: {worse}", *shown])


def test_the_budget_names_only_what_is_there() -> None:
    assert [place for place in words.budget() if not (words.REPOSITORY / place).exists()] == []


@pytest.mark.parametrize(
    ("text", "rules"),
    [
        ("The daemon reports the fault. It then stops the head.", []),
        ("A client that holds the lease decides who may steer.", []),
        ("What does the daemon report?", []),
        ("| what it does | `eyes_disagree` |", []),
        ("```\nWho asks may not.\n```\n\nA page.", []),
        ("Who asks may not steer the head.", ["bare who"]),
        ("The head stops, and who asks again is refused.", ["bare who"]),
        ("What the joints read differently is subtracted first.", ["bare what"]),
        ("The operator is told.", ["word 'told'"]),
        ("| camera | one eye of a pair |", ["word 'eye'"]),
        ("- " + "word " * 31 + "end.", ["32 words"]),
        ("word " * 16 + "\n" + "word " * 15, ["31 words"]),
        ("word " * 30 + "end here. More.", ["32 words"]),
        ("see [the page](" + "a" * 9 + ") `a b` " + "word " * 26, []),
    ],
)
def test_a_page_is_read_as_its_reader_reads_it(text: str, rules: list[str]) -> None:
    found = [
        one.rule
        for line, plain in words.page_texts(text)
        for one in words.findings_in(plain, "page.md", line, REPLACED)
    ]
    assert found == rules


def rules(texts: Iterator[tuple[int, str]], file: str) -> list[tuple[int, str]]:
    return [
        (one.line, one.rule) for line, text in texts for one in words.findings_in(text, file, line, REPLACED)
    ]


def test_every_string_of_words_and_every_public_docstring_is_read() -> None:
    source = '''"""Who reads a module reads this first."""

raise NotNow("leased", f"{name} is held by somebody else now")
parser.add_argument("--pair", help="the two eyes of a pair")
log.info("what follows is read in the log: %s", words)
LABELS = ("eye", "what it does")
TOLD = 3
"""What a constant means is public too.

`what` is code.
"""
_PRIVATE = 3
"""Nobody reads this in the reference."""


class Camera:
    """One eye of a pair.

    Parameters
    ----------
    name
        What the configuration calls it.
    """

    def _look(self):
        """What a private name says is not read."""
'''
    assert rules(words.code_texts(source), "module.py") == [
        (1, "bare who"),
        (8, "bare what"),
        (17, "word 'eye'"),
        (22, "bare what"),
        (3, "word 'somebody'"),
        (4, "word 'eyes'"),
        (5, "bare what"),
    ]


def test_the_pages_elements_titles_and_strings_are_read() -> None:
    page = """<button title="Stops; nobody moves it">STOP <small>for <b>somebody</b></small></button>
{# nobody reads this #}<p>{{ number }} pictures of an eye</p><style>.eye { top: 0 }</style>
"""
    assert rules(words.page_files_texts(page, ".html"), "page.html") == [
        (1, "word 'nobody'"),
        (1, "word 'somebody'"),
        (2, "word 'eye'"),
    ]
    script = """// nobody reads a comment
say("found in the other eye", `what ${name} shows is old now`, "eye");
"""
    assert rules(words.page_files_texts(script, ".js"), "page.js") == [(2, "word 'eye'"), (2, "bare what")]

"""Pages, help texts and messages keep the rules of docs/contribute/how-we-write.md, within a budget."""

from __future__ import annotations

from collections import Counter

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


def test_messages_and_help_texts_are_read_from_the_code() -> None:
    source = """
raise NotNow("leased", f"{name} is held by somebody")
parser.add_argument("--pair", help="two eyes")
log.info("nobody reads this here")
"""
    found = [
        (one.line, one.rule)
        for line, text in words.code_texts(source)
        for one in words.findings_in(text, "module.py", line, REPLACED)
    ]
    assert found == [(2, "word 'somebody'"), (3, "word 'eyes'")]

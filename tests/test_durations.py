import json

import pytest
import yaml
from test_workbook import Book

from affordlib.durations import MEASURED, expected_minutes, minutes_in_words, recorded_minutes


@pytest.fixture
def book(tmp_path):
    book = Book(tmp_path)
    book.add("01_first")
    book.add("02_second")
    measured = {"reader": {"01_first": 3.0, "02_second": 7.0}, "full": {"01_first": 30.0}}
    (book.layout.notebooks / MEASURED).write_text(yaml.safe_dump(measured))
    return book


def test_a_batch_says_beforehand_how_long_it_will_take(book, capsys):
    book.profile("full", "{}")
    assert book.run("--dry-run") == 0
    first, *lines = capsys.readouterr().out.splitlines()
    assert first == "to run: 2 of 2 notebooks, about 10 min"
    assert "would run (about 7 min) with {'seed'" in lines[1]
    assert book.run("--dry-run", "--profile", "full") == 0
    first, *lines = capsys.readouterr().out.splitlines()
    assert first == "to run: 2 of 2 notebooks, about 30 min, and 1 more of unknown length"
    assert "would run (length unknown) with" in lines[1]


def test_what_was_recorded_here_counts_for_more(book, capsys):
    assert book.run("--only", "01") == 0
    run = book.layout.runs / "reader"
    record = json.loads((run / ".complete" / "01_first.json").read_text())
    assert 0 < record["seconds"] < 120
    minutes = expected_minutes(book.layout.notebooks, "reader", run)
    assert minutes == {"01_first": record["seconds"] / 60, "02_second": 7.0}
    assert recorded_minutes(run) == {"01_first": record["seconds"] / 60}
    (run / ".complete" / "01_first.json").write_text('{"fingerprint": "of old"}')
    assert recorded_minutes(run) == {}


def test_unknown_durations_are_not_made_up():
    assert minutes_in_words(["a", "b"], {}) == ""
    assert minutes_in_words(["a"], {"a": 0.2}) == "about 1 min"

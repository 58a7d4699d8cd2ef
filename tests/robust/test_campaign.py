"""The page of robustness runs says what its rows say."""

import campaign
import pytest
from rows import read


def test_the_page_is_made_of_its_rows():
    text = campaign.PAGE.read_text(encoding="utf-8")
    assert campaign.with_rows(text, read(campaign.ROWS)) == text


def test_a_table_counts_what_failed():
    row = {
        "part": "readers",
        "format": "lct",
        "tried": 10,
        "read": 3,
        "refused": 5,
        "failures": ["a", "b", "c"],
    }
    told = campaign.tables([row | {"commit": "abc", "command": "x.py"}])
    assert "| lct | 10 | 5 | 0 | 3 | 2 |" in told
    assert "- lct: `b`" in told
    assert "- lct: 1 more like these" in told
    assert "`x.py` at abc" in told


def test_runs_of_one_command_are_one_line():
    row = {
        "part": "kills",
        "kind": "train",
        "kills": 3,
        "by": {"SIGINT": 3},
        "chains": 1,
        "same": 1,
        "failures": [],
    }
    other = row | {"kills": 2, "by": {"SIGKILL": 1, "SIGINT": 1}}
    told = campaign.tables(
        [made | {"commit": c, "command": "x.py"} for c, made in (("a", row), ("b", other))]
    )
    assert "| train | 5 (1, 4, 0) | 2 | 2 | 0 |" in told
    assert "`x.py` at a" in told
    assert "`x.py` at b" in told


def test_what_is_tried_again_alike_counts_once_and_keeps_what_failed():
    row = {"part": "mistakes", "kind": "train", "tried": 10, "refused": 9, "failures": ["a=b: a traceback"]}
    newer = row | {"tried": 12, "refused": 12, "failures": []}
    both = [made | {"commit": c, "command": "x.py"} for c, made in (("a", row), ("b", newer))]
    told = campaign.tables(both)
    assert "| train | 12 | 12 | 0 | 0 | 0 |" in told
    assert "- train: `at a: a=b: a traceback`" in told
    assert "`x.py` at b" in told
    assert "`x.py` at a" not in told
    drawn = [made | {"part": "disks"} for made in both]
    assert "| train | 22 | 21 | 0 | 0 | 1 |" in campaign.tables(drawn)


def test_every_part_names_a_script():
    for script, *_ in campaign.PARTS:
        assert (campaign.HERE / script).is_file()
    with pytest.raises(FileNotFoundError):
        read(campaign.HERE / "nothing.jsonl")

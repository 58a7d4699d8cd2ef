"""Tables for people and for machines, by hand."""

from __future__ import annotations

import pytest

from nlos_lit.io.tables import cell, markdown_table, write_csv


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"), (float("nan"), "–"), (True, "✓"), (False, "–"), (0.0, "0"), (12.3456, "12.3"),
        (4.58e-4, "4.58e-04"), (7, "7"), ("lct", "lct"), (1234567.0, "1.23e+06"), ("|x|", "\\|x\\|"),
    ],
)  # fmt: skip
def test_cells(value, text):
    assert cell(value) == text


def test_columns_of_all_rows_are_there():
    assert markdown_table([{"a": 1, "b": 0.5}, {"a": 2, "c": "x"}]).splitlines() == [
        "| a | b | c |", "|---|---|---|", "| 1 | 0.5 | – |", "| 2 | – | x |",
    ]  # fmt: skip


def test_a_table_may_show_its_values_in_its_own_way():
    assert markdown_table([{"a": 0.5, "b": None}], repr).splitlines()[2] == "| 0.5 | None |"


def test_csv_keeps_every_digit_and_every_column(tmp_path):
    write_csv(tmp_path / "table.csv", [{"a": 1 / 3}, {"a": 2.0, "b": "x, y"}])
    assert (tmp_path / "table.csv").read_bytes() == b'a,b\r\n0.3333333333333333,\r\n2.0,"x, y"\r\n'

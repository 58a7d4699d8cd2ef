"""Sizes are read as people write them, and what the machine cannot hold is refused."""

from __future__ import annotations

import psutil
import pytest

from nlos_lit.errors import MemoryBudgetError, UserError
from nlos_lit.memory import check_machine, parse_bytes


@pytest.mark.parametrize(
    ("text", "size"),
    [("8GiB", 8 << 30), ("500 MB", 500_000_000), ("1.5KiB", 1536), (1024, 1024), ("2e9", 2_000_000_000), ("7B", 7)],
)
def test_sizes(text, size):
    assert parse_bytes(text) == size


@pytest.mark.parametrize("text", ["lots", "8 gigs", "-1GiB", "", "GiB"])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(UserError, match="must be a size such as 8GiB"):
        parse_bytes(text)


def test_more_than_the_machine_has_is_refused():
    free = psutil.virtual_memory().available
    check_machine(free // 2, "half")
    with pytest.raises(MemoryBudgetError, match=r"twice needs about .* GiB, this machine has .* GiB free; sum spots"):
        check_machine(2 * free, "twice")

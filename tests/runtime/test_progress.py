"""What long work says of its progress."""

from __future__ import annotations

import logging

from nlos_lit.runtime.progress import planes_progress


def test_a_total_that_grows_is_followed(caplog):
    """Rounds that turn out to be needed: never more done than there is to do."""
    with caplog.at_level(logging.INFO), planes_progress("refining") as progress:
        for done, total in ((1, 3), (3, 3), (4, 5), (5, 5)):
            progress(done, total)
    said = [record.getMessage() for record in caplog.records]
    assert [text.split(",")[0] for text in said] == ["refining: 3 of 3", "refining: 5 of 5"]
    assert all(text.endswith(", 0 s left") for text in said)

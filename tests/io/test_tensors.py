"""Tensors in files."""

from __future__ import annotations

import pytest
import torch

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.foreign import archived
from nlos_lit.io import tensors
from nlos_lit.io.tensors import write_tensors


def test_what_is_compressed_is_what_was_written(tmp_path):
    value = {"who": torch.arange(50_000, dtype=torch.int32) // 1000, "name": "surfels", "at": [1, 2.5]}
    for deflate, name in ((False, "plain.pt"), (True, "packed.pt")):
        write_tensors(tmp_path / name, value, deflate)
        found = torch.load(archived(tmp_path / name, packed=deflate), weights_only=True)
        assert torch.equal(found.pop("who"), value["who"])
        assert found == {"name": "surfels", "at": [1, 2.5]}
    assert (tmp_path / "packed.pt").stat().st_size < 0.1 * (tmp_path / "plain.pt").stat().st_size
    with pytest.raises(UserError, match="unpacks to"):  # what is not said to be compressed
        archived(tmp_path / "packed.pt")


def test_what_readers_would_refuse_compressed_is_not(tmp_path, monkeypatch):
    monkeypatch.setattr(tensors, "PACKED", 1000)
    write_tensors(tmp_path / "large.pt", torch.zeros(5000), deflate=True)
    assert (tmp_path / "large.pt").stat().st_size > 20_000
    assert len(torch.load(archived(tmp_path / "large.pt", packed=True), weights_only=True)) == 5000

"""Tensors in plain containers, as PyTorch keeps them."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch

from nlos_lit.io.files import whole_file


def write_tensors(path: Path | str, value: Any) -> None:
    """Write what ``torch.load(…, weights_only=True)`` reads.

    Args:
        path: the target, written whole or not at all.
        value: tensors and numbers, in containers.
    """
    content = io.BytesIO()
    torch.save(value, content)
    with whole_file(path) as partial:
        partial.write_bytes(content.getbuffer())

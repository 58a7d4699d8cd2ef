"""Tensors in plain containers, as PyTorch keeps them."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import torch

from nlos_lit.capture.foreign import PACKED
from nlos_lit.io.files import whole_file


def write_tensors(path: Path | str, value: Any, deflate: bool = False) -> None:
    """Write what ``torch.load(…, weights_only=True)`` reads.

    Args:
        path: the target, written whole or not at all.
        value: tensors and numbers, in containers.
        deflate: compress up to a GiB, which readers take; a second for each 100 MB.
    """
    content = io.BytesIO()
    torch.save(value, content)
    with whole_file(path) as partial:
        if deflate and content.tell() <= PACKED:
            with (
                zipfile.ZipFile(content) as saved,
                zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed,
            ):
                for entry in saved.infolist():
                    packed.writestr(entry.filename, saved.read(entry))
        else:
            partial.write_bytes(content.getbuffer())

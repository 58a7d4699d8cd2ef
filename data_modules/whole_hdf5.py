"""HDF5 files that appear under their name when they are whole, and otherwise not at all."""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import h5py

from nlos_lit.capture.errors import CaptureError


@contextlib.contextmanager
def whole_hdf5(path: Path) -> Iterator[h5py.File]:
    """A new HDF5 file that is made in memory; its bytes are then written beside the target and renamed.

    HDF5 itself does not survive a disk that becomes full under its hands: it kills the process.

    Args:
        path: the target; a file there is replaced.

    Yields:
        the open file.

    Raises:
        CaptureError: it cannot be written; what was at ``path`` is still there.
    """
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        yield file
    partial = None
    try:
        handle, partial = tempfile.mkstemp(prefix=f".{path.name[:64]}.", dir=path.parent)
        with os.fdopen(handle, "wb") as written:
            written.write(content.getbuffer())
            written.flush()
            os.fsync(handle)
        os.chmod(partial, 0o644)
        os.replace(partial, path)
    except OSError as error:
        raise CaptureError(f"cannot write {path}: {error.strerror}") from error
    finally:
        if partial is not None:
            Path(partial).unlink(missing_ok=True)

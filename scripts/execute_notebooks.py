"""Execute the notebooks of docs/notebooks in place: ``python scripts/execute_notebooks.py [NAME …]``.

Each runs in a temporary folder of its own, with the ``nlos`` that is installed beside this Python. Outputs
are kept, and of what differs from one execution to the next without telling anything (times, ids, kernels)
nothing is.
Needs the extra: pip install '.[notebooks]'.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).resolve().parents[1] / "docs" / "notebooks"
SECONDS = 900  # a cell


def executed(path: Path) -> nbformat.NotebookNode:
    """The notebook with new outputs; a cell that fails ends it.

    Args:
        path: of the notebook.

    Returns:
        What is to be written.
    """
    notebook = nbformat.read(path, as_version=4)
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            notebook,
            timeout=SECONDS,
            kernel_name="python3",
            record_timing=False,
            resources={"metadata": {"path": folder}},
        )
        client.execute()
    for index, cell in enumerate(notebook.cells):
        cell.id = f"cell-{index}"
        cell.metadata = {}
    notebook.metadata = {"language_info": {"name": "python"}}
    return nbformat.from_dict(notebook)


def main(names: list[str]) -> None:
    """Execute the notebooks of these names, or all."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        if not names or path.stem in names:
            nbformat.write(executed(path), path)
            print(f"{path.name}: {path.stat().st_size // 1024} KiB")


if __name__ == "__main__":
    main(sys.argv[1:])

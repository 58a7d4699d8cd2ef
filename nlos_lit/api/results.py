"""What comes of a capture: a picture, a surface, a diagnosis. Each shows itself, and is saved as files."""

from __future__ import annotations

import base64
import html
import io
import os
import sys
import tempfile
import webbrowser
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nlos_lit.baselines.surface import front_points
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.inference.result import Diagnosis
from nlos_lit.io.meshes import write_mesh
from nlos_lit.io.points import Points, write_points
from nlos_lit.io.volumes import write_volume
from nlos_lit.report import figures
from nlos_lit.report.diagnosis_figures import diagnosis_figures
from nlos_lit.report.page import write_report
from nlos_lit.report.style import save_figure
from nlos_lit.report.verdict import verdict
from nlos_lit.surfels.fitted import FittedSurfels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")  # which it would announce in a notebook
DOTS = 80  # an inch, of figures in a notebook
OCTREE = 7  # depth of the Poisson reconstruction


class Result(ABC):
    """Something that is shown as a figure with a sentence."""

    @property
    @abstractmethod
    def sentence(self) -> str:
        """What it is, in one sentence."""

    @abstractmethod
    def figure(self) -> Figure:
        """It, drawn."""

    @abstractmethod
    def save(self, folder: Path | str) -> Path:
        """Write its files into a folder, which is made, and return that."""

    def __repr__(self) -> str:
        return self.sentence

    def show(self) -> None:
        """Draw it: in a notebook there, otherwise in the system's viewer of pictures."""
        if "IPython" in sys.modules:
            from IPython import get_ipython
            from IPython.display import display

            if get_ipython() is not None:
                display(self)
                return
        with tempfile.NamedTemporaryFile(suffix=".png", delete=False) as file:
            file.write(self._png())
        webbrowser.open(Path(file.name).as_uri())
        print(f"{self.sentence}\n{file.name}")

    def _png(self) -> bytes:
        content = io.BytesIO()
        self.figure().savefig(content, format="png", dpi=DOTS)
        return content.getvalue()

    def _repr_html_(self) -> str:
        sentence = html.escape(self.sentence)
        data = base64.b64encode(self._png()).decode()
        return f'<p>{sentence}</p><img alt="{sentence}" src="data:image/png;base64,{data}">'


@dataclass(frozen=True, repr=False)
class Picture(Result):
    """A volume reconstructed by one of the classical methods.

    Args:
        name: of the capture.
        method: by which it was made.
        values: ``[nz, nx, ny]``, relative to the largest.
        grid: where the voxels lie.
        threshold: share of the largest value below which there is no surface.
        seconds: that the method took.
        field: ``[3, nz, nx, ny]`` vectors along the surface's normal, where the method finds them.
    """

    name: str
    method: str
    values: np.ndarray
    grid: VolumeGrid
    threshold: float
    seconds: float
    field: np.ndarray | None = None

    @property
    def sentence(self) -> str:
        """Method, size and time."""
        nz, nx, ny = self.values.shape
        return f"{self.name} by {self.method}: {nx} × {ny} × {nz} voxels in {self.seconds:.1f} s"

    @cached_property
    def points(self) -> Points:
        """One surface point a column that reaches the threshold."""
        return front_points(self.values, self.grid, self.threshold, self.field)

    @property
    def depth(self) -> np.ndarray:
        """``[nx, ny]`` z of the largest value of each column, m; NaN below the threshold."""
        seen = self.values.max(axis=0) >= self.threshold
        return np.where(seen, self.grid.z[self.values.argmax(axis=0)], np.nan)

    def figure(self) -> Figure:
        """Front, side, above and depth."""
        return figures.volume_projections(
            self.values, self.grid, self.threshold, f"{self.name}, {self.method}"
        )

    def save(self, folder: Path | str) -> Path:
        """Write ``volume.h5``, ``points.ply``, ``mesh.ply``, ``mesh.glb`` and ``volume.png``."""
        folder = Path(folder)
        write_volume(folder / "volume.h5", self.values, self.grid)
        _save_points(self.points, folder)
        save_figure(self.figure(), folder / "volume.png")
        return folder


@dataclass(frozen=True, repr=False)
class Surface(Result):
    """Surfels fitted to the counts.

    Args:
        name: of the capture.
        fitted: the surfels, with their scores.
    """

    name: str
    fitted: FittedSurfels

    @property
    def sentence(self) -> str:
        """How many there are, and how well they predict spots that they were not fitted to."""
        scores = self.fitted.heldout
        told = (
            ""
            if scores is None
            else f"; held-out NMSE {scores.nmse:.4f} (noise {scores.nmse_noise_floor:.4f})"
        )
        return f"{self.name}: {len(self.fitted.model)} surfels in {self.fitted.seconds:.0f} s{told}"

    @cached_property
    def points(self) -> Points:
        """The surfels' places, normals and albedos."""
        return self.fitted.points()

    def figure(self) -> Figure:
        """The surface, by depth and by direction."""
        return figures.surface_plot(self.points)

    def save(self, folder: Path | str) -> Path:
        """Write ``points.ply``, ``mesh.ply``, ``mesh.glb`` and ``surface.png``."""
        folder = Path(folder)
        _save_points(self.points, folder)
        save_figure(self.figure(), folder / "surface.png")
        return folder


@dataclass(frozen=True, repr=False)
class Diagnosed(Result):
    """What the simulation gets wrong about a capture.

    Args:
        name: of the capture.
        diagnosis: all that was found.
    """

    name: str
    diagnosis: Diagnosis

    @property
    def sentence(self) -> str:
        """The verdict, in a few sentences."""
        return f"{self.name}: {verdict(self.diagnosis)}"

    def figure(self) -> Figure:
        """How much the counts ask for each effect by itself."""
        return diagnosis_figures(self.diagnosis)["screening"]

    def save(self, folder: Path | str) -> Path:
        """Write the report's page, ``diagnosis.json`` and all figures."""
        write_report(self.diagnosis, folder)
        return Path(folder)


def _save_points(points: Points, folder: Path) -> None:
    write_points(folder / "points.ply", points)
    write_mesh(folder / "mesh.ply", points, depth=OCTREE)

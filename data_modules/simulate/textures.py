"""Albedo over a body, in the body's own coordinates; sharp steps are cut into the mesh."""

from __future__ import annotations

import numpy as np

from data_modules.simulate.mesh import Mesh
from data_modules.simulate.shapes import split
from nlos_lit.capture.errors import UserError

TEXTURES = {
    "plain": "one albedo",
    "gradient": "from the first albedo at the lower end of `along` to the second at its upper end",
    "halves": "the first albedo below the body's centre along `along`, the second above it",
    "stripes": "layers across `along`, each `period`/2 thick; the centre lies in the first albedo",
    "checker": "cubes of edge `period`/2; the centre lies in the first albedo",
}
AXES = "xyz"
FINEST = 500  # steps across a body


def paint(mesh: Mesh, texture: str, albedo: tuple[float, float], along: str, period: float) -> Mesh:
    """A body with a texture.

    Args:
        mesh: the body in its own coordinates.
        texture: one of `TEXTURES`.
        albedo: the two albedos; ``plain`` takes the first.
        along: axis of a gradient, of halves and of stripes: x, y or z.
        period: of stripes and of the checker, m: twice their width.

    Returns:
        the body; its outline is unchanged, its area exactly so.

    Raises:
        UserError: stripes or checkers finer than a 500th of the body.

    Examples:
        A square of edge 1 in three stripes of 0.25, 0.5 and 0.25:

        >>> from data_modules.simulate.shapes import pulled
        >>> square = pulled(np.array([[-0.5, 0.0], [0.5, 0.0]]), height=1.0, cell=1.0)
        >>> striped = paint(square, "stripes", (0.2, 0.8), "x", 1.0)
        >>> area = np.linalg.norm(striped.face_vectors, axis=1)
        >>> round(float((area * striped.albedo[striped.faces].mean(axis=1)).sum()), 9)
        0.5
    """
    axis = AXES.index(along)
    first, second = albedo
    if texture == "plain":
        return Mesh(mesh.vertices, mesh.faces, np.asarray(first))
    if texture == "gradient":
        place = mesh.vertices[:, axis]
        extent = np.ptp(place)
        share = (place - place.min()) / extent if extent > 0 else np.full(len(place), 0.5)
        return Mesh(mesh.vertices, mesh.faces, first + (second - first) * share)
    if texture == "halves":
        cut, side = split(mesh, mesh.vertices[:, axis])
        return Mesh.from_face_albedo(cut.vertices, cut.faces, np.where(side < 0, first, second))
    width = period / 2
    axes = [axis] if texture == "stripes" else [0, 1, 2]
    for i in axes:
        low, high = mesh.vertices[:, i].min() / width, mesh.vertices[:, i].max() / width
        if high - low > FINEST:
            raise UserError(
                f"period={period:g} makes {high - low:.0f} steps across the body; give {FINEST} at most"
            )
        for k in np.arange(np.ceil(low - 0.5), np.floor(high - 0.5) + 1):
            mesh, _ = split(mesh, mesh.vertices[:, i] - (k + 0.5) * width)
    cell = np.floor(mesh.corners.mean(axis=1)[:, axes] / width + 0.5).sum(axis=1)
    return Mesh.from_face_albedo(mesh.vertices, mesh.faces, np.where(cell % 2 == 0, first, second))

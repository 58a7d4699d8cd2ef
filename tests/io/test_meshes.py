"""Poisson meshes: on the points, not beyond them, and a reason where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from nlos_lit.io.meshes import MIN_POINTS, poisson_mesh, write_mesh
from nlos_lit.io.points import Points

CENTRE, RADIUS = np.array([0.05, -0.1, 0.6]), 0.1


def cap() -> Points:
    """The part of a sphere that a wall at z = 0 sees, brighter towards +x."""
    u, v = np.meshgrid(np.linspace(-0.9, 0.9, 40), np.linspace(-0.9, 0.9, 40), indexing="ij")
    disc = u**2 + v**2 < 0.8
    u, v = u[disc], v[disc]
    normals = np.stack([u, v, -np.sqrt(1 - u**2 - v**2)], axis=1)
    return Points(CENTRE + RADIUS * normals, normals, 0.5 + 0.5 * u)


@pytest.fixture(scope="module")
def open3d():
    return pytest.importorskip("open3d", exc_type=ImportError)


def test_mesh_follows_the_surface_and_ends_with_the_points(open3d, tmp_path):
    points = cap()
    report = write_mesh(tmp_path / "mesh.ply", points)
    mesh = open3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    vertices = np.asarray(mesh.vertices)
    assert (len(vertices), len(mesh.triangles)) == (report.vertices, report.triangles)
    assert report.reason is None
    off = np.abs(np.linalg.norm(vertices - CENTRE, axis=1) - RADIUS) / RADIUS
    assert np.median(off) < 0.001
    assert np.quantile(off, 0.9) < 0.01
    # The cap's rim lies at z = -sqrt(0.2)·R of the centre; the closed surface's back would be at z > 0.
    assert vertices[:, 2].max() < CENTRE[2] - 0.3 * RADIUS
    # The cap seen along z has area 0.8·π·R²; its mesh covers it once.
    flat = vertices.copy()
    flat[:, 2] = 0
    mesh.vertices = open3d.utility.Vector3dVector(flat)
    assert mesh.get_surface_area() == pytest.approx(0.8 * np.pi * RADIUS**2, rel=0.1)


def test_mesh_is_grey_by_the_nearest_albedo(open3d):
    mesh, _ = poisson_mesh(cap())
    x, grey = np.asarray(mesh.vertices)[:, 0], np.asarray(mesh.vertex_colors)[:, 0]
    assert grey[x > CENTRE[0] + 0.05].min() > 1.5 * grey[x < CENTRE[0] - 0.05].max()


def test_the_same_points_give_the_same_mesh(open3d):
    first, second = (np.asarray(poisson_mesh(cap())[0].vertices) for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("count", [0, 1, MIN_POINTS - 1])
def test_too_few_points_are_a_reason(count, tmp_path):
    points = cap()
    few = Points(points.positions[:count], points.normals[:count], points.albedo[:count])
    report = write_mesh(tmp_path / "mesh.ply", few)
    assert f"{count} distinct surface points are too few" in report.reason
    assert list(tmp_path.iterdir()) == []


def test_one_point_many_times_is_a_reason():
    """Open3D crashes the process on such input."""
    same = Points(np.full((500, 3), 0.5), np.tile([0.0, 0.0, -1.0], (500, 1)), np.ones(500))
    mesh, report = poisson_mesh(same)
    assert mesh is None
    assert report.reason.startswith("1 distinct")


def test_a_line_and_random_normals_do_not_crash(open3d):
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    line = np.outer(np.linspace(0.1, 0.9, 200), [1.0, 0.0, 1.0])
    for positions in (line, rng.uniform(size=(200, 3))):
        mesh, report = poisson_mesh(Points(positions, normals, np.ones(200)))
        assert (mesh is None) == (report.reason is not None)

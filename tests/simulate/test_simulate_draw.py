"""Random scenes: they repeat, they lie where they should, every body is seen, and a capture comes out."""

from __future__ import annotations

import numpy as np
import pytest

from data_modules.simulate.bodies import Plate, Sphere
from data_modules.simulate.draw import ASIDE, FAR, NEAR, SEEN, draw_scene, shares_seen, way_to_touch


@pytest.mark.parametrize("seed", range(12))
def test_drawn_bodies_lie_inside_and_are_seen(seed):
    scene = draw_scene(seed)
    meshes = [body.mesh() for body in scene.bodies]
    assert shares_seen(meshes).min() > SEEN
    places = np.concatenate([mesh.vertices for mesh in meshes])
    assert np.abs(places[:, :2]).max() < ASIDE
    assert NEAR < places[:, 2].min() < places[:, 2].max() < FAR


def test_a_seed_gives_one_scene_and_one_capture():
    scene = draw_scene(3, spots=6)
    capture, truth = scene.measure()
    again, _ = draw_scene(3, spots=6).measure()
    assert np.array_equal(capture.counts, again.counts)
    assert scene.line() != draw_scene(4, spots=6).line()
    assert capture.scan_shape == (6, 6)
    assert capture.provenance["light_inside_window"] > 0.9999
    wanted = scene.sensor.mean_counts + scene.sensor.background * scene.scan.n_bins
    assert capture.counts.sum(axis=1).mean() == pytest.approx(wanted, rel=0.05)
    assert np.isfinite(truth.depth).any()


def test_many_scenes_hide_and_touch():
    """Of 40 scenes several have a body partly hidden, and several have two in touch."""
    hidden = touching = 0
    for seed in range(40):
        meshes = [body.mesh() for body in draw_scene(seed).bodies]
        hidden += shares_seen(meshes).min() < 0.9
        pairs = [(a, b) for i, a in enumerate(meshes) for b in meshes[:i]]
        touching += any(nearest(a, b) < 0.001 for a, b in pairs)
    assert hidden >= 5
    assert touching >= 5


def nearest(a, b) -> float:
    """Least distance of a vertex of one mesh to the other's surface."""
    import open3d as o3d

    def between(vertices, mesh):
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
        return scene.compute_distance(vertices.astype(np.float32)).numpy().min()

    return float(min(between(a.vertices, b), between(b.vertices, a)))


def test_a_ball_touches_a_plate_where_it_should():
    ball, plate = Sphere(radius=0.1, at=(0, 0, 0.2)).mesh(), Plate(at=(0, 0, 0.5)).mesh()
    assert way_to_touch(ball, plate, np.array([0.0, 0.0, 1.0])) == pytest.approx(0.2, abs=5e-4)
    assert way_to_touch(ball, plate, np.array([0.0, 0.0, -1.0])) == np.inf

"""Which spots do what."""

from __future__ import annotations

import numpy as np
import pytest
from inference_scenes import GATE, capture_of, raster
from scipy import ndimage

from nlos_lit.capture.errors import UserError
from nlos_lit.inference.split import split_spots


def roles(split, spots: int) -> np.ndarray:
    found = np.full(spots, "", dtype="<U6")
    for name in ("fit", "select", "test"):
        assert not found[getattr(split, name)].any(), "a spot has two roles"
        found[getattr(split, name)] = name
    return found


@pytest.mark.parametrize(("nx", "ny"), [(24, 24), (17, 40)])
def test_whole_patches_of_the_wall_have_one_role_each(nx, ny):
    scene = capture_of(raster(nx, ny), scan_shape=(nx, ny))
    split = split_spots(scene)
    role = roles(split, nx * ny)
    assert (role != "").all()
    share = {name: (role == name).mean() for name in ("fit", "select", "test")}
    assert share == pytest.approx({"fit": 5 / 8, "select": 2 / 8, "test": 1 / 8}, abs=0.04)
    wall = split.block.reshape(nx, ny)
    assert len(np.unique(wall)) == 64
    for block in np.unique(wall):
        inside = wall == block
        assert ndimage.label(inside)[1] == 1, "a patch is in pieces"
        assert inside.sum() == inside.any(1).sum() * inside.any(0).sum(), "a patch is not a rectangle"
        assert len(set(role[inside.ravel()])) == 1
    across = role.reshape(nx, ny)
    for line in (*across, *across.T):
        assert set(line) == {"fit", "select", "test"}, "a line of spots lacks a role"


def test_spots_without_counts_have_no_role():
    counts = np.ones((576, GATE[1]))
    counts[[5, 77, 300], GATE[0] :] = 0
    split = split_spots(capture_of(raster(24), counts=counts))
    assert sorted(np.setdiff1d(np.arange(576), np.concatenate([split.fit, split.select, split.test]))) == [
        5,
        77,
        300,
    ]


def test_patches_lie_where_spots_differ():
    """One laser point: the patches are the sensor's."""
    scene = capture_of(raster(24), "single")
    assert np.array_equal(split_spots(scene).block, split_spots(capture_of(raster(24))).block)


def test_a_tiny_scan_is_refused_in_a_sentence():
    with pytest.raises(UserError, match=r"only \d measured spots are left to \w+; .* at least 16 × 16 spots"):
        split_spots(capture_of(raster(6)))
    split_spots(capture_of(raster(16)))

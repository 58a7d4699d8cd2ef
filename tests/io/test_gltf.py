"""Binary glTF as the specification has it, and as Open3D reads it back."""

from __future__ import annotations

import json
import struct

import numpy as np

from nlos_lit.io.gltf import write_glb
from nlos_lit.io.views import Mesh

CORNERS = np.array([[0.0, 0, 1], [1, 0, 1], [0, 2, 1], [0, 0, 3]])
TETRAHEDRON = Mesh(
    CORNERS, np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]), np.array([0, 0.25, 0.5, 1])
)


def test_chunks_and_bounds(tmp_path):
    write_glb(tmp_path / "m.glb", TETRAHEDRON)
    content = (tmp_path / "m.glb").read_bytes()
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size, kind = struct.unpack_from("<I4s", content, 12)
    assert (kind, size % 4) == (b"JSON", 0)
    head = json.loads(content[20 : 20 + size])
    binary, kind = struct.unpack_from("<I4s", content, 20 + size)
    assert (kind, binary) == (b"BIN\0", head["buffers"][0]["byteLength"])
    assert len(content) == 28 + size + binary
    for view in head["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= binary
    assert head["accessors"][0]["min"] == [0, 0, 1]
    assert head["accessors"][0]["max"] == [1, 2, 3]


def test_open3d_reads_it_back(tmp_path):
    import open3d

    write_glb(tmp_path / "m.glb", TETRAHEDRON)
    mesh = open3d.io.read_triangle_mesh(tmp_path / "m.glb")
    np.testing.assert_allclose(np.asarray(mesh.vertices), CORNERS)
    np.testing.assert_array_equal(np.asarray(mesh.triangles), TETRAHEDRON.triangles)

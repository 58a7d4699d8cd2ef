"""Meshes as binary glTF 2.0, which browsers, Blender and phones open: metres, +y up."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from nlos_lit.io.files import whole_file
from nlos_lit.io.views import Mesh

FLOAT, UINT = 5126, 5125  # component types
VERTICES, INDICES = 34962, 34963  # what a buffer view holds


def write_glb(path: Path | str, mesh: Mesh) -> None:
    """Write one mesh with a grey at each vertex, seen from both sides.

    Chunks, accessors and their bounds are those of the Khronos specification of glTF 2.0.

    Args:
        path: GLB file, written whole or not at all.
        mesh: one triangle or more.

    Examples:
        >>> import tempfile
        >>> corners = np.array([[0.0, 0, 1], [1, 0, 1], [0, 1, 1]])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_glb(f"{folder}/one.glb", Mesh(corners, np.array([[0, 1, 2]]), np.ones(3)))
        ...     content = Path(f"{folder}/one.glb").read_bytes()
        >>> content[:4], len(content) == int.from_bytes(content[8:12], "little")
        (b'glTF', True)
    """
    places = mesh.vertices.astype("<f4")
    colours = np.repeat(np.clip(mesh.grey, 0, 1)[:, None], 3, axis=1).astype("<f4")
    corners = mesh.triangles.astype("<u4").reshape(-1)
    parts = (places.tobytes(), colours.tobytes(), corners.tobytes())  # all of whole four bytes
    starts = np.cumsum([0, *(len(part) for part in parts)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(part), "target": target}
        for start, part, target in zip(starts[:3], parts, (VERTICES, VERTICES, INDICES), strict=True)
    ]
    accessors = [
        {
            "bufferView": 0,
            "componentType": FLOAT,
            "count": len(places),
            "type": "VEC3",
            "min": places.min(0).tolist(),
            "max": places.max(0).tolist(),
        },
        {"bufferView": 1, "componentType": FLOAT, "count": len(places), "type": "VEC3"},
        {"bufferView": 2, "componentType": UINT, "count": len(corners), "type": "SCALAR"},
    ]
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
    matt = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    document = {
        "asset": {"version": "2.0", "generator": "nlos_lit"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "hidden surface"}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": matt}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": starts[3]}],
    }
    head = json.dumps(document).encode()
    head += b" " * (-len(head) % 4)
    chunks = struct.pack("<I4s", len(head), b"JSON") + head
    chunks += struct.pack("<I4s", starts[3], b"BIN\0") + b"".join(parts)
    with whole_file(path) as partial:
        partial.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)

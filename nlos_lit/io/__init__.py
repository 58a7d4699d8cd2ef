"""Results on disk: volumes, points, meshes, JSON; each a whole file or none."""

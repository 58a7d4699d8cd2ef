"""The surface of a scene: surfels fitted to the raw counts, with physical effects."""

"""The refined scene: surfels fitted to the raw counts, with physical effects."""

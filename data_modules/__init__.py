"""Captures for the fit: readers of public file formats, ground truth by simulation, batches of spots."""

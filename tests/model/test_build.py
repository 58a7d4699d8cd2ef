"""What cannot be built from a capture and settings, and with which sentence it is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from small_capture import fields

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import volume_grid
from nlos_lit.model.build import PipelineSettings, build_pipeline, normalisation
from nlos_lit.model.objective import Objective
from nlos_lit.model.pipeline import Rendering


def test_bins_that_were_not_recorded_count_neither_at_the_start_nor_in_the_loss():
    """A flat level of 4 counts gives what it gives whole, though a spot lost half its bins and one all."""
    observed = np.ones((12, 10), dtype=bool)
    observed[3, :5] = observed[4] = False
    objective = Objective(scale=1.0, lambda_sparsity=0.0, lambda_albedo=0.0)
    found = {}
    for name, seen in (("whole", None), ("cut", observed)):
        counts = np.full((12, 10), 4.0) if seen is None else 4.0 * seen
        capture = Capture(**fields(counts=counts, observed=seen))
        pipeline = build_pipeline(
            capture, volume_grid(capture, depth=(0.5, 0.7)), PipelineSettings(threshold=0.2, rays=8)
        )
        found[name] = (normalisation(capture), pipeline.laser_sensor.background().item())
        flat = Rendering(torch.full((12, 10), 7.0), torch.ones(1, 2, 2), torch.ones(1, 2, 2), None, None)
        pipeline.forward = lambda spots, flat=flat: flat._replace(expected=flat.expected[spots])
        spots = torch.tensor([3, 4, 5])
        terms = objective.terms(pipeline, spots, torch.from_numpy(capture.gated_counts())[spots], 0)
        found[name] += (terms["transient"].item(),)
    assert pipeline.observed_at(spots).sum(1).tolist() == [5, 0, 10]
    assert found["cut"] == pytest.approx(found["whole"])
    assert found["whole"][2] == pytest.approx(9)


@pytest.mark.parametrize(("bins", "level"), [(100, 3.0), (300_000, 0.01), (300_000, 30.0)])
def test_the_scale_is_that_of_sorted_bins(bins, level):
    """Of few bins and of many, where most are zero and where all differ; one hot bin sets it in the first."""
    counts = np.random.default_rng(bins).poisson(level, (12, bins)).astype(np.float32)
    counts[5, 70] = 1e5
    values = np.sort(counts.ravel())
    scale = normalisation(Capture(**fields(counts=counts, bin_length=1e-4)))
    assert scale == values[min(values.size - 1, int(0.999999 * values.size))]
    assert (scale == 1e5) == (bins == 100)


def test_a_gate_without_photons_is_refused():
    counts = np.arange(120).reshape(12, 10)
    counts[:, 5:] = 0
    capture = Capture(**fields(counts=counts, gate=(5, 10)))
    with pytest.raises(UserError, match=r"gate \[5, 10\) holds no photons"):
        build_pipeline(
            capture, volume_grid(capture, depth=(0.5, 0.7)), PipelineSettings(threshold=0.2, rays=8)
        )

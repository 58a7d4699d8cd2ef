"""What cannot be built from a capture and settings, and with which sentence it is refused."""

from __future__ import annotations

import numpy as np
import pytest
from small_capture import fields

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.volume_grid import volume_grid
from nlos_lit.model.build import PipelineSettings, build_pipeline


def test_a_gate_without_photons_is_refused():
    counts = np.arange(120).reshape(12, 10)
    counts[:, 5:] = 0
    capture = Capture(**fields(counts=counts, gate=(5, 10)))
    with pytest.raises(UserError, match=r"gate \[5, 10\) holds no photons"):
        build_pipeline(
            capture, volume_grid(capture, depth=(0.5, 0.7)), PipelineSettings(threshold=0.2, rays=8)
        )

"""The paper's simulated measurement: phasor image, implicit surface, transient renderer, laser-sensor model."""

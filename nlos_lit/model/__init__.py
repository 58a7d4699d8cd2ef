"""The paper's simulated measurement: phasor image, implicit surface, transient renderer, laser and sensor."""

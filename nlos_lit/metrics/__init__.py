"""How well transients and surfaces agree with what was measured or is true."""

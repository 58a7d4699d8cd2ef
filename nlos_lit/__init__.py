"""Self-calibrating, fully differentiable non-line-of-sight imaging."""

__version__ = "0.1.0"

"""What was measured, and where: counts, wall points and time axis, and the volume imaged through them."""

from nlos_lit.capture.capture import SPEED_OF_LIGHT, Capture
from nlos_lit.capture.errors import CaptureError, MemoryBudgetError, UserError

__all__ = ["SPEED_OF_LIGHT", "Capture", "CaptureError", "MemoryBudgetError", "UserError"]

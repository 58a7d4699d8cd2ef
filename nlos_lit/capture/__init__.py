"""What was measured, and where: counts, wall points, time axis, the volume imaged through them, and what is
wrong with a file.
"""

from nlos_lit.capture.capture import SPEED_OF_LIGHT, Capture
from nlos_lit.capture.errors import CaptureError, MemoryBudgetError, UserError

__all__ = ["SPEED_OF_LIGHT", "Capture", "CaptureError", "MemoryBudgetError", "UserError"]

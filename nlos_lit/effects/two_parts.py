"""What effects share whose light or counts decay in two parts, the second more quickly."""

from __future__ import annotations

from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter


def quicker_part(scan: Scan) -> tuple[Parameter, ...]:
    """Shapes of what decays in two parts: how much of it is quick, and how quickly that decays.

    What decays within four bins is the response's.
    """
    bins = scan.bin_length
    return (
        Parameter("quick", "1", None, 0.1, 0.0, 0.9, grid=(0.0,), kind="percent"),
        Parameter("quick_decay", "m", None, 0.2, 4 * bins, 16 * bins, grid=(6 * bins,), log=True),
    )


def share_left(effect: Effect, since: Tensor) -> Tensor:
    """What is left of it, ``(1 - q) e^{-t/τ} + q e^{-t/τ₂}``.

    Args:
        effect: with a ``decay`` τ, and ``quick`` q and ``quick_decay`` τ₂ of :func:`quicker_part`.
        since: m of path, since it began.

    Returns:
        as ``since``, 1 where that is 0.

    Examples:
        >>> import torch
        >>> from nlos_lit.effects import EFFECTS
        >>> from nlos_lit.effects.nominal import nominal_scan
        >>> tail = EFFECTS.named("irf_tail")(nominal_scan())
        >>> tail.set_all({"decay": 0.2, "quick": 0.5, "quick_decay": 0.1})
        >>> share_left(tail, torch.tensor([0.0, 0.2])).detach().round(decimals=3)
        tensor([1.0000, 0.2520])
    """
    decay, quick_decay, quick = (effect.value(name) for name in ("decay", "quick_decay", "quick"))
    return (1 - quick) * (-since / decay).exp() + quick * (-since / quick_decay).exp()

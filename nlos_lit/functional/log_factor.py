"""How much likelier counts are with random coefficients than without."""

from __future__ import annotations

from torch import Tensor


def log_factor(values: Tensor, squares: Tensor, variances: Tensor) -> Tensor:
    """Log Bayes factor of random coefficients against none: ``½ Σ_i [τ² w_i/(1 + τ² λ_i) - ln(1 + τ² λ_i)]``.

    Args:
        values: ``[…, k]`` λ, eigenvalues of their information.
        squares: ``[…, k]`` w, squares of their scores in its eigenbasis.
        variances: ``[V]`` τ², of the coefficients.

    Returns:
        ``[…, V]`` nats.

    Examples:
        >>> import torch
        >>> one = torch.tensor([3.0])
        >>> [round(v, 3) for v in log_factor(one, one * 16, torch.tensor([0.0, 1.0])).tolist()]
        [0.0, 5.307]
    """
    grown = 1 + variances[:, None] * values[..., None, :]
    return 0.5 * (variances[:, None] * squares[..., None, :] / grown - grown.log()).sum(-1)

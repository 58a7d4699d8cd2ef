"""What an iteration minimises, Eq. 11-14, and over which parameters. Torch alone."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from nlos_lit.functional.losses import albedo_variation, sparsity, transient_loss
from nlos_lit.model.pipeline import Pipeline


class Objective(NamedTuple):
    """Factors of the objective.

    Args:
        scale: counts that the loss counts as 1.
        lambda_sparsity, lambda_albedo: λ1 and λ2.
        albedo_planes: depth planes in each iteration's E_ρ (a random batch of voxels, unbiased); None takes
            all.
        seed: of the batches of voxels.
    """

    scale: float
    lambda_sparsity: float
    lambda_albedo: float
    albedo_planes: int | None = None
    seed: int = 0

    def terms(self, pipeline: Pipeline, spots: Tensor, counts: Tensor, step: int) -> dict[str, Tensor]:
        """Loss terms and their sum over a batch: ``spots`` ``[S]``, gated ``counts`` ``[S, T]``, number of
        the iteration.
        """
        rendering = pipeline(spots)
        terms = {"transient": transient_loss(counts / self.scale, rendering.expected / self.scale)}
        terms |= self.regularisation(rendering.intensity, self.voxel_batch(rendering.albedo, step))
        terms["loss"] = terms["transient"] + terms["sparsity"] + terms["albedo"]
        return terms

    def regularisation(self, intensity: Tensor, albedo: Tensor) -> dict[str, Tensor]:
        """E_Ipf and E_ρ with their factors, over a volume and (planes of) an albedo volume."""
        return {
            "sparsity": self.lambda_sparsity * sparsity(intensity),
            "albedo": self.lambda_albedo * albedo_variation(albedo),
        }

    def voxel_batch(self, albedo: Tensor, step: int) -> Tensor:
        """The planes of E_ρ in this iteration."""
        planes = albedo.shape[0]
        if self.albedo_planes is None or self.albedo_planes >= planes:
            return albedo
        generator = torch.Generator().manual_seed(self.seed + 7919 * step)
        chosen = torch.randperm(planes, generator=generator)[: self.albedo_planes]
        return albedo[chosen.to(albedo.device, non_blocking=True)]


def parameter_groups(pipeline: Pipeline) -> dict[str, list[nn.Parameter]]:
    """Θ_pf, Θ_ls and Θ_G under the names that configs use."""
    return {
        "phasor": [pipeline.phasor.omega_pf.raw, pipeline.phasor.sigma_pf.raw],
        "sensor": list(pipeline.laser_sensor.parameters()),
        "albedo": list(pipeline.albedo.parameters()),
    }


def adam(pipeline: Pipeline, rates: dict[str, float], optimised: list[str]) -> torch.optim.Adam:
    """Adam on the unconstrained parameters of the groups ``optimised``, each at its rate."""
    groups = parameter_groups(pipeline)
    return torch.optim.Adam([{"params": groups[name], "lr": rates[name], "name": name} for name in optimised])


def communicated_bytes(pipeline: Pipeline) -> int:
    """What each process of a distributed run hands over in an iteration: gradients and, where the field is
    shared, its volume's.
    """
    gradients = sum(
        p.numel() * p.element_size() for group in parameter_groups(pipeline).values() for p in group
    )
    phasor = pipeline.phasor
    return gradients + (
        0 if phasor.slabs is None else phasor.slabs.handed_over(phasor.grid.shape[1] * phasor.grid.shape[2])
    )

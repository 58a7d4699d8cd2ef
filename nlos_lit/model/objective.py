"""What an iteration minimises, Eq. 11-14, and over which parameters. Torch alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from nlos_lit.capture.errors import UserError
from nlos_lit.functional.losses import albedo_variation, sparsity, transient_loss
from nlos_lit.model.pipeline import Pipeline


class Objective(NamedTuple):
    """Factors of the objective ``E = E_H + λ1 · mean max_z I_pf + λ2 · TV(ρ)``, Eq. 11-14.

    Args:
        scale: counts that the loss counts as 1.
        lambda_sparsity: λ1, of the depth-projected intensity.
        lambda_albedo: λ2, of the albedo's variation.
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
        """Loss terms of a batch and their sum.

        Args:
            pipeline: the simulated measurement.
            spots: ``[S]`` rows of the capture.
            counts: ``[S, T]`` their gated counts; bins that the capture did not record are left out.
            step: number of the iteration; chooses the batch of voxels.

        Returns:
            ``transient``, ``sparsity``, ``albedo`` and their sum ``loss``, scalars.
        """
        rendering = pipeline(spots)
        data = transient_loss(
            counts / self.scale, rendering.expected / self.scale, pipeline.observed_at(spots)
        )
        terms = {"transient": data}
        terms |= self.regularisation(rendering.intensity, self.voxel_batch(rendering.albedo, step))
        terms["loss"] = terms["transient"] + terms["sparsity"] + terms["albedo"]
        return terms

    def regularisation(self, intensity: Tensor, albedo: Tensor) -> dict[str, Tensor]:
        """E_Ipf and E_ρ with their factors.

        Args:
            intensity: ``[nz, nx, ny]`` I_pf.
            albedo: ``[m, nx, ny]`` ρ, or planes of it.

        Returns:
            ``sparsity`` and ``albedo``, scalars.
        """
        return {
            "sparsity": self.lambda_sparsity * sparsity(intensity),
            "albedo": self.lambda_albedo * albedo_variation(albedo),
        }

    def voxel_batch(self, albedo: Tensor, step: int) -> Tensor:
        """The planes of E_ρ in this iteration.

        Args:
            albedo: ``[nz, nx, ny]`` ρ.
            step: number of the iteration.

        Returns:
            ``[m, nx, ny]``, m random planes; all where the volume has no more.
        """
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


def rated_groups(
    pipeline: Pipeline, rates: Mapping[str, float], optimised: Sequence[str]
) -> list[dict[str, Any]]:
    """Parameter groups as optimisers of torch take them.

    Args:
        pipeline: whose unconstrained parameters are fitted.
        rates: learning rate of every group, fitted or not.
        optimised: names of the groups that are fitted.

    Returns:
        One ``{"params", "lr", "name"}`` a fitted group.

    Raises:
        UserError: a group without a rate, or a rate without a group.
    """
    groups = parameter_groups(pipeline)
    if set(rates) != set(groups):
        raise UserError(
            f"optimizer.rates must give one rate for each of {', '.join(groups)}; found {', '.join(rates)}"
        )
    return [{"params": groups[name], "lr": rates[name], "name": name} for name in optimised]


def communicated_bytes(pipeline: Pipeline) -> int:
    """Bytes that each process of a distributed run hands over in an iteration.

    They are the gradients and, where the field is shared, planes of the volume.
    """
    gradients = sum(
        p.numel() * p.element_size() for group in parameter_groups(pipeline).values() for p in group
    )
    phasor = pipeline.phasor
    return gradients + (
        0 if phasor.slabs is None else phasor.slabs.handed_over(phasor.grid.shape[1] * phasor.grid.shape[2])
    )

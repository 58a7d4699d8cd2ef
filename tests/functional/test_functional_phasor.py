"""Phasor imaging's pieces: spectra, the basis of virtual pulses, propagation by FFT and by direct sum, the
magnitude's gradient.
"""

from __future__ import annotations

import math

import literal
import numpy as np
import pytest
import torch

from nlos_lit.functional.even_convolution import next_fast_length
from nlos_lit.functional.phasor import (
    PhasorMagnitude,
    direct_phasors,
    frequencies,
    lattice_phasors,
    spectrum,
    sum_of_rows,
    virtual_illumination,
    weight_basis,
)

DOUBLE = torch.float64


def test_virtual_illumination_is_the_pulses_spectrum():
    """Numerical Fourier integral of e^{iΩt} e^{-t²/2σ²}, over its largest value σ√(2π)."""
    omega = torch.tensor([10.0, 35.0, 40.0, 47.0], dtype=DOUBLE)
    t = torch.linspace(-1.5, 1.5, 20001, dtype=DOUBLE)
    pulse = torch.exp(1j * 40.0 * t) * torch.exp(-(t**2) / (2 * 0.1**2))
    integral = (
        (pulse * torch.exp(-1j * omega[:, None] * t)).sum(1) * (t[1] - t[0]) / (0.1 * math.sqrt(2 * math.pi))
    )
    found = virtual_illumination(omega, torch.tensor(40.0, dtype=DOUBLE), torch.tensor(0.1, dtype=DOUBLE))
    assert torch.allclose(found, integral.real, atol=1e-9)


def test_spectrum_by_hand():
    """Photons at t = 0.5 and 2 m: 3 e^{iΩ/2} + e^{2iΩ}; spots stay apart."""
    counts = torch.tensor([[3, 0, 1], [0, 2, 0]], dtype=torch.int32)
    omega = torch.tensor([0.0, math.pi], dtype=DOUBLE)
    found = spectrum(counts, torch.tensor([0.5, 1.0, 2.0], dtype=DOUBLE), omega)
    assert torch.allclose(found, torch.tensor([[4, 2], [1 + 3j, -2]], dtype=torch.complex64), atol=1e-6)


def test_frequencies_are_harmonics_of_the_period_over_the_whole_band():
    omega = frequencies((50.0, 90.0), 0.2, period=3.0)
    step = 2 * math.pi / 3
    assert torch.allclose(torch.diff(omega), torch.full((len(omega) - 1,), step, dtype=DOUBLE))
    assert torch.allclose(omega / step, torch.round(omega / step), atol=1e-9)
    assert 35 - step < omega[0] <= 35
    assert 105 <= omega[-1] < 105 + step
    assert frequencies((5.0, 90.0), 0.1, period=3.0)[0].item() == pytest.approx(step)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4])
@pytest.mark.parametrize(
    ("omega_bounds", "sigma_bounds"), [((15.0, 60.0), (0.06, 0.3)), ((100.0, 300.0), (0.012, 0.055))]
)
def test_basis_holds_every_admissible_spectrum(tolerance, omega_bounds, sigma_bounds):
    omega = frequencies(omega_bounds, sigma_bounds[0], period=2.0 + 4 * sigma_bounds[1])
    basis = weight_basis(omega, omega_bounds, sigma_bounds, tolerance)
    assert torch.allclose(basis.T @ basis, torch.eye(basis.shape[1], dtype=DOUBLE), atol=1e-10)
    assert basis.shape[1] < len(omega)
    draw = torch.rand(3000, 2, dtype=DOUBLE, generator=torch.manual_seed(0))
    centre = omega_bounds[0] + draw[:, 0] * (omega_bounds[1] - omega_bounds[0])
    sigma = sigma_bounds[0] * (sigma_bounds[1] / sigma_bounds[0]) ** draw[:, 1]
    weights = virtual_illumination(omega[:, None], centre, sigma)
    missing = (weights - basis @ (basis.T @ weights)).norm(dim=0) / weights.norm(dim=0)
    assert missing.max() < tolerance


class Scan:
    """A random field on a lattice, and the voxels imaged through it."""

    def __init__(
        self, *, nx=6, ny=5, mx=8, my=4, pitch=(0.07, 0.05), offset=(-1, 1), scans=1, confocal=True, seed=0
    ):
        generator = torch.manual_seed(seed)
        self.omega = torch.arange(4, 12, dtype=DOUBLE) * 5.1
        self.basis = torch.linalg.qr(torch.randn(8, 3, dtype=DOUBLE, generator=generator))[0]
        self.field = torch.randn(scans, 8, nx, ny, dtype=torch.complex64, generator=generator)
        self.pitch, self.offset, self.shape = pitch, offset, (mx, my)
        self.depth = torch.tensor([0.21, 0.37, 0.9], dtype=DOUBLE)
        x0, y0 = -0.13, 0.08
        x, y = torch.meshgrid(
            torch.arange(nx, dtype=DOUBLE) * pitch[0],
            torch.arange(ny, dtype=DOUBLE) * pitch[1],
            indexing="ij",
        )
        self.aperture = torch.stack([x0 + x, y0 + y, torch.zeros_like(x)], -1).reshape(-1, 3)
        self.voxel_origin = (x0 + offset[0] * pitch[0], y0 + offset[1] * pitch[1])
        self.fixed = (
            None if confocal else (torch.rand(scans, 3, dtype=DOUBLE, generator=generator) - 0.5) * 0.4
        )
        self.voxels = literal.voxel_centres((*self.voxel_origin, 0), (*pitch, 1), (3, mx, my))
        self.voxels[..., 2] = self.depth[:, None, None]

    def lattice(self):
        blocks = lattice_phasors(
            self.field, self.omega, self.basis, pitch=self.pitch, offset=self.offset, shape=self.shape,
            depth=self.depth, fixed=self.fixed, voxel_origin=self.voxel_origin,
        )  # fmt: skip
        return torch.cat(list(blocks))

    def spots(self):
        points = self.aperture.repeat(len(self.field), 1)
        other = points if self.fixed is None else self.fixed.repeat_interleave(len(self.aperture), 0)
        return self.field.permute(1, 0, 2, 3).reshape(len(self.omega), -1), other, points

    def direct(self, block=7):
        field, laser, sensor = self.spots()
        return torch.cat(
            list(
                direct_phasors(
                    field, self.omega, self.basis, laser, sensor, self.voxels.reshape(-1, 3), block
                )
            )
        )

    def written_out(self):
        field, laser, sensor = self.spots()
        flat = self.voxels.reshape(-1, 3)
        d_l, d_s = (torch.linalg.vector_norm(flat[:, None] - p, dim=2) for p in (laser, sensor))
        total = torch.zeros(len(flat), self.basis.shape[1], dtype=torch.complex128)
        for f, omega in enumerate(self.omega.tolist()):
            kernel = torch.exp(-1j * omega * (d_l + d_s)) / (d_l * d_s)
            total += (kernel @ field[f].to(torch.complex128))[:, None] * self.basis[f]
        return torch.stack([total.real, total.imag], dim=1)


SCANS = {
    "confocal": {},
    "wider volume": {"mx": 17, "my": 12, "offset": (-6, -3)},
    "narrower volume": {"mx": 3, "my": 2, "offset": (2, 1)},
    "volume aside": {"offset": (9, -11)},
    "negative pitch": {"pitch": (-0.07, 0.05), "offset": (1, -2)},
    "both negative": {"pitch": (-0.07, -0.03), "confocal": False, "offset": (3, 0)},
    "one fixed point": {"confocal": False, "offset": (0, 0)},
    "exhaustive": {"confocal": False, "scans": 4},
}


@pytest.mark.parametrize("name", SCANS)
def test_propagation_is_the_sum_written_out(name):
    scan = Scan(**SCANS[name])
    expected = scan.written_out()
    assert literal.relative(scan.lattice(), expected) < 5e-6
    assert literal.relative(scan.direct(), expected) < 5e-6
    assert (
        torch.equal(scan.direct(block=1000), scan.direct(block=7))
        or literal.relative(scan.direct(1000), scan.direct(7)) < 1e-6
    )


def test_no_circular_wrap_around():
    """A single lit aperture point at one edge: the far edge sees exactly 1/R² of it, not a copy from around
    the corner.
    """
    scan = Scan(mx=6, my=5, offset=(0, 0))
    scan.field = torch.zeros_like(scan.field)
    scan.field[0, 2, 0, 0] = 1
    scan.basis = torch.eye(8, dtype=DOUBLE)[:, 2:3]
    magnitude = scan.lattice().norm(dim=1).reshape(3, 6, 5)
    x, y = torch.meshgrid(torch.arange(6) * 0.07, torch.arange(5) * 0.05, indexing="ij")
    expected = 1 / (x**2 + y**2 + scan.depth[:, None, None] ** 2)
    assert torch.allclose(magnitude.double(), expected, rtol=2e-5)


def test_next_fast_length():
    assert [next_fast_length(n) for n in (1, 7, 11, 13, 127, 128, 129, 143)] == [
        1,
        8,
        12,
        15,
        128,
        128,
        135,
        144,
    ]


def test_magnitude_gradient():
    generator = torch.manual_seed(1)
    field = torch.randn(9, 2, 4, dtype=DOUBLE, generator=generator)
    weights = torch.randn(4, dtype=DOUBLE, generator=generator, requires_grad=True)
    assert torch.autograd.gradcheck(lambda w: PhasorMagnitude.apply(field, w), (weights,))
    by_hand = (field @ weights.detach()).norm(dim=1)
    assert torch.allclose(PhasorMagnitude.apply(field, weights), by_hand)


def test_magnitude_gradient_skips_dark_voxels_and_those_without_gradient():
    field = torch.zeros(3, 2, 2)
    field[1] = torch.tensor([[3.0, 0.0], [4.0, 0.0]])
    field[2] = 1.0
    weights = torch.tensor([1.0, 2.0], requires_grad=True)
    value = PhasorMagnitude.apply(field, weights)
    (gradient,) = torch.autograd.grad((value * torch.tensor([1.0, 1.0, 0.0])).sum(), weights)
    assert value.tolist() == pytest.approx([0, 5, 3 * 2**0.5])
    assert gradient.tolist() == pytest.approx([5, 0])


@pytest.mark.parametrize("on_host", [True, False])
def test_sums_keep_the_digits_that_a_cancelling_gradient_needs(on_host):
    """Of 2 · 20011 terms; a sum in single precision is off by up to 1e-5."""
    generator = torch.manual_seed(3)
    field, grad = torch.rand(20011, 2, 5, generator=generator) + 1, torch.rand(20011, generator=generator) + 1
    if on_host:
        weights = torch.linspace(0.1, 1, 5, dtype=DOUBLE).requires_grad_()
        (found,) = torch.autograd.grad(PhasorMagnitude.apply(field, weights), weights, grad)
        parts = field.double() @ weights.detach()
        pull = (parts * (grad.double() / parts.norm(dim=1))[:, None]).view(-1)
    else:
        pull = grad.repeat_interleave(2)
        found = sum_of_rows(pull, field.view(-1, 5))
    expected = pull.double() @ field.double().view(-1, 5)
    assert found.dtype == DOUBLE
    assert (found - expected).abs().max() < 1e-8 * expected.max()


def test_half_precision_magnitude_matches_its_own_rounding():
    field = torch.randn(50, 2, 6, generator=torch.manual_seed(2)).half()
    weights = torch.linspace(-1, 1, 6)
    expected = np.linalg.norm(field.double().numpy() @ weights.double().numpy(), axis=1)
    assert np.allclose(PhasorMagnitude.apply(field, weights).numpy(), expected, rtol=1e-5)

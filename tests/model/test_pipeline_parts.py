"""Energy, kernels, parameters, losses and metrics of the simulated measurement, by hand and by quadrature."""

from __future__ import annotations

import math

import literal
import numpy as np
import pytest
import torch
from scipy.integrate import dblquad

from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.functional.concentric import ray_grid
from nlos_lit.functional.losses import albedo_variation, sparsity, transient_loss
from nlos_lit.metrics.transients import expected_deviance, nmse, nmse_noise_floor, poisson_deviance
from nlos_lit.model.albedo import FreeAlbedo, ResidualAlbedo
from nlos_lit.model.geometry import ImplicitGeometry, Surface
from nlos_lit.model.laser_sensor import LaserSensor
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.model.renderer import TransientRenderer, throughput

UP = torch.tensor([[0.0, 0.0, 1.0]])


def plane_seen_from(origin, distance: float, half: float, side: int) -> Surface:
    """Hits of the square |x|, |y| ≤ half in the plane z = distance, facing the wall, for one wall point."""
    rays = ray_grid(side)
    origin = torch.tensor([origin])
    length = (distance - origin[0, 2]) / rays[:, 2]
    point = origin + length[:, None] * rays
    on = (point[:, 0].abs() <= half) & (point[:, 1].abs() <= half)
    count = int(on.sum())
    normal = torch.tensor([0.0, 0.0, -1.0]).expand(count, 3)
    return Surface(torch.zeros(count, dtype=torch.long), length[on], rays[on], point[on], normal)


def rendered(surface: Surface, laser, sensor, side: int, albedo: float = 1.0) -> torch.Tensor:
    renderer = TransientRenderer(n_bins=400, bin_length=0.01, t_start=0.0, rays=side**2)
    return renderer(
        surface,
        torch.full(surface.distance.shape, albedo),
        torch.tensor([laser]),
        UP,
        torch.tensor([sensor]),
        UP,
    )[0]


@pytest.mark.parametrize("distance", [0.5, 1.0])
def test_a_small_plate_facing_the_spot(distance):
    """K = ρ A / d⁴, all cosines 1: rays on the plate thin out as 1/d², each carries 1/d². Off the axis it is
    (1 + r²/d²)⁻⁴ less.
    """
    side, half = 1401, 0.06
    energy = rendered(
        plane_seen_from([0.0, 0.0, 0.0], distance, half, side), [0.0] * 3, [0.0] * 3, side, albedo=0.6
    )
    edges = 1 - 4 * (2 * half**2 / 3) / distance**2
    assert energy.sum().item() == pytest.approx(0.6 * (2 * half) ** 2 / distance**4 * edges, rel=0.015)
    assert energy.argmax().item() in (round(200 * distance) - 1, round(200 * distance))


def test_a_planes_energy_is_its_integral():
    """∬ cosθ1 cosθ2 cosθ3 cosθ4 / (d_lg² d_gs²) dA with laser and sensor apart; every cosine is z/d."""
    laser, sensor, depth, half, side = (-0.2, 0.1, 0.0), (0.15, 0.05, 0.0), 0.6, 0.35, 400

    def integrand(y: float, x: float) -> float:
        to_l = (x - laser[0]) ** 2 + (y - laser[1]) ** 2 + depth**2
        to_s = (x - sensor[0]) ** 2 + (y - sensor[1]) ** 2 + depth**2
        return depth**4 / (to_l * to_s) ** 2

    expected = dblquad(integrand, -half, half, -half, half)[0]
    energy = rendered(plane_seen_from(list(sensor), depth, half, side), list(laser), list(sensor), side)
    assert energy.sum().item() == pytest.approx(expected, rel=2e-3)


def test_throughput_by_hand():
    """A 3-4-5 triangle to the laser and a 5-12-13 one to the sensor: cosines 4/5, (unit·normal), 12/13."""
    point = torch.tensor([[3.0, 0.0, 4.0]])
    normal = torch.tensor([[0.0, 0.6, -0.8]])
    sensor_direction = torch.tensor([[5.0, 0.0, 12.0]]) / 13
    surface = Surface(torch.zeros(1, dtype=torch.long), torch.tensor([13.0]), sensor_direction, point, normal)
    found = throughput(surface, torch.zeros(1, 3), UP, UP)
    assert found.item() == pytest.approx(0.8 * (0.8 * 0.8) * (12 / 13) / 25, rel=1e-6)


def test_early_and_late_paths_are_outside_the_window():
    distance, up = torch.tensor([0.5, 3.0]), UP.expand(2, 3)
    surface = Surface(torch.zeros(2, dtype=torch.long), distance, up, distance[:, None] * up, -up)
    renderer = TransientRenderer(n_bins=50, bin_length=0.02, t_start=1.5, rays=100)
    assert renderer(surface, torch.ones(2), torch.zeros(1, 3), UP, torch.zeros(1, 3), UP).abs().max() == 0


def test_points_and_normals_of_a_tilted_sheet():
    """A thin bright sheet z = 0.6 + 0.3 x - 0.2 y: points lie on it, normals are (0.3, -0.2, -1)/|·| towards
    the wall.
    """
    grid = VolumeGrid((-0.3, -0.3, 0.4), (0.02, 0.02, 0.005), (90, 31, 31))
    z, x, y = np.meshgrid(grid.z, grid.x, grid.y, indexing="ij")
    sheet = torch.from_numpy(np.exp(-0.5 * ((z - 0.6 - 0.3 * x + 0.2 * y) / 0.02) ** 2)).float()
    geometry = ImplicitGeometry(grid, rays=60, threshold=0.5, step=0.004)
    found = geometry(sheet / sheet.max(), torch.tensor([[0.05, -0.02, 0.0]]), UP)
    residual = found.point[:, 2] - 0.6 - 0.3 * found.point[:, 0] + 0.2 * found.point[:, 1]
    inner = found.point[:, :2].abs().amax(1) < 0.25
    assert inner.sum() > 100
    assert residual[inner].abs().max() < 0.003
    expected = torch.tensor([0.3, -0.2, -1.0]) / math.sqrt(1.13)
    angle = torch.rad2deg(torch.acos((found.normal[inner] @ expected).clamp(-1, 1)))
    assert angle.median() < 2
    assert (found.normal * found.direction).sum(1).max() < 0


def parameter(value: float, lower: float, upper: float) -> BoundedParameter:
    return BoundedParameter(value, lower, upper, "m")


def test_bounded_parameter():
    theta = parameter(3.0, 0.5, 40.0)
    assert theta().item() == pytest.approx(3.0, rel=1e-5)
    for raw, bound in ((-200.0, 0.5), (200.0, 40.0)):
        with torch.no_grad():
            theta.raw.fill_(raw)
        assert theta().item() == pytest.approx(bound, rel=1e-5)
    raw = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    theta = parameter(3.0, 0.5, 40.0).double()
    assert torch.autograd.gradcheck(lambda r: torch.func.functional_call(theta, {"raw": r}, ()), (raw,))
    assert torch.func.functional_call(theta, {"raw": raw}, ()).item() == pytest.approx(
        literal.bounded(raw, 0.5, 40.0).item()
    )


@pytest.mark.parametrize("value", [0.5, 40.0, 0.1, 50.0, -1.0, float("nan")])
def test_bounded_parameter_refuses_values_on_or_beyond_its_bounds(value):
    with pytest.raises(ValueError, match=r"strictly between 0\.5 and 40"):
        parameter(value, 0.5, 40.0)


def sensor(n_bins: int, sigma=1.5, kappa=0.5, splat=None, upper=20.0, lowest=0.01) -> LaserSensor:
    """Bins of 2 cm; sigma and kappa in bins."""
    return LaserSensor(
        bin_length=0.02, n_bins=n_bins, sigma_ls=parameter(sigma * 0.02, 0.02 * 0.5, upper * 0.02),
        kappa_s=parameter(kappa / 0.02, lowest / 0.02, 50 / 0.02), intensity=parameter(7.0, 1e-3, 1e3),
        background=parameter(0.25, 1e-3, 10.0), splat_sigma=splat,
    )  # fmt: skip


@pytest.mark.parametrize("n_bins", [64, 128, 512])
def test_sensor_response_is_not_cut_before_the_transient_ends(n_bins):
    """A pulse in bin 4 keeps its whole tail, however wide σ_ls may become; the closing bins follow the
    response to the end.
    """
    model = sensor(n_bins, sigma=1.5, kappa=0.2)
    transient = torch.zeros(1, n_bins)
    transient[0, 4] = 3.0
    found = model(transient).detach()[0] - 0.25
    share = literal.psi(
        torch.tensor(1.5, dtype=literal.DOUBLE), torch.tensor(0.2, dtype=literal.DOUBLE), -4, n_bins - 5
    )
    assert literal.relative(found, 21.0 * share) < 1e-3


def test_subtracted_splat_leaves_the_physical_width():
    """Splat and kernel together: mean 1/κ, variance σ² + 1/κ² + 1/12, averaged over the arrival's phase."""
    from nlos_lit.functional.splat import gaussian_splat

    phases = torch.arange(50) / 50
    transients = gaussian_splat(torch.ones(50), 60 + phases, torch.arange(50), 50, 300, 0.62)
    with torch.no_grad():
        found = (sensor(300, sigma=1.5, kappa=0.5, splat=0.62)(transients) - 0.25).double() / 7
    delay = torch.arange(300) + 0.5 - (60 + phases[:, None])
    assert found.sum(1).mean().item() == pytest.approx(1, abs=1e-3)
    mean = (found * delay).sum(1).mean().item()
    assert mean == pytest.approx(2.0, abs=5e-3)
    assert (found * (delay - mean) ** 2).sum(1).mean().item() == pytest.approx(1.5**2 + 4 + 1 / 12, rel=5e-3)


def test_losses_by_hand():
    measured, simulated = (
        torch.tensor([[1.0, 2.0, 4.0], [0.0, 1.0, 1.0]]),
        torch.tensor([[1.0, 3.0, 1.0], [2.0, 1.0, 0.0]]),
    )
    assert transient_loss(measured, simulated).item() == pytest.approx((1 + 9 + 4 + 1) / 6)
    volume = torch.tensor([[[0.1, 0.5], [0.9, 0.2]], [[0.3, 0.4], [0.0, 0.6]], [[0.2, 0.0], [0.1, 1.0]]])
    assert sparsity(volume).item() == pytest.approx((0.3 + 0.5 + 0.9 + 1.0) / 4)
    along_x = 0.8 + 0.3 + 0.3 + 0.2 + 0.1 + 1.0
    along_y = 0.4 + 0.7 + 0.1 + 0.6 + 0.2 + 0.9
    assert albedo_variation(volume).item() == pytest.approx((along_x + along_y) / 12)


def test_metrics_by_hand():
    counts, expected = torch.tensor([3, 0, 1, 4]), torch.tensor([2.0, 0.5, 1.0, 8.0])
    assert nmse(counts, expected).item() == pytest.approx((1 + 0.25 + 0 + 16) / 26)
    assert nmse_noise_floor(counts).item() == pytest.approx(8 / 26)
    by_hand = [2 * (3 * math.log(1.5) - 1), 1.0, 0.0, 2 * (4 * math.log(0.5) + 4)]
    assert poisson_deviance(counts, expected).tolist() == pytest.approx(by_hand, rel=1e-12)
    assert poisson_deviance(torch.zeros(1), torch.zeros(1)).item() == 0


def test_expected_deviance():
    """2 Σ_k p(k) (k ln(k/μ) - k + μ): 0.73 at μ = 0.3, 1.15 at 1, close to 1 for many counts."""
    for mu in (0.3, 1.0, 50.0):
        k = np.arange(0, 200)
        log_p = -mu + k * math.log(mu) - np.array([math.lgamma(i + 1) for i in k])
        terms = np.where(k > 0, k * np.log(np.maximum(k, 1) / mu), 0) - k + mu
        exact = float((np.exp(log_p) * 2 * terms).sum())
        assert expected_deviance(torch.full((200_000,), mu)).item() == pytest.approx(exact, rel=0.02)


def test_noise_floor_is_the_nmse_of_the_truth():
    truth = torch.rand(400, 500, generator=torch.manual_seed(0)) * 3 + 0.1
    counts = torch.poisson(truth, generator=torch.manual_seed(1))
    assert nmse(counts, truth).item() == pytest.approx(nmse_noise_floor(counts).item(), rel=0.02)


def test_albedos_by_hand():
    intensity = torch.tensor([[[0.1, 0.3, 0.95]]])
    free = FreeAlbedo((1, 1, 3), 0.3)
    assert torch.allclose(free(intensity), torch.full((1, 1, 3), 0.3))
    residual = ResidualAlbedo((1, 1, 3), threshold=0.2)
    assert torch.allclose(residual(intensity), torch.tensor([[[0.0, 0.3, 0.95]]]))
    with torch.no_grad():
        residual.raw.fill_(50.0)
    assert torch.allclose(residual(intensity), torch.tensor([[[0.0, 0.5, 1.0]]]))

"""Loops over light paths: what :mod:`~nlos_lit.functional.surfel_paths` says, and the response of
:mod:`~nlos_lit.functional.irf`. Arrays of points have a row for each coordinate.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nlos_lit.functional.compiled import inlined, loop

EDGE = 4  # bins on either side of a record that take what is lost
ROW = 2 * EDGE + 3  # bins that a padded row has beside the record's
BLOCK = 8  # bins at a time
ZERO, ONE, TWO, THREE, FOUR, SIX, HALF = (np.float32(x) for x in (0, 1, 2, 3, 4, 6, 0.5))
LEAST = np.float32(1e-12)  # m², of a leg's square


@inlined
def _leg(dx, dy, dz, fx, fy, fz, nx, ny, nz):
    """Of a way from the wall: its square, and its ends' distances from the other's plane."""
    square = max(dx * dx + dy * dy + dz * dz, LEAST)
    at_wall = max(nx * dx + ny * dy + nz * dz, ZERO)
    plane = max(-(fx * dx + fy * dy + fz * dz), ZERO)
    return square, at_wall, plane


@loop
def legs(wall, normal, factor, way, cosine, p, f) -> None:
    """cosθ_wall cosθ_surfel / d², d and cosθ_surfel of legs from wall points to points.

    Args:
        wall, normal: ``[B, 3]`` wall points, m, and their normals.
        factor, way, cosine: ``[B, N]``, set.
        p, f: ``[3, N]`` places, m, and normals of points.
    """
    for b in range(len(wall)):
        wx, wy, wz = wall[b]
        nx, ny, nz = normal[b]
        factors, ways, cosines = factor[b], way[b], cosine[b]
        for n in range(p.shape[1]):
            dx, dy, dz = p[0, n] - wx, p[1, n] - wy, p[2, n] - wz
            square, at_wall, plane = _leg(dx, dy, dz, f[0, n], f[1, n], f[2, n], nx, ny, nz)
            inverse, root = ONE / square, np.sqrt(square)
            factors[n] = at_wall * plane * inverse * inverse
            ways[n] = root
            cosines[n] = plane * root * inverse


@loop
def pull_legs(wall, normal, of_factor, of_way, of_cosine, p, f, of_p, of_f) -> None:
    """Gradients of :func:`legs`.

    Args:
        wall, normal: ``[B, 3]`` wall points, m, and their normals.
        of_factor, of_way, of_cosine: ``[B, N]`` gradients of what it gives.
        p, f: ``[3, N]`` places, m, and normals of points.
        of_p, of_f: ``[3, N]`` their gradients, added to.
    """
    for b in range(len(wall)):
        wx, wy, wz = wall[b]
        nx, ny, nz = normal[b]
        factors, ways, cosines = of_factor[b], of_way[b], of_cosine[b]
        for n in range(p.shape[1]):
            dx, dy, dz = p[0, n] - wx, p[1, n] - wy, p[2, n] - wz
            fx, fy, fz = f[0, n], f[1, n], f[2, n]
            square, at_wall, plane = _leg(dx, dy, dz, fx, fy, fz, nx, ny, nz)
            inverse = ONE / square
            root = np.sqrt(square) * inverse
            g, c = factors[n] * inverse * inverse, cosines[n]
            along = root * (ways[n] - c * plane * inverse) - FOUR * g * at_wall * plane * inverse
            out = g * plane if at_wall > ZERO else ZERO
            level = g * at_wall + c * root if plane > ZERO else ZERO
            of_p[0, n] += along * dx + out * nx - level * fx
            of_p[1, n] += along * dy + out * ny - level * fy
            of_p[2, n] += along * dz + out * nz - level * fz
            of_f[0, n] -= level * dx
            of_f[1, n] -= level * dy
            of_f[2, n] -= level * dz


@loop
def energies(seen, factor, factor2, energy, share) -> None:
    """What paths carry: areas of points times what is seen of their surfels times the factors of both legs.

    Args:
        seen: ``[B, M]`` shares; of each surfel N/M points follow each other.
        factor, factor2: ``[B, N]`` of the legs.
        energy: ``[B, N]``, set.
        share: ``[N]`` areas, m².
    """
    each = len(share) // seen.shape[1]
    sight = np.empty(len(share), np.float32)
    for b in range(len(seen)):
        for m in range(seen.shape[1]):
            for n in range(m * each, (m + 1) * each):
                sight[n] = seen[b, m]
        first, second, row = factor[b], factor2[b], energy[b]
        for n in range(len(share)):
            row[n] = share[n] * sight[n] * first[n] * second[n]


@loop
def pull_energies(seen, factor, factor2, of_energy, of_seen, of_factor, of_factor2, share, of_share) -> None:
    """Gradients of :func:`energies`.

    Args:
        seen: ``[B, M]`` shares.
        factor, factor2: ``[B, N]`` of the legs.
        of_energy: ``[B, N]`` gradient of what it gives.
        of_seen, of_factor, of_factor2: gradients, set.
        share: ``[N]`` areas, m².
        of_share: ``[N]`` their gradient, added to.
    """
    each = len(share) // seen.shape[1]
    sight, part = np.empty(len(share), np.float32), np.empty(len(share), np.float32)
    for b in range(len(seen)):
        for m in range(seen.shape[1]):
            for n in range(m * each, (m + 1) * each):
                sight[n] = seen[b, m]
        first, second, row = factor[b], factor2[b], of_energy[b]
        to_first, to_second = of_factor[b], of_factor2[b]
        for n in range(len(share)):
            g = row[n] * share[n]
            both = first[n] * second[n]
            part[n] = g * both
            of_share[n] += row[n] * sight[n] * both
            to_first[n] = g * sight[n] * second[n]
            to_second[n] = g * sight[n] * first[n]
        for m in range(seen.shape[1]):
            total = ZERO
            for n in range(m * each, (m + 1) * each):
                total += part[n]
            of_seen[b, m] = total


@inlined
def _place(time, bins):
    """First of four bins in a padded row, and the phase; what is no number is lost before the record."""
    since = time - HALF if time > -TWO else -TWO - HALF
    since = since if since < bins + THREE * HALF else bins + THREE * HALF
    whole = np.floor(since)
    return np.int64(whole) + EDGE - 1, since - whole


@inlined
def _shares(light, s):
    """What each of the four bins gets at a phase."""
    v, left = light / SIX, ONE - s
    second = v * (FOUR + s * s * (THREE * s - SIX))
    return v * left * left * left, second, v * (ONE + THREE * s * (ONE + s - s * s)), v * s * s * s


@loop
def splat(light, time, padded) -> None:
    """Light into bins by cubic B-splines.

    Args:
        light, time: ``[B, K]`` how much arrives, and when (bins).
        padded: ``[B, T + ROW]``, added to.
    """
    bins = np.float32(padded.shape[1] - ROW)
    for b in range(len(light)):
        row = padded[b]
        for k in range(light.shape[1]):
            i, s = _place(time[b, k], bins)
            first, second, third, fourth = _shares(light[b, k], s)
            row[i] += first
            row[i + 1] += second
            row[i + 2] += third
            row[i + 3] += fourth


@loop
def splat_moved(moved, time, padded) -> None:
    """What changes in bins when light arrives later.

    Args:
        moved, time: ``[B, K]`` light times how much later it comes (bins), and when it came (bins).
        padded: ``[B, T + ROW]``, added to.
    """
    bins = np.float32(padded.shape[1] - ROW)
    for b in range(len(moved)):
        row = padded[b]
        for k in range(moved.shape[1]):
            i, s = _place(time[b, k], bins)
            v, left = moved[b, k] * HALF, ONE - s
            row[i] -= v * left * left
            row[i + 1] += v * s * (THREE * s - FOUR)
            row[i + 2] += v * (ONE + s * (TWO - THREE * s))
            row[i + 3] += v * s * s


@loop
def spline_values(padded, time, value, slope) -> None:
    """What arrivals see of bins through their shares, the transpose of :func:`splat`.

    Args:
        padded: ``[B, T + ROW]``.
        time: ``[B, K]`` of the arrivals, bins.
        value, slope: ``[B, K]`` what they see, and its derivative by time, set.
    """
    bins = np.float32(padded.shape[1] - ROW)
    for b in range(len(time)):
        row = padded[b]
        for k in range(time.shape[1]):
            i, s = _place(time[b, k], bins)
            r0, r1, r2, r3 = row[i], row[i + 1], row[i + 2], row[i + 3]
            c0, c1 = (r0 + FOUR * r1 + r2) / SIX, (r2 - r0) * HALF
            c2, c3 = (r0 + r2) * HALF - r1, (r3 - r0) / SIX + (r1 - r2) * HALF
            value[b, k] = c0 + s * (c1 + s * (c2 + s * c3))
            slope[b, k] = c1 + s * (TWO * c2 + THREE * s * c3)


@loop
def runs(light, time, bins) -> Any:
    """What the light of sources does to bins: of each source at each spot a run of bins, and its shares.

    Args:
        light, time: ``[B, M, Q]`` of Q points of each of M sources: per unit of the source's light, and bins.
        bins: T.

    Returns:
        ``[B, M]`` where runs begin in padded rows, ``[B, M + 1]`` their first ``BLOCK`` of shares, and all
        shares ``[n, BLOCK]``.
    """
    spots, sources, points = time.shape
    begin, block = np.empty((spots, sources), np.int32), np.zeros((spots, sources + 1), np.int64)
    for b in range(spots):
        if b:
            block[b, 0] = block[b - 1, sources]
        for m in range(sources):
            low, high = np.int64(bins) + ROW, 0
            for q in range(points):
                i, _ = _place(time[b, m, q], bins)
                low, high = min(low, i), max(high, i + 4)
            begin[b, m] = low
            block[b, m + 1] = block[b, m] + (high - low + BLOCK - 1) // BLOCK
    share = np.zeros((block[spots - 1, sources], BLOCK), np.float32)
    flat = share.reshape(-1)
    for b in range(spots):
        for m in range(sources):
            at = block[b, m] * BLOCK - begin[b, m]
            for q in range(points):
                i, s = _place(time[b, m, q], bins)
                first, second, third, fourth = _shares(light[b, m, q], s)
                flat[at + i] += first
                flat[at + i + 1] += second
                flat[at + i + 2] += third
                flat[at + i + 3] += fourth
    return begin, block, share


@loop
def send(begin, block, share, light, padded) -> None:
    """Light of sources into bins, by their :func:`runs`.

    Args:
        begin, block, share: the runs.
        light: ``[M]`` of the sources.
        padded: ``[B, T + ROW + BLOCK]``, added to.
    """
    for b in range(len(begin)):
        row = padded[b]
        for m in range(len(light)):
            first, value = begin[b, m], light[m]
            for n in range(block[b, m], block[b, m + 1]):
                for k in range(BLOCK):
                    row[first + k] += value * share[n, k]
                first += BLOCK


@loop
def pull_send(begin, block, share, padded, of_light) -> None:
    """Gradient of :func:`send`.

    Args:
        begin, block, share: the runs.
        padded: ``[B, T + ROW + BLOCK]`` gradient of the bins.
        of_light: ``[M]`` that of the light, added to.
    """
    for b in range(len(begin)):
        row = padded[b]
        for m in range(len(of_light)):
            first, total = begin[b, m], ZERO
            for n in range(block[b, m], block[b, m + 1]):
                for k in range(BLOCK):
                    total += row[first + k] * share[n, k]
                first += BLOCK
            of_light[m] += total


@loop
def emg(number, first, sigma, kappa) -> Any:
    """Distribution function F of an exponentially modified Gaussian at steps of 1, and its slopes.

    With φ the normal density, Φ its integral and E = Φ(t/σ) - F, ∂F/∂σ = κ (φ(t/σ) - κσE) and ∂F/∂κ =
    (t - κσ²) E + σ φ(t/σ).

    Args:
        number: of steps.
        first: t of the first.
        sigma, kappa: σ and κ, in steps and one over steps.

    Returns:
        ``[3, number]`` double precision: F, its slope by σ, and by κ.
    """
    found = np.empty((3, number))
    for n in range(number):
        t = first + n
        u, late = t / sigma, t / sigma - kappa * sigma
        half = 0.5 * np.exp(-0.5 * u * u)
        jitter = half * _erfcx(-u * np.sqrt(0.5)) if u < 0 else 1 - 0.5 * math.erfc(u * np.sqrt(0.5))
        if late < 0:
            decay = half * _erfcx(-late * np.sqrt(0.5))
        else:
            decay = np.exp(0.5 * (kappa * sigma) ** 2 - kappa * t) * (
                1 - 0.5 * math.erfc(late * np.sqrt(0.5))
            )
        density = half * np.sqrt(2 / np.pi)
        found[0, n] = min(max(jitter - decay, 0.0), 1.0)
        found[1, n] = kappa * (density - kappa * sigma * decay)
        found[2, n] = (t - kappa * sigma**2) * decay + sigma * density
    return found


@inlined
def _erfcx(x):
    """exp(x²) erfc(x) of x ≥ 0; its asymptotic series, where erfc is nothing."""
    if x < 25:
        return np.exp(x * x) * math.erfc(x)
    return (1 - 0.5 / x**2 + 0.75 / x**4) / (x * np.sqrt(np.pi))

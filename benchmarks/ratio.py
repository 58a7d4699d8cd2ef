"""Our iteration against a literal one of the paper's formulation, side by side in one process: ``python
benchmarks/ratio.py``.

    python benchmarks/ratio.py sizes        three sizes, interleaved
    python benchmarks/ratio.py accuracy     loss and gradients of both against float64, at the same sizes
    python benchmarks/ratio.py growth       how both grow with spots, rays, bins, voxels, frequencies
    python benchmarks/ratio.py report       tables and figure into docs/speed.md
    threads=1                               beside any of them: threads of torch

Every row is stored as it is done (benchmarks/results/speed/), so that an interrupted run goes on. Seconds are
the process's own, with one thread: on a machine that others use, too, two threads wait for each other.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from functools import partial

import torch
from literal_torch import LiteralIteration
from report import growth_figure, perform, slope, store, stored, table, write_section
from timing import machine, median, seconds
from workload import Training, Workload, synthetic_capture

SIZES = (
    Workload("small", (16, 16), 128, 1 / 16, 0.02, 0.5, 24, 0.02, batch=4, rays=48),
    Workload("medium", (32, 32), 256, 1 / 32, 0.01, 0.5, 64, 0.01, batch=8, rays=100),
    Workload("SU / 4", (64, 64), 512, 0.7 / 64, 0.0048, 0.5, 292, 0.0024, gate=200, batch=32, rays=200),
)
REPEATS = {"small": 9, "medium": 5, "SU / 4": 1}
BASE = Workload("base", (32, 32), 256, 1 / 32, 0.01, 0.6, 32, 0.0125, batch=8, rays=64)
GROWTH = {
    "spots of the scan": [(n * n, replace(BASE, spots=(n, n), pitch=1 / n)) for n in (16, 32, 64)],
    "spots an iteration": [(n, replace(BASE, batch=n)) for n in (4, 8, 16)],
    "rays a spot": [(n * n, replace(BASE, rays=n)) for n in (32, 64, 128)],
    "bins": [(n, replace(BASE, bins=n, bin_length=2.56 / n)) for n in (128, 256, 512)],
    "depth planes": [(n, replace(BASE, planes=n, plane_pitch=0.4 / n)) for n in (16, 32, 64)],
    "frequencies": [(f, replace(BASE, wavelength=0.125 / f)) for f in (0.5, 1, 2)],
}


def evaluate(
    iteration: Training | LiteralIteration, spots: torch.Tensor, counts: torch.Tensor
) -> dict[str, torch.Tensor]:
    """Data term, loss, and the data term's gradients: the paper's λ1 = 100 would hide them under the
    sparsity's.
    """
    phasor, sensor, albedo = (
        iteration.pipeline.phasor,
        iteration.pipeline.laser_sensor,
        iteration.pipeline.albedo,
    )
    named = {
        "omega_pf": phasor.omega_pf.raw, "sigma_pf": phasor.sigma_pf.raw, "sigma_ls": sensor.sigma_ls.raw,
        "kappa_s": sensor.kappa_s.raw, "I_l": sensor.intensity.raw, "eta_s": sensor.background.raw,
        "albedo": albedo.raw,
    }  # fmt: skip
    terms = iteration.terms(spots, counts.to(albedo.raw.dtype))
    gradients = torch.autograd.grad(terms["transient"], list(named.values()))
    return {"E_H": terms["transient"].detach(), "loss": terms["loss"].detach()} | dict(
        zip(named, gradients, strict=True)
    )


def relative(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> dict[str, float]:
    return {name: float((found[name] - value).norm() / value.norm()) for name, value in expected.items()}


def errors(workload: Workload) -> dict[str, object]:
    """Relative errors of both against the literal formulation in float64 with all frequencies, at the same
    parameters and batch.
    """
    training = Training(workload, synthetic_capture(workload), profile="paper")
    training.prepare()
    batch = training.batch()
    exact = evaluate(LiteralIteration(training, torch.float64, math.inf), *batch)
    literal, ours = (relative(evaluate(one, *batch), exact) for one in (LiteralIteration(training), training))
    return {"name": workload.name, "literal": literal, "ours": ours, "machine": machine()}


def compare(workload: Workload, repeats: int) -> dict[str, object]:
    """Seconds an iteration of both in turns, on the same batches; and of model=default, which has no literal
    counterpart.
    """
    capture = synthetic_capture(workload)
    paper, default = (Training(workload, capture, profile=profile) for profile in ("paper", "default"))
    setup, _ = seconds(paper.prepare), default.prepare()
    literal = LiteralIteration(paper)
    times: dict[str, list[float]] = {"ours": [], "default": [], "literal": []}
    for turn in range(repeats + 1):
        batch = paper.batch()
        for name, step in (("ours", paper.step_on), ("default", default.step_on)):
            runs = [seconds(partial(step, *batch)) for _ in range(4)]
            times[name] += runs if turn else []
        if turn or repeats > 1:  # the first turn warms up; not the literal one where it takes minutes
            took = seconds(partial(literal.step_on, *batch))
            times["literal"] += [took] if turn else []
    hits = len(paper.pipeline(paper.batch()[0]).surface.spot)
    found = {name: median(values) for name, values in times.items()}
    return {
        "name": workload.name, "spots": capture.n_spots, "bins": workload.bins,
        "voxels": paper.pipeline.phasor.grid.n_voxels,
        "planes": workload.planes, "batch": workload.batch, "rays": workload.rays**2,
        "frequencies": len(literal.omega),
        "rank": paper.plan.rank, "ffts": literal.ffts,
        "samples": workload.batch * workload.rays**2 * literal.n_samples,
        "setup_s": setup, "ours_s": found["ours"], "default_s": found["default"],
        "literal_s": found["literal"],
        "ratio": found["literal"] / found["ours"], "ratio_default": found["literal"] / found["default"],
        "hits": hits, "repeats": repeats, "machine": machine(),
    }  # fmt: skip


def sizes() -> None:
    for workload in SIZES:
        if stored("ratio", workload.name) is None:
            row = compare(workload, REPEATS[workload.name])
            store("ratio", workload.name, row)
        print(stored("ratio", workload.name), flush=True)


def accuracy() -> None:
    for workload in SIZES:
        if stored("accuracy", workload.name) is None:
            store("accuracy", workload.name, errors(workload))
        print(stored("accuracy", workload.name), flush=True)


def growth() -> None:
    for axis, cases in GROWTH.items():
        for value, workload in cases:
            name = f"{axis}={value}"
            if stored("ratio_growth", name) is None:
                store(
                    "ratio_growth",
                    name,
                    {"axis": axis, "value": value} | compare(replace(workload, name=name), 2),
                )
            print(
                name, {k: v for k, v in stored("ratio_growth", name).items() if k.endswith("_s")}, flush=True
            )


def report() -> None:
    rows = []
    for r in (row for w in SIZES if (row := stored("ratio", w.name))):
        rows.append([
            r["name"], f"{r['spots']} × {r['bins']} → {r['voxels']}", f"{r['batch']} × {r['rays']}",
            f"{r['ffts']}, {r['samples'] / 1e6:.3g} M", f"{r['literal_s']:.3g} s",
            f"{1e3 * r['ours_s']:.3g} ms",
            f"{r['ratio']:.0f}",
            f"{1e3 * r['default_s']:.3g} ms", f"{r['ratio_default']:.0f}",
        ])  # fmt: skip
    head = ["size", "scan × bins → voxels", "spots × rays", "literal: FFTs, samples", "literal",
            "ours, model=paper", "ratio", "ours, model=default", "ratio"]  # fmt: skip
    text = table(head, rows)
    rows = []
    for r in (row for w in SIZES if (row := stored("accuracy", w.name))):
        rows.append([r["name"]] + [f"{r['ours'][name]:.1e} / {r['literal'][name]:.1e}" for name in r["ours"]])
    if rows:
        text += "\n\nErrors against float64, ours / literal in float32:\n\n"
        text += table(["size", "E_H", "loss", "Ω_pf", "σ_pf", "σ_ls", "κ_s", "I_l", "η_s", "albedo"], rows)
    series, lines = {}, []
    for axis, cases in GROWTH.items():
        found = [r for value, _ in cases if (r := stored("ratio_growth", f"{axis}={value}"))]
        if len(found) < 2:
            continue
        x = [r["frequencies"] if axis == "frequencies" else r["value"] for r in found]
        curves = {"literal": [r["literal_s"] for r in found], "ours": [r["ours_s"] for r in found]}
        series[axis] = (x, curves)
        low, high = found[0]["ratio"], found[-1]["ratio"]
        lines.append(
            [
                axis,
                f"{x[0]} … {x[-1]}",
                f"{slope(x, curves['literal']):.2f}",
                f"{slope(x, curves['ours']):.2f}",
                f"{low:.0f} … {high:.0f}",
            ]
        )
    if series:
        growth_figure("ratio_growth", series, "seconds an iteration")
        text += "\n\n" + table(["grows", "range", "slope, literal", "slope, ours", "ratio"], lines)
        text += "\n\n![growth of an iteration](images/ratio_growth.png)"
    write_section("ratio", text)


if __name__ == "__main__":
    perform({"sizes": sizes, "accuracy": accuracy, "growth": growth, "report": report}, sys.argv[1:], __doc__)

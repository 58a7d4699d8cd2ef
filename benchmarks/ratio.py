"""Our iteration against a literal one of the paper's formulation, side by side in one process: ``python benchmarks/ratio.py``.

    python benchmarks/ratio.py sizes        three sizes, interleaved, with the same loss and gradients
    python benchmarks/ratio.py growth       how both grow with spots, rays, bins, voxels, frequencies
    python benchmarks/ratio.py report       tables and figure into docs/speed.md

Every row is stored as it is done (benchmarks/results/speed/), so that an interrupted run goes on. Seconds are the process's
own, with one thread: on a machine that others use, too, two threads wait for each other.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial

import torch
from literal_torch import LiteralIteration
from report import growth_figure, slope, store, stored, table, write_section
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


def gradients(training: Training) -> dict[str, torch.Tensor]:
    pipeline = training.pipeline
    named = {
        "omega_pf": pipeline.phasor.omega_pf.raw, "sigma_pf": pipeline.phasor.sigma_pf.raw,
        "sigma_ls": pipeline.laser_sensor.sigma_ls.raw, "kappa_s": pipeline.laser_sensor.kappa_s.raw,
        "I_l": pipeline.laser_sensor.intensity.raw, "eta_s": pipeline.laser_sensor.background.raw,
        "albedo": pipeline.albedo.raw,
    }  # fmt: skip
    return {name: p.grad.clone() for name, p in named.items()}


def agreement(training: Training, literal: LiteralIteration) -> dict[str, float]:
    """Relative differences of the data term, its gradients, and the loss at the same parameters and batch; nothing is stepped.

    Gradients of the data term, because the paper's λ1 = 100 would hide them under the sparsity's.
    """
    spots, counts = training.batch()
    results = []
    for terms_of in (
        lambda: training.criterion.terms(training.pipeline, spots, counts, training.steps),
        lambda: literal.terms(spots, counts),
    ):
        training.optimiser.zero_grad()
        terms = terms_of()
        terms["transient"].backward()
        results.append({"E_H": terms["transient"].detach(), "loss": terms["loss"].detach()} | gradients(training))
    ours, dense = results
    return {name: float((ours[name] - dense[name]).norm() / dense[name].norm()) for name in dense}


def compare(workload: Workload, repeats: int) -> dict[str, object]:
    """Seconds an iteration of both in turns, on the same batches; and of model=default, which has no literal counterpart."""
    capture = synthetic_capture(workload)
    paper, default = (Training(workload, capture, profile=profile) for profile in ("paper", "default"))
    setup, _ = seconds(paper.prepare), default.prepare()
    literal = LiteralIteration(paper)
    differences = agreement(paper, literal)
    times: dict[str, list[float]] = {"ours": [], "default": [], "literal": []}
    for turn in range(repeats + 1):
        batch = paper.batch()
        for name, step in (("ours", paper.step_on), ("default", default.step_on)):
            runs = [seconds(partial(step, *batch)) for _ in range(4)]
            times[name] += runs if turn else []
        if turn or repeats > 2:  # the first turn warms up; the literal one has warmed up in the agreement where it is slow
            took = seconds(partial(literal.step_on, *batch))
            times["literal"] += [took] if turn else []
    hits = len(paper.pipeline(paper.batch()[0]).surface.spot)
    found = {name: median(values) for name, values in times.items()}
    return {
        "name": workload.name, "spots": capture.n_spots, "bins": workload.bins, "voxels": paper.pipeline.phasor.grid.n_voxels,
        "planes": workload.planes, "batch": workload.batch, "rays": workload.rays**2, "frequencies": len(literal.omega),
        "rank": paper.plan.rank, "ffts": literal.ffts, "samples": workload.batch * workload.rays**2 * literal.n_samples,
        "setup_s": setup, "ours_s": found["ours"], "default_s": found["default"], "literal_s": found["literal"],
        "ratio": found["literal"] / found["ours"], "ratio_default": found["literal"] / found["default"],
        "hits": hits, "differences": differences, "repeats": repeats, "machine": machine(),
    }  # fmt: skip


def sizes() -> None:
    for workload in SIZES:
        if stored("ratio", workload.name) is None:
            row = compare(workload, REPEATS[workload.name])
            store("ratio", workload.name, row)
        print(stored("ratio", workload.name), flush=True)


def growth() -> None:
    for axis, cases in GROWTH.items():
        for value, workload in cases:
            name = f"{axis}={value}"
            if stored("ratio_growth", name) is None:
                store("ratio_growth", name, {"axis": axis, "value": value} | compare(replace(workload, name=name), 2))
            print(name, {k: v for k, v in stored("ratio_growth", name).items() if k.endswith("_s")}, flush=True)


def report() -> None:
    rows = []
    for r in (row for w in SIZES if (row := stored("ratio", w.name))):
        differences = dict(r["differences"])
        values = max(differences.pop("loss"), differences.pop("E_H"))
        worst = max(differences, key=differences.get)
        rows.append([
            r["name"], f"{r['spots']} × {r['bins']} → {r['voxels']}", f"{r['batch']} × {r['rays']}",
            f"{r['ffts']}, {r['samples'] / 1e6:.3g} M", f"{r['literal_s']:.3g} s", f"{1e3 * r['ours_s']:.3g} ms",
            f"{r['ratio']:.0f}",
            f"{1e3 * r['default_s']:.3g} ms", f"{r['ratio_default']:.0f}", f"{values:.1e}", f"{differences[worst]:.1e} ({worst})",
        ])  # fmt: skip
    head = ["size", "scan × bins → voxels", "spots × rays", "literal: FFTs, samples", "literal", "ours, model=paper", "ratio",
            "ours, model=default", "ratio", "loss and E_H differ by", "gradients of E_H by at most"]  # fmt: skip
    text = table(head, rows)
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


def main(arguments: list[str]) -> None:
    torch.set_num_threads(1)
    tasks = {"sizes": sizes, "growth": growth, "report": report}
    chosen = arguments or list(tasks)
    if not set(chosen) <= set(tasks):
        raise SystemExit(__doc__)
    for name in chosen:
        tasks[name]()


if __name__ == "__main__":
    main(sys.argv[1:])

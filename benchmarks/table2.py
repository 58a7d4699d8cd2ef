"""The ten configurations of the paper's Table 2, at full size, on a CPU: ``python benchmarks/table2.py``.

    python benchmarks/table2.py run [names=SU,Bunny] [threads=1] [seconds=900]
    python benchmarks/table2.py report        table and figure into docs/speed.md

Each configuration runs in a fresh process, so that its peak memory is its own, and to the paper's number of
iterations where they take less than ``seconds``; otherwise 12 iterations are measured, and the total is
projected and marked so. Rows are stored as they are done (benchmarks/results/speed/table2/).

Both the wall's clock and the process's own time are kept: with one thread the latter is what a core of its
own would take, whatever else the machine does. Erato and Indonesian have Dragon's sizes and NLOS has 44i's,
so their rows take these measurements with their own number of iterations.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time

import torch
from report import ROOT, store, stored, table, write_section
from timing import machine, median
from workload import TABLE_2, Training, Workload, synthetic_capture, tiny

from nlos_lit.runtime.memory import peak_bytes, resident_bytes
from nlos_lit.training.run_folder import run_bytes

SAME = {"Erato": "Dragon", "Indonesian": "Dragon", "NLOS": "44i"}
LEAST = 12  # iterations measured where the total is projected
GIB = 2**30


def measure(workload: Workload, allowed_s: float, device: str = "cpu") -> dict[str, object]:
    """One configuration from its capture to its last iteration (or the projection of it)."""
    capture = synthetic_capture(workload)
    before = resident_bytes()
    began, began_cpu = time.perf_counter(), time.process_time()
    training = Training(workload, capture, budget=16 * GIB, device=device)
    voxels = training.pipeline.phasor.grid.n_voxels
    estimate = before + run_bytes(training.plan, voxels, workload.batch * workload.rays**2)
    print(f"{workload.name}: {training.plan}; about {estimate / GIB:.1f} GiB in all", flush=True)
    training.prepare()
    setup, setup_cpu = time.perf_counter() - began, time.process_time() - began_cpu
    print(f"{workload.name}: set up in {setup:.0f} s", flush=True)
    losses, times, cpu = [], [], []
    while len(times) < workload.iterations:
        start, start_cpu = time.perf_counter(), time.process_time()
        losses.append(float(training.step()))
        times.append(time.perf_counter() - start)
        cpu.append(time.process_time() - start_cpu)
        left = median(times) * (workload.iterations - len(times))
        if len(times) >= LEAST and sum(times) + left > allowed_s:
            break
    complete = len(times) == workload.iterations
    peak = peak_bytes()
    hits = len(training.pipeline(training.batch()[0]).surface.spot) / (workload.batch * workload.rays**2)
    iteration, iteration_cpu = (sum(t[2:]) / len(t[2:]) if len(t) > 2 else median(t) for t in (times, cpu))
    return {
        "name": workload.name, "spots": list(workload.spots), "bins": workload.bins,
        "volume": list(training.pipeline.phasor.grid.shape),
        "frequencies": training.plan.n_frequencies, "rank": training.plan.rank,
        "precision": str(training.plan.precision),
        "setup_s": setup, "iteration_s": iteration, "iterations": workload.iterations,
        "measured_iterations": len(times),
        "complete": complete, "setup_cpu_s": setup_cpu, "iteration_cpu_s": iteration_cpu,
        "total_s": setup + (sum(times) if complete else iteration * workload.iterations),
        "estimate_bytes": estimate, "peak_bytes": peak, "hits": hits, "loss": [losses[0], losses[-1]],
        "paper_hours": workload.paper_hours, "machine": machine(),
    }  # fmt: skip


def run(names: list[str], threads: int, allowed_s: float) -> None:
    for name in names:
        if stored("table2", name) is None:
            command = [
                sys.executable,
                __file__,
                "one",
                f"names={name}",
                f"threads={threads}",
                f"seconds={allowed_s}",
            ]
            subprocess.run(command, check=True)
        print(json.dumps(stored("table2", name)), flush=True)


def one(name: str, allowed_s: float) -> None:
    # The capture is made by a process of its own: its memory would count.
    workload = next(w for w in TABLE_2 if w.name == name)
    store("table2", name, measure(workload, allowed_s))


def report() -> None:
    rows, minutes = [], {}
    for workload in TABLE_2:
        twin = SAME.get(workload.name)
        r = stored("table2", workload.name) or (stored("table2", twin) if twin else None)
        if r is None:
            rows.append([workload.name, "not measured yet", *[""] * 10])
            continue
        own = r["name"] == workload.name
        nz, nx, ny = r["volume"]
        sizes = f"{r['spots'][0]} × {r['spots'][1]} × {r['bins']} → {nx} × {ny} × {nz}"
        wall = r["total_s"] if own else r["setup_s"] + workload.iterations * r["iteration_s"]
        setup, iteration = r.get("setup_cpu_s", r["setup_s"]), r.get("iteration_cpu_s", r["iteration_s"])
        core = setup + workload.iterations * iteration
        minutes[workload.name] = (60 * workload.paper_hours, core / 60, wall / 60)
        how = "run to the end" if own and r["complete"] else f"projected from {r['measured_iterations']}"
        rows.append([
            workload.name, sizes, f"{setup:.0f} s", f"{iteration:.2f} s", str(workload.iterations),
            f"{core / 60:.1f} min", f"{wall / 60:.1f} min", how if own else f"{how}, as {r['name']}",
            f"{60 * workload.paper_hours:.0f} min", f"{3600 * workload.paper_hours / core:.0f}",
            f"{r['estimate_bytes'] / GIB:.2f} / {r['peak_bytes'] / GIB:.2f} GiB", f"{100 * r['hits']:.1f} %",
        ])  # fmt: skip
    head = ["scene", "scan × bins → volume", "set-up", "iteration", "iterations", "total",
            "on the wall's clock", "iterations run", "paper, A100", "paper / total",
            "memory: estimated / measured", "rays that meet a surface"]  # fmt: skip
    figure = "![time of all iterations](images/table2.png)"
    write_section("table2", table(head, rows) + ("\n\n" + figure if minutes else ""))
    if minutes:
        draw(minutes)


def draw(minutes: dict[str, tuple[float, float, float]]) -> None:
    """Bars of minutes by scene (paper; ours in the process's own time; ours on the wall's clock) into
    docs/images/table2.png.
    """
    from matplotlib.figure import Figure

    from nlos_lit.report.style import save_figure

    labels = ("paper, A100", "ours, one core's own time", "ours, on the wall's clock")
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.subplots()
    for k, (label, colour) in enumerate(zip(labels, ("#888888", "#0072B2", "#56B4E9"), strict=True)):
        places = [row + 0.27 * (k - 1) for row in range(len(minutes))]
        axes.barh(places, [m[k] for m in minutes.values()], height=0.25, label=label, color=colour)
    axes.set_yticks(range(len(minutes)), labels=list(minutes))
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="set-up and all iterations (min)")
    axes.set_xticks([1, 3, 10, 30, 100, 300], labels=["1", "3", "10", "30", "100", "300"])
    axes.tick_params(axis="x", which="minor", bottom=False)
    axes.grid(axis="x", alpha=0.3)
    figure.legend(loc="outside upper center", ncols=3, fontsize=8)
    save_figure(figure, ROOT / "docs" / "images" / "table2.png")


def main(arguments: list[str]) -> None:
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    torch.set_num_threads(int(given.get("threads", 1)))
    allowed = float(given.get("seconds", 900))
    names = given["names"].split(",") if "names" in given else [w.name for w in TABLE_2]
    what = next((a for a in arguments if "=" not in a), "run")
    if what == "run":
        run(names, torch.get_num_threads(), allowed)
        report()
    elif what == "one":
        one(names[0], allowed)
    elif what == "report":
        report()
    elif what == "tiny":
        print(json.dumps(measure(tiny(next(w for w in TABLE_2 if w.name == names[0])), allowed)))
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])

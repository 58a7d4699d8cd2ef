"""How set-up and iteration grow with spots, bins and voxels: ``python benchmarks/growth.py``.

    python benchmarks/growth.py run [threads=1]
    python benchmarks/growth.py report        table and figure into docs/speed.md

The wall, the scene and the volume's box stay the same; they are scanned, timed or divided more finely. Rows
are stored as they are done (benchmarks/results/speed/growth/).
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

from report import growth_figure, perform, slope, store, stored, table, write_section
from timing import machine, median, seconds
from workload import Training, Workload, synthetic_capture

BASE = Workload("base", (64, 64), 512, 1 / 64, 0.005, 0.6, 64, 0.00625, lateral=(64, 64), batch=16, rays=100)
AXES = {
    "spots": [(n * n, replace(BASE, spots=(n, n), pitch=1 / n, lateral=None)) for n in (32, 64, 128)],
    "bins": [(n, replace(BASE, bins=n, bin_length=2.56 / n)) for n in (128, 256, 512, 1024)],
    "voxels": [(64 * 64 * n, replace(BASE, planes=n, plane_pitch=0.4 / n)) for n in (32, 64, 128, 256)],
}


def measure(workload: Workload, repeats: int = 9) -> dict[str, object]:
    capture = synthetic_capture(workload)
    began = time.process_time()
    training = Training(workload, capture)
    training.prepare()
    setup = time.process_time() - began
    times = [seconds(training.step) for _ in range(repeats + 2)][2:]
    return {
        "setup_s": setup,
        "iteration_s": median(times),
        "frequencies": training.plan.n_frequencies,
        "rank": training.plan.rank,
        "machine": machine(),
    }


def run() -> None:
    measure(
        replace(BASE, spots=(16, 16), pitch=1 / 16, lateral=None, planes=8), 2
    )  # libraries load and warm up
    for axis, cases in AXES.items():
        for value, workload in cases:
            name = f"{axis}={value}"
            if stored("growth", name) is None:
                store("growth", name, {"axis": axis, "value": value} | measure(workload))
            print(name, stored("growth", name), flush=True)


def report() -> None:
    series, lines = {}, []
    for axis, cases in AXES.items():
        found = [r for value, _ in cases if (r := stored("growth", f"{axis}={value}"))]
        if len(found) < 2:
            continue
        x = [r["value"] for r in found]
        curves = {"set-up": [r["setup_s"] for r in found], "iteration": [r["iteration_s"] for r in found]}
        series[axis] = (x, curves)
        spans = [f"{y[0]:.2g} … {y[-1]:.2g} s" for y in curves.values()]
        lines.append([axis, f"{x[0]} … {x[-1]}", spans[0], f"{slope(x, curves['set-up']):.2f}", spans[1],
                      f"{slope(x, curves['iteration']):.2f}"])  # fmt: skip
    if series:
        growth_figure("growth", series, "seconds")
        text = table(["grows", "range", "set-up", "slope", "iteration", "slope"], lines)
        write_section("growth", text + "\n\n![growth of set-up and iteration](images/growth.png)")


if __name__ == "__main__":
    perform({"run": run, "report": report}, sys.argv[1:], __doc__)

"""Table 2 on one GPU, with torch, numpy and nothing else: ``python benchmarks/gpu.py``.

    python benchmarks/gpu.py                          the ten configurations, each to its last iteration
    python benchmarks/gpu.py names=Bunny              Bunny alone: 100 iterations, set-up included
    python benchmarks/gpu.py device=cpu sizes=tiny    the same path where there is no GPU

For each configuration: seconds of set-up, of an iteration and in all, the phasor product's bandwidth beside
that of a copy on the same card, memory, and how often an iteration waited for the device (it must not). What
the device's libraries take to load is timed before, by an iteration of a tiny workload: a process pays it
once. Rows go to benchmarks/results/speed/gpu/, a table is printed.
"""

from __future__ import annotations

import sys
import time
import warnings
from contextlib import contextmanager

import torch
from report import store, stored, table
from timing import copy_bandwidth, machine, median
from workload import TABLE_2, Training, Workload, synthetic_capture, tiny

from nlos_lit.runtime.memory import peak_bytes

GIB = 2**30
BETWEEN = 10  # iterations between looks at the capacity, as in training with logging


@contextmanager
def waits(device: torch.device):
    """Counts the host's waits for ``device`` while it is open, in the list it gives."""
    found: list[str] = []
    if device.type != "cuda":
        yield found
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            yield found
        finally:
            torch.cuda.set_sync_debug_mode("default")
            found += [str(w.message) for w in caught if "called a synchronizing" in str(w.message)]


def product_bandwidth(training: Training, repeats: int = 20) -> float:
    """Bytes a second of the phasor product's forward pass, the stored field counted once."""
    phasor = training.pipeline.phasor
    times = []
    with torch.no_grad():
        for _ in range(repeats):
            training.synchronise()
            began = time.perf_counter()
            phasor()
            training.synchronise()
            times.append(time.perf_counter() - began)
    return phasor.field.numel() * phasor.field.element_size() / median(times)


def load_libraries(device: torch.device) -> float:
    """Seconds until a tiny iteration was run for the first time in this process."""
    workload = tiny(TABLE_2[0])
    capture = synthetic_capture(workload)
    began = time.perf_counter()
    training = Training(workload, capture, device=device)
    training.prepare()
    training.step()
    training.synchronise()
    return time.perf_counter() - began


def measure(workload: Workload, device: torch.device) -> dict[str, object]:
    """One configuration from its capture to its last iteration, once libraries are loaded."""
    capture = synthetic_capture(workload)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    began = time.perf_counter()
    training = Training(workload, capture, budget=100 * GIB, device=device)
    print(f"{workload.name}: {training.plan}", flush=True)
    training.prepare()
    setup = time.perf_counter() - began
    times, lost, waited = [], 0, []
    for number in range(workload.iterations):
        if number and number % BETWEEN == 0:
            lost += training.pipeline.geometry.renew_capacity()
        start = time.perf_counter()
        if number == 5:  # once the libraries have made their workspaces
            with waits(device) as waited:
                training.step()
        else:
            training.step()
        if number % BETWEEN == BETWEEN - 1 or number == workload.iterations - 1:
            training.synchronise()
        times.append(time.perf_counter() - start)
    training.synchronise()
    total = time.perf_counter() - began
    memory = torch.cuda.max_memory_allocated(device) if device.type == "cuda" else peak_bytes()
    return {
        "name": workload.name, "volume": list(training.pipeline.phasor.grid.shape),
        "precision": str(training.plan.precision),
        "setup_s": setup, "iterations": workload.iterations,
        "iteration_s": (total - setup) / workload.iterations, "total_s": total,
        "product_bytes_per_s": product_bandwidth(training), "copy_bytes_per_s": copy_bandwidth(device),
        "memory_bytes": memory,
        "waits": len(waited), "first_wait": waited[0] if waited else None, "rays_lost": lost,
        "paper_hours": workload.paper_hours,
        "machine": machine(),
    }  # fmt: skip


def main(arguments: list[str]) -> None:
    given = dict(a.split("=", 1) for a in arguments)
    unknown = set(given) - {"device", "sizes", "names"}
    if unknown:
        raise SystemExit(f"unknown {', '.join(sorted(unknown))}\n{__doc__}")
    device = torch.device(given.get("device", "cuda"))
    if device.type == "cuda" and not torch.cuda.is_available():
        raise SystemExit("no CUDA device is at hand; device=cpu sizes=tiny runs the same path on a CPU")
    small = given.get("sizes", "full") == "tiny"
    names = given["names"].split(",") if "names" in given else [w.name for w in TABLE_2]
    print(f"libraries: {load_libraries(device):.1f} s", flush=True)
    rows = []
    for workload in TABLE_2:
        if workload.name in names:
            kind = f"gpu/{device.type}-{'tiny' if small else 'full'}"
            store(kind, workload.name, measure(tiny(workload) if small else workload, device))
            rows.append(stored(kind, workload.name))
    head = [
        "scene",
        "set-up",
        "iteration",
        "total",
        "paper, A100",
        "product / copy bandwidth",
        "memory",
        "waits an iteration",
    ]
    print(
        table(
            head,
            [
                [
                    r["name"], f"{r['setup_s']:.2f} s", f"{1e3 * r['iteration_s']:.2f} ms",
                    f"{r['total_s']:.1f} s",
                    f"{r['paper_hours']} h",
                    f"{r['product_bytes_per_s'] / 1e9:.0f} / {r['copy_bytes_per_s'] / 1e9:.0f} GB/s",
                    f"{r['memory_bytes'] / GIB:.1f} GiB", str(r["waits"]),
                ]
                for r in rows
            ],
        )
    )  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])

"""Kill every command at random moments, go on, and compare with what it leaves undisturbed.

``python tests/robust/kill_commands.py OUT.jsonl [seed=0] [share=1]`` adds a row a command. Each chain is up
to ``AGAIN`` kills (KILL, INT, TERM) of one piece of work, gone on with as a user would, and then left to its
end. Commands are forked from a process that has loaded the libraries: their loading is no part of the work.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from rows import add

sys.path.append(str(Path(__file__).resolve().parents[1]))

from forked import ROOT, run

AGAIN = 6
HANG = 300.0  # s, of work that takes some seconds
SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)
SCENE = [
    "scene.simulate.scan.nx=12", "scene.simulate.scan.ny=12", "scene.volume.depth=[0.4,0.95]",
    "scene.volume.depth_pitch=0.0192", "threads=1",
]  # fmt: skip
TRAIN = [
    *SCENE, "scene.iterations=12", "model.rays=40", "batch_spots=8", "heldout.block=3",
    "heldout.monitor_spots=16", "export.spots=16", "logger=none", "callbacks.checkpoint.every=2",
]  # fmt: skip
SURFACE = ["surfels.contest=10", "surfels.rounds=2", "surfels.steps=20", "surfels.more=0"]
CRITICISM = ["criticism.spots=36", "criticism.rivals=1", "criticism.most=1"]


@dataclass(frozen=True)
class Work:
    """One command: how it is begun or gone on with in a folder, and what it leaves that must be the same.

    Args:
        name: of the command.
        begin: script and arguments for a folder, whatever is in it.
        left: what two runs that are the same have in common.
        kills: how many.
    """

    name: str
    begin: Callable[[Path], list[str]]
    left: Callable[[Path], Any]
    kills: int


@dataclass
class Tally:
    """What came of one command's kills."""

    kills: dict[str, int] = field(default_factory=dict)
    chains: int = 0
    same: int = 0
    failures: list[str] = field(default_factory=list)


def train(folder: Path, more: tuple[str, ...] = ()) -> list[str]:
    if (folder / "overrides.json").exists():
        return ["train.py", f"resume={folder}"]
    return ["train.py", *TRAIN, *more, f"hydra.run.dir={folder}"]


def sweep(folder: Path) -> list[str]:
    """The whole sweep where it has not begun, then each of its runs that has not ended."""
    runs = sorted(path.parent for path in folder.glob("*/overrides.json"))
    unfinished = [run for run in runs if not (run / "summary.json").exists()]
    if unfinished:
        return ["train.py", f"resume={unfinished[0]}"]
    seeds = [seed for seed in (0, 1) if not (folder / f"seed{seed}" / "summary.json").exists()]
    return [
        "train.py", "-m", *TRAIN, f"seed={','.join(map(str, seeds or (0, 1)))}", f"hydra.sweep.dir={folder}",
        "hydra.sweep.subdir=seed${seed}",
    ]  # fmt: skip


def numbers(file: Path) -> Any:
    """A result's numbers, without what depends on the machine."""
    kept = json.loads(file.read_text())
    for name in ("seconds", "peak_memory_bytes", "estimated_memory_bytes", "git", "versions"):
        kept.pop(name, None)
    return kept


def arrays(file: Path) -> dict[str, np.ndarray]:
    with h5py.File(file) as held:
        found: dict[str, np.ndarray] = {}
        held.visititems(lambda name, item: found.update({name: item[()]}) if hasattr(item, "shape") else None)
    return found


def of_train(folder: Path) -> Any:
    kept = numbers(folder / "summary.json")
    torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    refined = kept.pop("refined")
    names = ("loss", "heldout", "parameters", "iterations", "transient_mse")
    surface = {}
    if refined is not None:
        surface = torch.load(folder / "refined" / "surfels.pt", weights_only=True) | refined["heldout"]
    return {name: kept[name] for name in names} | surface | arrays(folder / "volume.h5")


def of_diagnosis(folder: Path) -> Any:
    assert not (folder / "diagnosis" / "steps").exists()
    return numbers(folder / "diagnosis" / "diagnosis.json")


def of_results(folder: Path) -> Any:
    found = {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.glob("table1/*.md"))}
    assert found, "no table"
    return found


def of_capture(folder: Path) -> Any:
    both = arrays(folder / "a.hdf5") | {f"truth/{k}": v for k, v in arrays(folder / "a_truth.h5").items()}
    return {name: value for name, value in both.items() if name != "scene_info"}


def results(folder: Path) -> list[str]:
    return ["results.py", "table1", "size=reduced", f"out={folder}", f"docs={folder}/page.md"]


WORKS = (
    Work("train", train, of_train, 80),
    Work("train with refinement", lambda f: train(f, ("refine=true", *SURFACE)), of_train, 60),
    Work("sweep", sweep, lambda f: [of_train(f / f"seed{seed}") for seed in (0, 1)], 40),
    Work(
        "diagnose",
        lambda f: ["diagnose.py", *SCENE, *SURFACE, *CRITICISM, f"hydra.run.dir={f}"],
        of_diagnosis,
        50,
    ),
    Work(
        "reconstruct",
        lambda f: ["reconstruct.py", *SCENE[:-1], "scene.volume.upsample=4", f"hydra.run.dir={f}"],
        lambda f: arrays(f / "volume.h5"),
        60,
    ),
    Work(
        "simulate",
        lambda f: ["simulate.py", "nx=24", "ny=24", f"out={f}/a.hdf5", "overwrite=true"],
        of_capture,
        60,
    ),
    Work("results", results, of_results, 50),
)  # fmt: skip


def attempt(arguments: list[str], output: Path, wait: float, how: signal.Signals | None) -> tuple[int, bool]:
    """Run a command; the status it ended with, and whether a signal was sent."""
    process = multiprocessing.get_context("fork").Process(target=run, args=(arguments, output, output))
    process.start()
    process.join(wait)
    sent = process.is_alive() and how is not None
    if sent:
        os.kill(process.pid, how)
        process.join(HANG)
    if process.is_alive():
        process.kill()
        process.join()
        return 124, sent
    return process.exitcode or 0, sent


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[name], other[name]) for name in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    return bool(one == other) or (one != one and other != other)


def kill(work: Work, kills: int, rng: np.random.Generator) -> Tally:
    """Kill one command ``kills`` times."""
    tally = Tally()
    place = Path(tempfile.mkdtemp(prefix="killed-"))
    output = place / "output"
    whole = place / "whole"
    whole.mkdir()
    start = time.monotonic()
    steps = 0
    while not finished(work, whole) and steps < 3:
        status, _ = attempt(work.begin(whole), output, HANG, None)
        steps += 1
        if status:
            tally.failures.append(f"undisturbed, status {status}: {last_line(output)}")
            return tally
    took = time.monotonic() - start
    expected = work.left(whole)
    number = 0
    while number < kills:
        folder = place / f"chain{tally.chains}"
        folder.mkdir()
        told = []
        left = took  # at most: what a killed command has done is not done again
        for _ in range(AGAIN):
            if finished(work, folder):
                break
            how = SIGNALS[int(rng.integers(len(SIGNALS)))]
            status, sent = attempt(work.begin(folder), output, float(rng.uniform(0, left)), how)
            left *= 0.7
            if sent:
                number += 1
                tally.kills[how.name] = tally.kills.get(how.name, 0) + 1
            told.append(f"{how.name if sent else 'none'} {status}")
            text = output.read_text(errors="replace")
            if "Traceback" in text or status == 124 or (status == 2 and not sent):
                tally.failures.append(f"{', '.join(told)}: {last_line(output)}")
                keep(output, work, tally)
        for _ in range(4):
            if finished(work, folder):
                break
            status, _ = attempt(work.begin(folder), output, HANG, None)
            told.append(f"left alone {status}")
            if status:
                tally.failures.append(f"{', '.join(told)}: {last_line(output)}")
                keep(output, work, tally)
                break
        tally.chains += 1
        try:
            alike = same(expected, work.left(folder))
        except Exception as error:
            alike = False
            tally.failures.append(f"{', '.join(told)}: {type(error).__name__} {error}")
        tally.same += alike
        if alike:
            shutil.rmtree(folder)
        else:
            tally.failures.append(f"{', '.join(told)}: not the same, kept in {folder}")
    return tally


def keep(output: Path, work: Work, tally: Tally) -> None:
    shutil.copy(output, output.with_name(f"failure_{work.name}_{len(tally.failures)}.txt".replace(" ", "_")))


def finished(work: Work, folder: Path) -> bool:
    """Whether the work in a folder is done."""
    try:
        work.left(folder)
    except (OSError, KeyError, AssertionError, json.JSONDecodeError):
        return False
    return True


def last_line(output: Path) -> str:
    lines = [line for line in output.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1][:300] if lines else "nothing said"


def main(arguments: list[str]) -> None:
    given = dict(argument.split("=", 1) for argument in arguments[1:])
    seed, share = int(given.get("seed", 0)), float(given.get("share", 1))
    works = [work for work in WORKS if work.name in given.get("only", work.name).split(",")]
    os.chdir(ROOT)
    torch.set_num_threads(1)
    multiprocessing.set_start_method("fork")
    import lightning  # noqa: F401  # loaded once, for all
    import open3d  # noqa: F401

    import nlos_lit.commands.diagnose
    import nlos_lit.commands.reconstruct
    import nlos_lit.commands.results
    import nlos_lit.commands.simulate
    import nlos_lit.commands.train  # noqa: F401

    for index, work in enumerate(works):
        began = time.monotonic()
        tally = kill(work, math.ceil(share * work.kills), np.random.default_rng([seed, index]))
        row = {
            "part": "kills", "kind": work.name, "seed": seed, "kills": sum(tally.kills.values()),
            "by": tally.kills, "chains": tally.chains, "same": tally.same, "failures": tally.failures,
            "seconds": round(time.monotonic() - began),
        }  # fmt: skip
        add(arguments[0], row)


if __name__ == "__main__":
    main(sys.argv[1:])

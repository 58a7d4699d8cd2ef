"""Commands whose disk is too small, or is filled by another while they work.

``python tests/robust/full_disks.py OUT.jsonl [seed=0] [only=train,diagnose]`` adds a row a command. It mounts
small tmpfs, which needs root.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np
import torch
from kill_commands import CRITICISM, HANG, SCENE, SURFACE, TRAIN, last_line, run
from rows import add

WORDS = ("No space left on device", "MiB free; make room")
LOGGED = [item for item in TRAIN if not item.startswith("logger=")]
COMMANDS = {
    "train": lambda f: ["train.py", *TRAIN, f"hydra.run.dir={f}/run"],
    "train, TensorBoard": lambda f: ["train.py", *LOGGED, f"hydra.run.dir={f}/run"],
    "train with refinement": lambda f: [
        "train.py",
        *TRAIN,
        "refine=true",
        *SURFACE,
        f"hydra.run.dir={f}/run",
    ],
    "diagnose": lambda f: ["diagnose.py", *SCENE, *SURFACE, *CRITICISM, f"hydra.run.dir={f}/run"],
    "reconstruct": lambda f: ["reconstruct.py", *SCENE[:-1], f"hydra.run.dir={f}/run"],
    "simulate": lambda f: ["simulate.py", "nx=24", "ny=24", f"out={f}/a.hdf5"],
}
SIZES = (64, 256)  # KiB, of disks that are too small from the beginning
MOMENTS = 2  # at which a large disk is filled, of each command


def whole(folder: Path) -> list[str]:
    """Files under their final names that are not whole."""
    broken = []
    for file in folder.rglob("*"):
        try:
            if file.suffix in (".h5", ".hdf5"):
                h5py.File(file).close()
            elif file.suffix in (".ckpt", ".pt"):
                torch.load(file, weights_only=True)
            elif file.suffix == ".json":
                json.loads(file.read_text())
            elif file.name.startswith(".") and file.name not in (".lock", ".hydra"):
                raise ValueError("a hidden file is left")
        except Exception as error:
            broken.append(f"{file.relative_to(folder)}: {error}")
    return broken


def attempt(name: str, place: Path, size: int, wait: float | None) -> tuple[str, str]:
    """Run a command on a disk of ``size`` KiB, filled after ``wait`` seconds: what came, what it said."""
    disk = place / "disk"
    disk.mkdir(exist_ok=True)
    output = place / "output"
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", str(disk)], check=True)
    try:
        words = COMMANDS[name](disk)
        process = multiprocessing.get_context("fork").Process(target=run, args=(words, output, output))
        process.start()
        process.join(HANG if wait is None else wait)
        if process.is_alive():
            with (disk / "filler").open("wb", buffering=0) as filler:
                try:
                    while True:
                        filler.write(bytes(1 << 16))
                except OSError:
                    pass
            process.join(HANG)
        if process.is_alive():
            process.kill()
            process.join()
            return "failed", "it hung"
        text = output.read_text(errors="replace")
        said = last_line(output)
        broken = whole(disk)
        if "Traceback" in text or broken or process.exitcode not in (0, 2):
            return "failed", f"status {process.exitcode}, {broken}: {said}\n{text[-3000:]}"
        if process.exitcode == 2:
            told = any(words in said for words in WORDS)
            return ("refused" if told else "failed"), said
        return "done", said
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)


def main(arguments: list[str]) -> None:
    given = dict(argument.split("=", 1) for argument in arguments[1:])
    rng = np.random.default_rng(int(given.get("seed", 0)))
    torch.set_num_threads(1)
    os.chdir(Path(__file__).resolve().parents[2])
    place = Path(tempfile.mkdtemp(prefix="full-"))
    for name in given["only"].split(",") if "only" in given else COMMANDS:
        came: dict[str, int] = {"refused": 0, "done": 0, "failed": 0}
        failures = []
        began = time.monotonic()
        attempt(name, place, 1 << 16, None)
        took = time.monotonic() - began
        points = [(size, None) for size in SIZES]
        points += [(1 << 16, float(rng.uniform(0, took))) for _ in range(MOMENTS)]
        for size, wait in points:
            how, said = attempt(name, place, size, wait)
            came[how] += 1
            print(f"{how} {name} {size} KiB, filled after {wait}: {said}", flush=True)
            if how == "failed":
                failures.append(f"{name}, {size} KiB, filled after {wait}: {said[:300]}")
        row = {"part": "disks", "kind": name, "tried": sum(came.values()), **came, "failures": failures}
        add(arguments[0], row)


if __name__ == "__main__":
    main(sys.argv[1:])

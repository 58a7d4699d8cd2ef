"""Fuzz one format's reader, guided by the coverage of its code where atheris is installed.

``python tests/robust/fuzz_readers.py OUT.jsonl format=ytal [seed=0] [runs=100000] [seconds=3600]`` adds a
row; what fails is left in ``OUT.failures/`` and becomes, once mended, a file of ``corpus/FORMAT/``. Without
atheris the bytes are drawn at random.
"""

from __future__ import annotations

import hashlib
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

import numpy as np
from rows import add

try:
    import atheris
except ImportError:
    atheris = None

MEMORY = 3 * 2**30  # bytes of address space
CORPUS = Path(__file__).parent / "corpus"


class Fuzz:
    """Counts what came of inputs."""

    def __init__(self, out: Path, fmt: str, seed: int, runs: int, seconds: float) -> None:
        self.out, self.fmt, self.seed, self.runs, self.seconds = out, fmt, seed, runs, seconds
        self.came = {"read": 0, "refused": 0}
        self.failures: dict[str, str] = {}
        self.number, self.slowest, self.began = 0, 0.0, time.monotonic()
        self.folder = Path(tempfile.mkdtemp(dir="/dev/shm" if os.path.isdir("/dev/shm") else None))
        files.beside(fmt, self.folder)

    def one(self, data: bytes) -> None:
        began = time.monotonic()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                self.came[files.outcome(self.fmt, data, self.folder)] += 1
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            told = f"{type(error).__name__} {where.name}:{where.lineno} {str(error)[:160]}"
            if told not in self.failures and len(self.failures) < 50:
                kept = self.out.with_suffix(".failures") / self.fmt
                kept.mkdir(parents=True, exist_ok=True)
                (kept / hashlib.sha256(data).hexdigest()[:12]).write_bytes(data)
                self.failures[told] = traceback.format_exc()
                print(self.failures[told], file=sys.stderr, flush=True)
        self.slowest = max(self.slowest, time.monotonic() - began)
        self.number += 1
        if self.number == self.runs or time.monotonic() - self.began > self.seconds:
            self.write()
            shutil.rmtree(self.folder)
            os._exit(0)  # libFuzzer does not return either

    def write(self) -> None:
        row = {
            "part": "readers", "format": self.fmt, "guided": atheris is not None, "seed": self.seed,
            "tried": self.number, **self.came, "failures": list(self.failures),
            "slowest_s": round(self.slowest, 2), "seconds": round(time.monotonic() - self.began),
        }  # fmt: skip
        add(self.out, row)


def main(arguments: list[str]) -> None:
    given = dict(argument.split("=", 1) for argument in arguments[1:])
    fmt, seed, runs = given["format"], int(given.get("seed", 0)), int(given.get("runs", 100_000))
    seconds = float(given.get("seconds", 3600))
    files.seeds(fmt)  # MATLAB's and HDF5's libraries are loaded by now
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    fuzz = Fuzz(Path(arguments[0]), fmt, seed, runs, seconds)
    if atheris is None:
        rng = np.random.default_rng(seed)
        while True:
            fuzz.one(rng.bytes(int(rng.integers(6, 80))))
    held = fuzz.folder / "inputs"
    held.mkdir()
    for index in range(len(files.seeds(fmt))):
        (held / str(index)).write_bytes(index.to_bytes(3) if len(files.seeds(fmt)) > 256 else bytes([index]))
    options = [f"-runs={runs}", f"-seed={seed + 1}", "-max_len=80", "-rss_limit_mb=0", "-verbosity=0"]
    atheris.Setup([sys.argv[0], *options, str(held)], fuzz.one)
    atheris.Fuzz()


if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[1] / "readers"), str(Path(__file__).parents[2])]
    if atheris is None:
        import fuzzed_files as files
    else:
        with atheris.instrument_imports(include=["data_modules", "nlos_lit"]):
            import fuzzed_files as files
    main(sys.argv[1:])

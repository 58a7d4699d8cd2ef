"""Commands in processes of their own, forked from one that has loaded the libraries and done nothing else.

Loading them takes longer than most of what tests ask of a command.
"""

from __future__ import annotations

import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = ("train", "diagnose", "reconstruct", "results", "simulate")
LOADED = [
    *(f"nlos_lit.commands.{name}" for name in COMMANDS),
    *("open3d", "matplotlib.backends.backend_agg", "torch.utils.tensorboard"),
]


def run(arguments: list[str], out: Path, err: Path) -> None:
    """A command in this process, which ends with it.

    Args:
        arguments: its script and what stands behind it.
        out: file for what it prints; replaced.
        err: file for its errors, which may be the same.
    """
    os.setsid()
    for stream, place in ((1, out), (2, err)):
        place.write_bytes(b"")
        with place.open("ab") as file:
            os.dup2(file.fileno(), stream)
    sys.stdout, sys.stderr = (open(n, "w", buffering=1, closefd=False) for n in (1, 2))  # noqa: SIM115
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.chdir(ROOT)
    sys.argv = list(arguments)
    sys.path.insert(0, str(ROOT))
    try:
        runpy.run_path(str(ROOT / arguments[0]), run_name="__main__")
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException as error:
        sys.excepthook(type(error), error, error.__traceback__)
        status = 130 if isinstance(error, KeyboardInterrupt) else 1
    else:
        status = 0
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def command(*arguments: str, seconds: float = 500) -> subprocess.CompletedProcess:
    """What ``python`` with these arguments does and says.

    Args:
        arguments: script of a command, and what stands behind it.
        seconds: after which it has hung.

    Returns:
        As `subprocess.run` of the same.
    """
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(LOADED)
    with tempfile.TemporaryDirectory() as folder:
        out, err = Path(folder, "out"), Path(folder, "err")
        process = server.Process(target=run, args=(list(arguments), out, err))
        process.start()
        try:
            process.join(seconds)
            if process.is_alive():
                raise subprocess.TimeoutExpired(arguments, seconds, out.read_bytes(), err.read_bytes())
        finally:
            process.kill()
            process.join()
        said = (place.read_text(errors="replace") for place in (out, err))
        return subprocess.CompletedProcess(arguments, process.exitcode, *said)

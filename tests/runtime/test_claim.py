"""A folder belongs to one process, until that ends."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

from nlos_lit.capture.errors import UserError
from nlos_lit.runtime.claim import claim

HOLD = """
import sys
from pathlib import Path
from nlos_lit.runtime.claim import claim
claim(Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.read()
"""


def test_a_second_process_is_refused_until_the_first_is_killed(tmp_path):
    folder = tmp_path / "run"
    first = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    with first:
        assert first.stdout.readline() == "held\n"
        with pytest.raises(UserError, match=f"another process is at work in {folder}; wait until"):
            claim(folder)
        first.send_signal(signal.SIGKILL)
        first.wait(timeout=20)
    claim(folder)
    claim(Path(f"{folder}/../run"))  # it is ours: as often as we like

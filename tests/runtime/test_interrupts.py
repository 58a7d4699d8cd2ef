"""Ctrl-C is never lost, and never a traceback."""

import subprocess
import sys

import pytest
from conftest import ROOT

BEGIN = """
import os, signal, time
from nlos_lit.runtime.interrupts import take_interrupts

take_interrupts()
"""
PLACES = {
    "anywhere": "os.kill(os.getpid(), signal.SIGINT)\ntime.sleep(5)\n",
    "in a destructor": """
class Heavy:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0)

Heavy()
time.sleep(5)
""",
}


@pytest.mark.parametrize("place", PLACES)
def test_ctrl_c_ends_a_command_in_a_word(place):
    code = f"{BEGIN}signal.signal(signal.SIGINT, signal.default_int_handler)\n{PLACES[place]}print('went on')"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("", "interrupted\n")
    assert done.returncode in (-2, 130)

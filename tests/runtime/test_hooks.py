"""Ctrl-C is never lost and never a traceback, and a full disk is told of once."""

import subprocess
import sys

import pytest
from conftest import ROOT

BEGIN = """
import os, signal, time
from nlos_lit.runtime.hooks import take_hooks

take_hooks()
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


FULL = """
import errno, logging, threading

class Full(logging.StreamHandler):
    def emit(self, record):
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError:
            self.handleError(record)

def write():
    raise OSError(errno.ENOSPC, "No space left on device")

logging.basicConfig(handlers=[Full()])
logging.warning("lost")
for target in (write, lambda: 1 / 0):
    thread = threading.Thread(target=target)
    thread.start()
    thread.join()
"""


def test_threads_and_log_handlers_say_nothing_of_a_full_disk():
    done = subprocess.run(
        [sys.executable, "-c", BEGIN + FULL], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0
    assert "No space left" not in done.stderr
    assert "ZeroDivisionError" in done.stderr, "other errors are told"

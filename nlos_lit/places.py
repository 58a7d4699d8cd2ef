"""Where the project's own files lie: in a checkout, or where it was installed."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent

ABOVE = _PACKAGE.parent  # the checkout, or what the project was installed into
INSTALLED = (_PACKAGE / "conf").is_dir()
CONF = (_PACKAGE if INSTALLED else ABOVE) / "conf"  # Hydra's configs
HOME = Path.cwd() if INSTALLED else ABOVE  # above data/, docs/ and outputs/ of the paper's evaluation
STARTED = "NLOS_COMMAND"  # in the environment: the command, for further processes of a run

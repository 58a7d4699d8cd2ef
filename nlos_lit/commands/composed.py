"""Commands whose config Hydra puts together, from ``conf/`` wherever that lies."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import hydra
from hydra._internal import utils
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from nlos_lit.capture.errors import UserError
from nlos_lit.commands.plan import plan
from nlos_lit.places import CONF
from nlos_lit.runtime.arguments import begun
from nlos_lit.runtime.command_line import sentence_errors


def compose_and_run(
    name: str,
    prepare: Callable[[list[str]], None],
    task: Callable[[DictConfig], Any],
    arguments: list[str],
) -> int:
    """Compose a command's config, plan what it leaves to the data, and run it.

    Args:
        name: of the command and its config.
        prepare: changes the command line, the program's name first, before Hydra reads it.
        task: what the command does; what it returns a sweep can optimise.
        arguments: as on the command line. They are put there: Hydra reads them there, and so do the processes
            that Lightning starts.

    Returns:
        The exit status.
    """
    sys.argv[1:] = arguments
    prepare(sys.argv)

    @sentence_errors
    def run(config: DictConfig) -> Any:
        with begun(name, config):
            plan(config)
            return task(config)

    with hydra_in_sentences():
        hydra.main(version_base="1.3", config_path=str(CONF), config_name=name)(run)()
    return 0


@contextmanager
def hydra_in_sentences() -> Iterator[None]:
    """What the disk refuses to Hydra itself, which writes a config and a log before the command begins.

    So is a setting that does not fit the others.
    """
    report = utils.run_and_report

    def told(func: Callable[[], Any]) -> Any:
        try:
            return func()
        except (HydraException, OmegaConfBaseException) as error:
            said = " ".join(str(error).split())
            raise UserError(f"the config cannot be put together: {said}") from error
        except ValueError as error:  # logging's word for a file that it cannot open
            if isinstance(error.__cause__, OSError):
                raise error.__cause__ from None
            raise

    utils.run_and_report = lambda func: report(lambda: sentence_errors(told)(func))
    try:
        yield
    finally:
        utils.run_and_report = report

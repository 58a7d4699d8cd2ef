"""Say what the simulation gets wrong about a capture: ``python diagnose.py scene=su``.

``python diagnose.py run=FOLDER`` diagnoses the image of a finished run.
"""

import sys

import hydra
from omegaconf import DictConfig

from nlos_lit.commands.diagnose import diagnose, prepare
from nlos_lit.runtime.command_line import sentence_errors


@hydra.main(version_base="1.3", config_path="conf", config_name="diagnose")
@sentence_errors
def main(config: DictConfig) -> None:
    """Open the command."""
    diagnose(config)


if __name__ == "__main__":
    prepare(sys.argv)
    main()

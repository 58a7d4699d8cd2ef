"""Say what the simulation gets wrong about a capture: ``python diagnose.py scene=su``.

``python diagnose.py run=FOLDER`` diagnoses the image of a finished run.
"""

import sys

import hydra
from omegaconf import DictConfig

from nlos_lit.runtime.arguments import begun, look_over
from nlos_lit.runtime.command_line import sentence_errors


@hydra.main(version_base="1.3", config_path="conf", config_name="diagnose")
@sentence_errors
def main(config: DictConfig) -> None:
    """Open the command."""
    with begun("diagnose", config):
        from nlos_lit.commands.diagnose import diagnose
        from nlos_lit.commands.plan import plan

        plan(config)
        diagnose(config)


if __name__ == "__main__":
    look_over("diagnose", sys.argv, __doc__)
    from nlos_lit.commands.diagnose import prepare  # after that: it loads torch

    prepare(sys.argv)
    main()

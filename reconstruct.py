"""Classical baselines in the project's frame: ``python reconstruct.py scene=su method=lct``."""

import sys

import hydra
from omegaconf import DictConfig

from nlos_lit.runtime.arguments import begun, look_over
from nlos_lit.runtime.command_line import sentence_errors


@hydra.main(version_base="1.3", config_path="conf", config_name="reconstruct")
@sentence_errors
def main(config: DictConfig) -> None:
    """Open the command."""
    with begun("reconstruct", config):
        from nlos_lit.commands.plan import plan
        from nlos_lit.commands.reconstruct import reconstruct

        plan(config)
        reconstruct(config)


if __name__ == "__main__":
    look_over("reconstruct", sys.argv, __doc__)
    from nlos_lit.commands.reconstruct import prepare  # after that: it loads torch

    prepare(sys.argv)
    main()

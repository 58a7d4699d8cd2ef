"""Reconstruct a hidden scene by self-calibration: ``python train.py scene=su``."""

import sys

import hydra
from omegaconf import DictConfig

from nlos_lit.runtime.arguments import begun, look_over
from nlos_lit.runtime.command_line import sentence_errors


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
@sentence_errors
def main(config: DictConfig) -> None:
    """Open the command."""
    with begun("train", config):
        from nlos_lit.commands.plan import plan
        from nlos_lit.commands.train import train

        plan(config)
        train(config)


if __name__ == "__main__":
    look_over("train", sys.argv, __doc__)
    from nlos_lit.commands.train import prepare  # after that: it loads torch

    prepare(sys.argv)
    main()

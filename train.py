"""Reconstruct a hidden scene by self-calibration: ``python train.py scene=su``."""

import sys

import hydra
from omegaconf import DictConfig

from nlos_lit.commands.train import prepare, train
from nlos_lit.runtime.command_line import sentence_errors


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
@sentence_errors
def main(config: DictConfig) -> None:
    """Open the command."""
    train(config)


if __name__ == "__main__":
    prepare(sys.argv)
    main()

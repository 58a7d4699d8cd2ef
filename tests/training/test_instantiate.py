"""What a config may build: listed classes with arguments that they have; nothing else is ever called."""

from __future__ import annotations

import lightning as L
import pytest
import torch
from lightning.pytorch.loggers import CSVLogger, Logger
from omegaconf import OmegaConf

from nlos_lit.capture.errors import UserError
from nlos_lit.training.configs import compose
from nlos_lit.training.instantiate import build_all, builder
from nlos_lit.training.run_folder import prepare_run

TRAINER = {"_target_": "lightning.pytorch.Trainer", "accelerator": "cpu", "logger": False}


def test_a_class_waits_for_what_only_the_run_knows(tmp_path):
    config = {"_target_": "torch.optim.Adam", "betas": [0.8, 0.9]}
    weight = torch.nn.Parameter(torch.ones(2))
    made = builder(config, torch.optim.Optimizer, "optimizer")([{"params": [weight], "lr": 0.3}])
    assert type(made) is torch.optim.Adam
    assert made.param_groups[0]["params"][0] is weight
    assert (made.param_groups[0]["lr"], made.param_groups[0]["betas"]) == (0.3, (0.8, 0.9))
    named = {"a": {"_target_": "lightning.pytorch.loggers.CSVLogger", "save_dir": str(tmp_path)}, "b": None}
    (logger,) = build_all(named, Logger, "logger")
    assert type(logger) is CSVLogger


def test_parts_of_a_trainer_may_be_named_too():
    strategy = {"_target_": "lightning.pytorch.strategies.SingleDeviceStrategy", "device": "cpu"}
    trainer = builder({**TRAINER, "accelerator": "auto", "strategy": strategy}, L.Trainer, "trainer")()
    assert type(trainer.strategy).__name__ == "SingleDeviceStrategy"


def harm(target: str, file) -> dict:
    return {"_target_": target, "_args_": [f"touch {file}"]}


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "subprocess.Popen",
        "builtins.eval",
        "nlos_lit.training.summary.subprocess.Popen",  # a listed module, somebody else's class
        "nlos_lit.paper.workspace.run_training",  # no class
        "lightning.pytorch.cli.LightningCLI",  # a listed class of another kind
        "lightning_evil.Callback",
        "lightning..Callback",
        "torch.optim",
        "torch.nn.Module",
        3,
        None,
    ],
)
@pytest.mark.parametrize("place", ["itself", "argument", "list", "dict"])
def test_nothing_else_is_called(target, place, tmp_path):
    file = tmp_path / "touched"
    evil = harm(target, file)
    config = {
        "itself": evil,
        "argument": {**TRAINER, "strategy": evil},
        "list": {**TRAINER, "plugins": [evil]},
        "dict": {**TRAINER, "max_time": {"days": [{"more": evil}]}},
    }[place]
    with pytest.raises(UserError, match=r"_target_=.* is not built: it must be a class"):
        builder(config, L.Trainer, "trainer")
    assert not file.exists()


@pytest.mark.parametrize("key", ["_args_", "_partial_", "_recursive_", "_target"])
def test_other_words_of_hydra_are_refused(key):
    with pytest.raises(UserError, match=f"trainer.{key} is not allowed"):
        builder({**TRAINER, key: False}, L.Trainer, "trainer")
    with pytest.raises(UserError, match=r"trainer.strategy(.\w+)? (is not allowed|must name a class)"):
        builder({**TRAINER, "strategy": {key: []}}, L.Trainer, "trainer")


def test_interpolations_are_looked_at_where_they_lead():
    config = OmegaConf.create({"x": "os.system", "trainer": {"_target_": "${x}"}})
    resolved = OmegaConf.to_container(config, resolve=True)
    with pytest.raises(UserError, match=r"trainer._target_=os.system is not built"):
        builder(resolved["trainer"], L.Trainer, "trainer")
    late = {**TRAINER, "plugins": ["${oc.create:{_target_: os.system, _args_: [ls]}}"]}
    with pytest.raises(UserError, match=r"trainer.plugins\[0\] must not hold an interpolation"):
        builder(late, L.Trainer, "trainer")
    with pytest.raises(UserError, match="is not built"):
        builder({"_target_": "${oc.env:HOME}"}, L.Trainer, "trainer")


def test_a_config_that_names_no_class_is_refused():
    with pytest.raises(UserError, match=r"logger.csv must name a class as _target_; found 'yes'"):
        build_all({"csv": "yes"}, Logger, "logger")


def test_a_foreign_run_folder_runs_nothing(tmp_path):
    small = ["scene.simulate.scan.nx=6", "scene.simulate.scan.ny=6", "heldout.block=2", "model.rays=8"]
    config = compose("train", small)
    config["optimizer"]["method"] = harm("os.system", tmp_path / "touched")
    with pytest.raises(UserError, match=r"optimizer.method._target_=os.system is not built"):
        prepare_run(config)
    assert not (tmp_path / "touched").exists()
    config = compose("train", [*small, "~optimizer.rates.sensor"])
    with pytest.raises(
        UserError, match=r"optimizer.rates must give one rate for each of phasor, sensor, albedo"
    ):
        prepare_run(config).module.configure_optimizers()

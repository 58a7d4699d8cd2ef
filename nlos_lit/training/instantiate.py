"""Objects that a config names by ``_target_``: built where their class is on a short list, refused otherwise.

A config can be somebody else's file (``config.yaml`` of a run folder). What it names is therefore neither
imported nor called before its name, its class and its arguments have been looked at.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import lightning as L
from hydra.utils import get_class, instantiate
from lightning.pytorch.accelerators import Accelerator
from lightning.pytorch.loggers import Logger
from lightning.pytorch.plugins import CheckpointIO, ClusterEnvironment, Precision
from lightning.pytorch.profilers import Profiler
from lightning.pytorch.strategies import Strategy

from nlos_lit.capture.errors import UserError

PACKAGES = ("lightning", "nlos_lit", "torch.optim")
PARTS = (L.Callback, Logger, Strategy, Accelerator, Precision, ClusterEnvironment, CheckpointIO, Profiler)
OWN_KEYS = (
    "_target_",
    "_convert_",
)  # of Hydra; others could call something else than the class, or otherwise
T = TypeVar("T")


def builder(config: Mapping[str, Any], kind: type[T], where: str) -> Callable[..., T]:
    """The class that a config names, with the arguments it gives; call it with those that only the run knows.

    Args:
        config: resolved: ``_target_``, the dotted name of a class, and its arguments; further nodes with a
            ``_target_`` may stand among these (a strategy, a profiler).
        kind: what the class must be.
        where: the config's place, for error messages.

    Returns:
        A callable that makes the object, its nodes included.

    Raises:
        UserError: a class outside ``PACKAGES`` or of another kind, at any depth, or an argument that it does
            not have. Nothing has been called then.
    """
    check(config, where, (kind,))
    return instantiate(dict(config), _partial_=True, _convert_="all")


def build_all(configs: Mapping[str, Any], kind: type, where: str) -> list[Any]:
    """The objects of a group by name, in order; a name set to null is left out.

    Args:
        configs: name → config as :func:`builder` takes it, or None.
        kind: what every object must be.
        where: the group's place, for error messages.

    Returns:
        One object a name that is not null.

    Raises:
        UserError: as :func:`builder`.
    """
    named = {name: config for name, config in configs.items() if config is not None}
    return [builder(config, kind, f"{where}.{name}")() for name, config in named.items()]


def check(config: Any, where: str, kinds: tuple[type, ...]) -> None:
    """See that a config can run nothing but the listed classes, at any depth, with arguments that they have.

    Args:
        config: resolved, plain containers.
        where: its place, for error messages.
        kinds: what its class must be, one of these; what stands below it must be one of ``PARTS``.

    Raises:
        UserError: it could run something else.
    """
    if not isinstance(config, Mapping) or "_target_" not in config:
        raise UserError(f"{where} must name a class as _target_; found {config!r}")
    accepted = arguments_of(_allowed(config["_target_"], where, kinds))
    for name, value in config.items():
        if str(name).startswith("_") and name not in OWN_KEYS:
            raise UserError(f"{where}.{name} is not allowed; a config gives _target_ and arguments")
        if name not in OWN_KEYS:
            if accepted is not None and name not in accepted:
                raise UserError(
                    f"{where} has no argument {name!r}; {config['_target_']} takes {', '.join(accepted)}"
                )
            _check_below(value, f"{where}.{name}")


def arguments_of(kind: Callable[..., Any]) -> tuple[str, ...] | None:
    """Names of the arguments that a class or function takes; None where it takes any."""
    parameters = inspect.signature(kind).parameters.values()
    if any(p.kind is p.VAR_KEYWORD for p in parameters):
        return None
    return tuple(p.name for p in parameters)


def _check_below(value: Any, where: str) -> None:
    if isinstance(value, str):
        if "${" in value:  # Hydra would resolve it once more, to something that nobody has looked at
            raise UserError(f"{where} must not hold an interpolation that is resolved late; found {value!r}")
    elif isinstance(value, Mapping):
        if any(str(name).startswith("_") for name in value):
            check(value, where, PARTS)
        else:
            for name, entry in value.items():
                _check_below(name, where)
                _check_below(entry, f"{where}.{name}")
    elif isinstance(value, Sequence):
        for index, entry in enumerate(value):
            _check_below(entry, f"{where}[{index}]")


def _allowed(name: Any, where: str, kinds: tuple[type, ...]) -> type:
    """The class of that name.

    Its own module counts, too: by way of a listed module, ``lightning.x.y.os.system`` would be reached.
    """
    wanted = " or ".join(kind.__name__ for kind in kinds)
    refused = UserError(
        f"{where}._target_={name} is not built: it must be a class ({wanted}) of {', '.join(PACKAGES)}"
    )
    if not isinstance(name, str) or not _inside(name):
        raise refused
    try:
        found = get_class(name)
    except (ImportError, ValueError) as error:
        raise refused from error
    if not _inside(found.__module__) or not issubclass(found, kinds):
        raise refused
    return found


def _inside(name: str) -> bool:
    return any(name == package or name.startswith(f"{package}.") for package in PACKAGES)

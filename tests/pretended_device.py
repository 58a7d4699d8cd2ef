"""A device that is not there: tensors that say they lie on it and keep their values on the CPU.

It goes by the name ``meta``, whose guards PyTorch has everywhere. What a GPU refuses is refused (tensors here
and there in one operation), and what makes the host wait for a GPU is noted (a value that is read, numbers
that are copied, sizes that depend on values).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = "meta"
aten = torch.ops.aten
MOVES = {aten._to_copy.default, aten.copy_.default}
INDEXED = {aten.index.Tensor, aten.index_put_.default, aten._index_put_impl_.default}
READS = {aten._local_scalar_dense.default, aten.nonzero.default, aten.masked_select.default}
WHOLE = {
    aten._conj.default: aten._conj_physical.default,
    aten._neg_view.default: aten.neg.default,
}
MADE = {torch.tensor, torch.as_tensor, torch.asarray}
waits: list[str] = []


class There(torch.Tensor):
    """A tensor on the device."""

    @staticmethod
    def __new__(cls, value: torch.Tensor) -> There:
        return torch.Tensor._make_wrapper_subclass(
            cls, value.size(), strides=value.stride(), storage_offset=value.storage_offset(),
            dtype=value.dtype, layout=value.layout, device=DEVICE,
        )  # fmt: skip

    def __init__(self, value: torch.Tensor) -> None:
        self.value = value

    def __repr__(self) -> str:
        return f"There({self.value})"

    def tolist(self) -> list:
        waits.append("tolist")
        return self.value.tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(func, args, kwargs or {})


def is_there(device: Any) -> bool:
    return device is not None and torch.device(device).type == DEVICE


def run(func: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
    """An operation on values, wherever its tensors lie."""
    tensors = [t for t in tree_flatten((args, kwargs))[0] if isinstance(t, torch.Tensor)]
    there = [t for t in tensors if isinstance(t, There)]
    here = [t for t in tensors if not isinstance(t, There)]
    lost = [t for t in here if is_there(t.device)]
    assert not lost, f"{func}: PyTorch made a tensor on the device by a way that is not watched"
    if there and func not in MOVES and not (func in INDEXED and isinstance(args[0], There)):
        apart = [tuple(t.shape) for t in here if t.dim()]
        assert not apart, f"{func}: tensors {apart} lie on the CPU, {len(there)} on the device"
    if there and func in READS:
        waits.append(str(func))
    asked = kwargs.get("device")
    plain = tree_map(lambda t: t.value if isinstance(t, There) else t, kwargs)
    if asked is not None:
        plain["device"] = torch.device("cpu")
    out = WHOLE.get(func, func)(*tree_map(lambda t: t.value if isinstance(t, There) else t, args), **plain)
    if asked is not None and not is_there(asked):
        return out
    if not there and asked is None:
        return out
    if torch.Tag.inplace_view in func.tags and isinstance(args[0], There):
        with torch._C._DisableTorchDispatch():  # its shape changes too
            func(*args, **kwargs)
        return args[0]
    if func is aten.copy_.default:
        return args[0]
    if "out" in kwargs:
        return kwargs["out"]
    for given in args:  # changed in place
        if isinstance(given, There) and out is given.value:
            return given
    return tree_map(lambda t: There(t) if isinstance(t, torch.Tensor) else t, out)


class Operations(TorchDispatchMode):
    """Of tensors that are made on the device, too."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(func, args, kwargs or {})


class Numbers(TorchFunctionMode):
    """Tensors of the host's numbers, which PyTorch copies to the device without an operation of their own."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func in MADE and is_there(kwargs.get("device")):
            waits.append(func.__name__)
            device = kwargs.pop("device")
            return func(*args, **kwargs).to(device)
        if func is torch.Tensor.new_tensor and isinstance(args[0], There):
            waits.append("new_tensor")
            return There(args[0].value.new_tensor(*args[1:], **kwargs))
        if func is torch.Tensor.__getitem__ and isinstance(args[0], There):
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            if any(isinstance(i, list) for i in index):
                waits.append("list as an index")
                index = tuple(torch.tensor(i).to(DEVICE) if isinstance(i, list) else i for i in index)
                return func(args[0], index)
        return func(*args, **kwargs)


@contextmanager
def pretended() -> Iterator[list[str]]:
    """Within, ``DEVICE`` is a device; what made the host wait for it is in the list."""
    waits.clear()
    with Numbers(), Operations():
        yield waits

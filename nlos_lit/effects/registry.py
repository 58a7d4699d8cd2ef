"""The list of all effects."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import overload

from nlos_lit.effects.effect import Effect


class Registry(Sequence[type[Effect]]):
    """Effects in the order in which they act.

    Args:
        modules: of this package, one for each effect; the class is the one whose ``name`` is the module's.
    """

    def __init__(self, modules: Iterable[str]) -> None:
        self._effects = [effect_of(module) for module in modules]

    @overload
    def __getitem__(self, place: int) -> type[Effect]: ...

    @overload
    def __getitem__(self, place: slice) -> Sequence[type[Effect]]: ...

    def __getitem__(self, place: int | slice) -> type[Effect] | Sequence[type[Effect]]:
        return self._effects[place]

    def __len__(self) -> int:
        return len(self._effects)

    @property
    def names(self) -> list[str]:
        """Of all effects, in order."""
        return [effect.name for effect in self]

    def named(self, name: str) -> type[Effect] | None:
        """The effect of that name, if there is one."""
        return next((effect for effect in self if effect.name == name), None)

    def splitting(self, one: str, other: str) -> str:
        """The measurement that would tell two effects apart, as either of them says.

        Args:
            one, other: names of effects.

        Returns:
            Empty where neither names one.

        Examples:
            >>> from nlos_lit.effects import EFFECTS
            >>> EFFECTS.splitting("time_offset", "time_drift")
            'a second scan in another order'
        """
        for mine, its in ((one, other), (other, one)):
            effect = self.named(mine)
            if effect is not None and its in effect.split_by:
                return effect.split_by[its]
        return ""

    @contextmanager
    def added(self, effect: type[Effect], after: str) -> Iterator[None]:
        """One more effect for a while, to try it out before it is in the list.

        Args:
            effect: the new one.
            after: name of the effect that acts right before it.

        Yields:
            Nothing; it is in the registry until the block is left.
        """
        before = list(self._effects)
        self._effects.insert(self.names.index(after) + 1, effect)
        try:
            yield
        finally:
            self._effects[:] = before


def effect_of(module: str) -> type[Effect]:
    """The effect that a module of this package defines.

    Args:
        module: its name, which is the effect's.

    Raises:
        ImportError: there is no such effect in it.
    """
    found = import_module(f"nlos_lit.effects.{module}")
    for value in vars(found).values():
        if isinstance(value, type) and issubclass(value, Effect) and vars(value).get("name") == module:
            return value
    raise ImportError(f"{found.__file__} defines no effect whose name is {module!r}")

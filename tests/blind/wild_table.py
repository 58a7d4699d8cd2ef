"""Which captures there are: three sets, each an endless table that is a function of its name and master seed.

A block of 210 holds 100 captures without effects, 70 with one, 20 with two and 20 with something that no
registry knows, so mixed that the beginning of a set is a fair sample of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from wild_inject import EFFECTS, Hidden
from wild_scenes import FAMILIES, SIDE
from wild_unknown import UNKNOWN

# Fixed with the rules, at 5daba9c: the hash of that commit modulo 1000. Nobody chose it.
TEST_MASTER_SEED = 482
MASTER_SEEDS = {"development": 11, "validation": 12, "test": TEST_MASTER_SEED}
BLOCK = {"null": 100, "single": 70, "pair": 20, "unknown": 20}
LENGTH = sum(BLOCK.values())
STRENGTHS = ("weak", "medium", "strong")
ORDERS = ("raster", "raster", "raster", "serpentine", "columns")
SCANS = ("confocal",) * 4 + ("single",)
FEW, MANY, CALM = 500, 10_000, 1500  # counts a spot; a render's own noise shows above the last
ALL = EFFECTS | UNKNOWN
SPACING = 10**9  # of the seeds of the sets


@dataclass(frozen=True)
class Spec:
    """What to make.

    Args:
        family: of scenes. scan: ``confocal`` or ``single`` (the laser's point stands still).
        effects: hidden, from `ALL`; none, one or two. strengths: 0, 1 or 2 for each.
        level: counts of the scene a spot, on average over the scan.
        seed: of the scene, the shapes of effects and the photons.
        order: of the scan: ``raster``, ``serpentine`` or ``columns``.
        side: spots along x and along y.
    """

    family: str
    scan: str = "confocal"
    effects: tuple[str, ...] = ()
    strengths: tuple[int, ...] = ()
    level: float = 1500
    seed: int = 0
    order: str = "raster"
    side: int = SIDE

    def __post_init__(self) -> None:
        if len(self.effects) != len(self.strengths):
            raise ValueError(f"one strength for each effect, please: {self}")
        for name in self.effects:
            if not ALL[name].suits(self.family, self.scan):
                raise ValueError(f"{name} cannot be hidden in a {self.scan} scan of {self.family}")
        if not together(self.effects):
            raise ValueError(f"{' and '.join(self.effects)} are no pair")

    @property
    def kind(self) -> str:
        """Of the four in `BLOCK`."""
        if any(name in UNKNOWN for name in self.effects):
            return "unknown"
        return ("null", "single", "pair")[len(self.effects)]


def together(names: Sequence[str]) -> bool:
    """Whether they can be hidden in one capture.

    At most one of them sees the scene anew, and no name is right for both.
    """
    said = [name for n in names for name in ALL[n].right + ALL[n].alike]
    return sum(ALL[n].own for n in names) < 2 and len(said) == len(set(said))


def seed_of(set_name: str, index: int, master: int | None = None) -> int:
    """Seed of a capture; those of the sets never meet."""
    master = MASTER_SEEDS[set_name] if master is None else master
    if not 0 <= master < 1000 or not 0 <= index < 10**6:
        raise ValueError(f"master seeds lie below 1000 and indices below a million; found {master}, {index}")
    return (1 + list(MASTER_SEEDS).index(set_name)) * SPACING + master * 10**6 + index


def spec_of(set_name: str, index: int, master: int | None = None) -> Spec:
    """The capture number ``index`` of a set.

    Args:
        set_name: ``development``, ``validation`` or ``test``.
        index: from 0.
        master: seed of the set; None takes that of `MASTER_SEEDS`.
    """
    master = MASTER_SEEDS[set_name] if master is None else master
    return _block(set_name, master, index // LENGTH)[index % LENGTH]


def table(set_name: str, length: int = LENGTH, master: int | None = None) -> list[Spec]:
    """The first captures of a set."""
    return [spec_of(set_name, index, master) for index in range(length)]


class Deck:
    """Cards that are drawn in turn, shuffled anew whenever all have been drawn."""

    def __init__(self, rng: np.random.Generator, cards: Sequence[str]) -> None:
        self.rng, self.cards, self.left = rng, list(cards), []

    def draw(self, suits: object = None) -> str:
        """The next card that ``suits``; those that do not stay on top."""
        for _ in range(2):
            for k, card in enumerate(self.left):
                if suits is None or suits(card):
                    return self.left.pop(k)
            self.left += [self.cards[k] for k in self.rng.permutation(len(self.cards))]
        for k, card in enumerate(self.left):
            if suits(card):
                return self.left.pop(k)
        raise ValueError("no card suits")


@lru_cache(maxsize=16)
def _block(set_name: str, master: int, block: int) -> tuple[Spec, ...]:
    number = list(MASTER_SEEDS).index(set_name)
    rng = np.random.default_rng([number, master, block, 7])
    decks = {"effects": Deck(rng, list(EFFECTS)), "unknown": Deck(rng, list(UNKNOWN))}
    # Of every kind the strengths come in turn, from block to block as well.
    steps = np.random.default_rng([master, number, 8]).integers(3, size=len(ALL))
    first = dict(zip(ALL, steps.tolist(), strict=True))
    met = dict.fromkeys(ALL, 0)
    drawn: list[tuple[float, dict]] = []
    for kind, count in BLOCK.items():
        scans, orders = Deck(rng, SCANS), Deck(rng, ORDERS)
        families, levels = Deck(rng, FAMILIES), rng.permutation(count)
        for k in range(count):
            names = _names(kind, decks)
            scan = scans.draw(lambda s, names=names: any(_fits(names, f, s) for f in FAMILIES))
            family = families.draw(lambda f, names=names, scan=scan: _fits(names, f, scan))
            strengths = []
            for name in names:
                strengths.append((first[name] + met[name] + 2 * block) % 3)
                met[name] += 1
            most = CALM if family == "render" else MANY
            level = FEW * (most / FEW) ** ((levels[k] + rng.uniform()) / count)
            fields = {"effects": names, "strengths": tuple(strengths), "scan": scan, "family": family}
            fields |= {"level": float(round(level, -1)), "order": orders.draw()}
            drawn.append(((k + rng.uniform()) / count, fields))
    drawn.sort(key=lambda pair: pair[0])
    start = block * LENGTH
    return tuple(
        Spec(**fields, seed=seed_of(set_name, start + k, master)) for k, (_, fields) in enumerate(drawn)
    )


def _fits(names: Sequence[str], family: str, scan: str) -> bool:
    return all(ALL[name].suits(family, scan) for name in names)


def _names(kind: str, decks: dict[str, Deck]) -> tuple[str, ...]:
    if kind == "null":
        return ()
    if kind == "unknown":
        return (decks["unknown"].draw(),)
    one = decks["effects"].draw()
    if kind == "single":
        return (one,)
    other = decks["effects"].draw(lambda n: n != one and together((one, n)) and _somewhere((one, n)))
    return tuple(sorted((one, other), key=list(EFFECTS).index))


def _somewhere(names: Sequence[str]) -> bool:
    return any(_fits(names, family, scan) for family in FAMILIES for scan in set(SCANS))


def hidden(name: str) -> Hidden:
    """What an injection's name stands for."""
    return ALL[name]

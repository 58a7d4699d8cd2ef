"""All experiments by name, in the order in which they are run."""

from __future__ import annotations

from collections.abc import Callable

from nlos_lit.evidence.ablation import figure8, table1
from nlos_lit.evidence.exposure import figure7
from nlos_lit.evidence.geometry import figure10
from nlos_lit.evidence.noise import figure6
from nlos_lit.evidence.profiles import profiles
from nlos_lit.evidence.record import Evidence
from nlos_lit.evidence.scenes import figure9
from nlos_lit.evidence.subjects import Size
from nlos_lit.evidence.training import figure5, supplement2
from nlos_lit.evidence.workspace import Workspace

EXPERIMENTS: dict[str, Callable[[Workspace, Size], Evidence]] = {
    "table1": table1,
    "figure10": figure10,
    "figure6": figure6,
    "figure7": figure7,
    "figure8": figure8,
    "figure9": figure9,
    "figure5": figure5,
    "supplement2": supplement2,
    "profiles": profiles,
}

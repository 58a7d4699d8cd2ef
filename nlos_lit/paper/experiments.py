"""All experiments by name, in the order in which they are run."""

from __future__ import annotations

from collections.abc import Callable

from nlos_lit.paper.figure5 import figure5
from nlos_lit.paper.figure6 import figure6
from nlos_lit.paper.figure7 import figure7
from nlos_lit.paper.figure8 import figure8
from nlos_lit.paper.figure9 import figure9
from nlos_lit.paper.figure10 import figure10
from nlos_lit.paper.profiles import profiles
from nlos_lit.paper.record import Evidence
from nlos_lit.paper.subjects import Size
from nlos_lit.paper.supplement2 import supplement2
from nlos_lit.paper.table1 import table1
from nlos_lit.paper.workspace import Workspace

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

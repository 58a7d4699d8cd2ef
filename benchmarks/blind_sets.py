"""The evaluation sets of captures with hidden effects: what is in them, and how it looks.

python benchmarks/blind_sets.py table set=development       a line for each capture
python benchmarks/blind_sets.py picture to=sheet.png        scenes and transients of every family
python benchmarks/blind_sets.py effects to=effects.png      what every kind of hidden effect does to a capture
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "blind")]
COLUMNS = 5  # draws of each family


def show_table(name: str, length: int) -> None:
    """Print the first captures of a set, and how many there are of each kind."""
    from wild_table import STRENGTHS, table

    specs = table(name, length)
    for k, spec in enumerate(specs):
        said = [f"{e} ({STRENGTHS[s]})" for e, s in zip(spec.effects, spec.strengths, strict=True)]
        scan = f"{spec.family:8s} {spec.scan:8s} {spec.order:10s} {spec.level:6g}"
        print(f"{k:4d} {scan}  {', '.join(said) or '-'}")
    for field in ("kind", "family", "scan", "order"):
        print(dict(Counter(getattr(spec, field) for spec in specs)))


def view(scene: object) -> np.ndarray:
    """``[ny, nx]`` of what the wall sees of a scene, shaded, NaN where there is nothing; a proxy's depth."""
    from data_modules.simulate import wall_grid
    from data_modules.simulate.picture import shaded
    from data_modules.simulate.truth import view_from_wall

    if scene.mesh is not None:
        grid = wall_grid(160, 160, 1.1, 1.1)
        return shaded(view_from_wall(scene.mesh, grid[:, 0, 0], grid[0, :, 1]))
    x, y, z = scene.proxy.centre.T
    edges = np.linspace(-1, 1, 81)
    total, number = (np.histogram2d(x, y, bins=(edges, edges), weights=w)[0] for w in (z, np.ones_like(z)))
    depth = total / np.where(number > 0, number, np.nan)
    return (1 - 0.8 * (depth - z.min()) / max(np.ptp(z), 0.01))[::-1, ::-1].T


def picture(path: str, start: int) -> None:
    """Every family: the scene as the wall sees it, the scanned spots, the light of all and of some spots."""
    from matplotlib.figure import Figure
    from wild_scenes import FAMILIES, load

    figure = Figure(figsize=(3.1 * COLUMNS, 3.4 * len(FAMILIES)), layout="constrained")
    axes = figure.subplots(2 * len(FAMILIES), COLUMNS, height_ratios=[1.5, 1] * len(FAMILIES))
    for row, family in enumerate(FAMILIES):
        for column in range(COLUMNS):
            scene = load(family, start + column, column < COLUMNS - 1)
            above, below = axes[2 * row, column], axes[2 * row + 1, column]
            reach = 0.55 if scene.mesh is not None else 1.0
            above.imshow(view(scene), cmap="gray", vmin=0, vmax=1, extent=(reach, -reach, -reach, reach))
            x, y = scene.sensor[:, 0], scene.sensor[:, 1]
            above.plot(x, y, ".", markersize=0.6, color="tab:orange")
            if not scene.confocal:
                above.plot(*scene.laser[0, :2], "r+")
            above.set_title(f"{family} {start + column}", fontsize=8)
            above.set_facecolor("midnightblue")
            above.tick_params(labelsize=6)
            light = scene.clean.reshape(len(scene.clean), -1, 8).sum(axis=2)[:, 16:-16]
            path_length = scene.window.t_start + scene.window.bin_length * np.arange(light.shape[1])
            for spot in (0, len(light) // 2 + 12, len(light) - 1):
                below.plot(path_length, light[spot] / light.max(), linewidth=0.5)
            mean = light.mean(axis=0)
            below.plot(path_length, mean / mean.max(), "k", linewidth=1)
            below.set_title(f"{light.shape[1]} bins of {1000 * scene.window.bin_length:.1f} mm", fontsize=7)
            below.tick_params(labelsize=6)
    figure.savefig(path, dpi=70)


def effects(path: str) -> None:
    """Every kind at its greatest strength on one scene: its residual over spots and time, and along each."""
    from matplotlib.figure import Figure
    from wild_table import ALL, Spec
    from wild_truth import hide

    names = list(ALL)
    columns = 7
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(2.4 * columns, 2.3 * rows), layout="constrained")
    axes = figure.subplots(rows, columns).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, name in zip(axes, names, strict=False):
        scan = ALL[name].scan or "confocal"
        family = "sheet" if ALL[name].families else "rounds"
        truth = hide(Spec(family, scan, (name,), (2,), 3000, 5))
        pull = (truth.expected - truth.without) / np.sqrt(truth.without)
        most = max(np.quantile(np.abs(pull), 0.995), 0.2 * np.abs(pull).max())
        axis.imshow(pull, cmap="RdBu_r", vmin=-most, vmax=most, aspect="auto", interpolation="nearest")
        axis.set_title(f"{name}: ±{most:.2g}", fontsize=7)
    figure.savefig(path, dpi=75)


def main(arguments: list[str]) -> None:
    what = arguments[0] if arguments else ""
    given = dict(a.split("=", 1) for a in arguments[1:])
    if what == "table":
        show_table(given.get("set", "development"), int(given.get("length", 210)))
    elif what == "picture":
        picture(given.get("to", "sets.png"), int(given.get("seed", 1)))
    elif what == "effects":
        effects(given.get("to", "effects.png"))
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])

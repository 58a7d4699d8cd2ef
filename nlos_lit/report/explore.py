"""A page to explore a run or a diagnosis: one file that needs nothing but a browser."""

from __future__ import annotations

import base64
import gzip
import html
import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from nlos_lit.io.files import whole_file
from nlos_lit.io.views import View, packed
from nlos_lit.report.page_style import CSS
from nlos_lit.report.words import AXES

FILE = "explore.html"
LARGEST = 8 * 10**6  # bytes of a page
TYPES = {"|u1": "u1", "<u2": "u2", "<u4": "u4", "<i4": "i4", "<f4": "f4"}
LOOKS = {
    "From the wall": {"x": 0, "y": 0, "z": -2},
    "From the side": {"x": 2, "y": 0, "z": 0},
    "From above": {"x": 0, "y": 2, "z": -0.01},
}
STATUS = {
    "running": "running: what follows is its state at",
    "interrupted": "interrupted: what follows is its state at",
    "finished": "finished at",
}


def write_page(folder: Path | str, view: View) -> Path:
    """Write ``explore.html``, whole or not at all.

    Args:
        folder: where to.
        view: what is shown.

    Returns:
        The page's path.

    Raises:
        ValueError: the page would be larger than a browser opens at once.
    """
    text = page_html(view)
    if len(text.encode()) > LARGEST:
        raise ValueError(f"the page would have {len(text.encode())} bytes; at most {LARGEST} are allowed")
    file = Path(folder) / FILE
    with whole_file(file) as partial:
        partial.write_text(text, encoding="utf-8")
    return file


def page_html(view: View) -> str:
    """The page, with plotly and all data in it.

    Args:
        view: what is shown.

    Returns:
        HTML that asks nothing of a network.
    """
    from plotly.offline import get_plotlyjs  # loads slowly

    header, arrays = packed(view)
    x, y, nearest = wall_lattice(view.places)
    header["wall"] = {"x": x.tolist(), "y": y.tolist()}
    header["arrays"], content = _joined({**arrays, "wall": nearest.astype(np.int32)})
    here = resources.files("nlos_lit.report")
    style = CSS + (here / "explore.css").read_text(encoding="utf-8")
    script = (here / "explore.js").read_text(encoding="utf-8")
    name = html.escape(str(view.facts["name"]))
    # No "<" at all: "<!--" and "<script" change how the rest of a page is read, too.
    described = json.dumps(header, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{name}: explore</title><style>{style}</style></head>
<body>
<main>
{_top(view)}
<div class="grid">
{_scene(view)}
{_slices(view)}
{_wall(view)}
{_spot(view)}
</div>
{_change(view)}
{_provenance(view)}
</main>
<script type="application/json" id="header">{described}</script>
<script type="text/plain" id="data">{_pressed(content)}</script>
<script type="text/plain" id="plotly">{_pressed(get_plotlyjs().encode())}</script>
<script>{script}</script>
</body></html>
"""


def wall_lattice(places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cells over the wall, each with the spot that it shows.

    Args:
        places: ``[S, 2]`` scanned points, m.

    Returns:
        ``[nx]`` and ``[ny]`` centres, m, and ``[ny, nx]`` rows of ``places``, -1 where no spot is near. The
        rows and columns of a scan are its own cells; irregular spots are shown by twice as many a side.

    Examples:
        >>> x, y, nearest = wall_lattice(np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.2], [0.1, 0.2]]))
        >>> x.tolist(), y.tolist(), nearest.tolist()
        ([0.0, 0.1], [0.0, 0.2], [[0, 1], [2, 3]])
    """
    x, y = (np.unique(np.round(places[:, k], 5)) for k in (0, 1))
    if len(x) * len(y) > 4 * len(places):
        side = 2 * int(np.ceil(np.sqrt(len(places))))
        x, y = (np.linspace(places[:, k].min(), places[:, k].max(), side) for k in (0, 1))
    cells = np.stack(np.meshgrid(x, y), axis=-1)
    tree = cKDTree(places)
    apart = np.median(tree.query(places, k=min(2, len(places)))[0].reshape(len(places), -1)[:, -1])
    distance, nearest = tree.query(cells)
    return x, y, np.where(distance <= max(1.5 * float(apart), 1e-4), nearest, -1)


def _joined(arrays: Mapping[str, np.ndarray]) -> tuple[dict[str, Any], bytes]:
    """Arrays one after the other, each from a multiple of four bytes, and where they are."""
    where, parts, offset = {}, [], 0
    for name, values in arrays.items():
        raw = np.ascontiguousarray(values).tobytes()
        where[name] = {"type": TYPES[values.dtype.str], "offset": offset, "shape": list(values.shape)}
        parts.append(raw + b"\0" * (-len(raw) % 4))
        offset += len(parts[-1])
    return where, b"".join(parts)


def _pressed(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode("ascii")


def _top(view: View) -> str:
    facts = view.facts
    said = [html.escape(sentence) for sentence in facts["said"]]
    tone = html.escape(facts.get("tone", "fine"))
    first = f'<h1 class="{tone}">{said[0]}</h1>' if said else ""
    rest = "".join(f"<p>{sentence}</p>" for sentence in said[1:])
    live = (
        '<p class="controls"><label><input type="checkbox" id="live" checked>'
        "look for news every ten seconds</label></p>"
        if facts["status"] == "running"
        else ""
    )
    report = '<p><a href="report.html">The whole report</a></p>' if facts.get("report") else ""
    advice = facts.get("next")
    command = f"<pre tabindex=0><code>{html.escape(advice['command'])}</code></pre>" if advice else ""
    after = (
        f'<div class="next"><h2>Do this next</h2><p>{html.escape(advice["text"])}</p>'
        f"{command if advice['command'] else ''}</div>"
        if advice
        else ""
    )
    when = str(facts["at"]).replace("T", " ")
    return (
        f'<header><p class="over">{html.escape(str(facts["name"]))}</p>{first}{rest}{after}'
        f'<p><span class="status">{STATUS[facts["status"]]} {html.escape(when)}</span></p>'
        f'{live}{report}<p id="message" role="status"></p>'
        "<noscript><p>This page draws with JavaScript; it is switched off here.</p></noscript></header>"
    )


def _scene(view: View) -> str:
    looks = "".join(
        f"<button type=button data-look='{json.dumps(eye)}'>{name}</button>" for name, eye in LOOKS.items()
    )
    turns = (
        '<button type=button data-turn="-1" aria-label="Turn to the left">⟲</button>'
        '<button type=button data-turn="1" aria-label="Turn to the right">⟳</button>'
    )
    level = (
        '<label>volume above <input type="range" id="level" min="5" max="95" step="5"> of its brightest'
        "</label>"
        if view.volume is not None
        else ""
    )
    names = [*(["volume"] if view.volume is not None else []), *view.clouds, *view.meshes]
    what = f"Hidden scene in three dimensions: {', '.join(names) or 'nothing yet'}. Buttons below turn it."
    return _section(
        "The hidden scene",
        f'<div class="plot" id="hidden" role="group" aria-label="{html.escape(what)}"></div>'
        f'<div class="controls" id="layers"></div><div class="controls">{looks}{turns}</div>'
        f'<div class="controls">{level}</div>',
    )


def _slices(view: View) -> str:
    if view.volume is None:
        return _section("Slices", "<p>No volume has been made yet.</p>")
    return _section(
        "Slices of the volume",
        '<div class="plot" id="slices" role="group" aria-label="A slice of the volume, chosen below.">'
        '</div><div class="controls"><label>across <select id="axis"><option value="z">depth z</option>'
        '<option value="x">x</option><option value="y">y</option></select></label>'
        '<label>place <input type="range" id="slice" min="0"></label>'
        '<output id="slice-value"></output></div>',
    )


def _wall(view: View) -> str:
    choices = [("counts", "measured")]
    choices += [(f"model:{k}", name) for k, name in enumerate(view.models)]
    choices += [(f"residual:{k}", f"residual, {name}") for k, name in enumerate(view.models)]
    options = "".join(f'<option value="{key}">{html.escape(name)}</option>' for key, name in choices)
    return _section(
        "The wall over time",
        '<div class="plot" id="wall" tabindex="0" role="application" aria-label="Map of the scanned wall. '
        'Click a spot, or move the chosen one with the arrow keys; its numbers are beside."></div>'
        f'<div class="controls"><label>show <select id="what">{options}</select></label>'
        '<label><input type="checkbox" id="all"> all bins together</label></div>'
        '<div class="controls"><label>time <input type="range" id="time" min="0"></label>'
        '<button type=button id="play">Play</button><output id="time-value"></output></div>',
    )


def _spot(view: View) -> str:
    return _section(
        "One spot",
        '<div class="plot" id="transient" role="group" aria-label="Transient of the chosen spot: measured '
        'and modelled counts over optical path, residual below. The table gives the numbers."></div>'
        '<div class="controls"><label>spot shown <input type="number" id="spot" min="0"></label></div>'
        '<p id="where" aria-live="polite"></p>'
        '<table><thead><tr><th scope="col">Counts</th><th scope="col">number</th>'
        '<th scope="col">measured less modelled</th></tr></thead><tbody id="numbers"></tbody></table>',
    )


def _change(view: View) -> str:
    profiles = view.facts.get("profiles") or []
    if not profiles:
        return ""
    names = [p["axis"] for p in profiles]
    order = sorted(names, key=lambda name: name != "wall")
    options = "".join(
        f'<option value="{html.escape(n)}">{html.escape(AXES.get(n, n))}</option>' for n in order
    )
    return _section(
        "Before and after the diagnosis",
        "<p>How many standard deviations the counts lie above the simulation: as it was, and with what the "
        "diagnosis added. Of curves, what lies within the grey band is chance; on the wall, grey spots were "
        "kept back.</p>"
        '<div class="plot" id="change" role="group" aria-label="Residual before and after the extension '
        'along the chosen axis."></div>'
        f'<div class="controls"><label>residual <select id="profile">{options}</select></label></div>',
    )


def _provenance(view: View) -> str:
    origin = view.facts.get("origin", {})
    rows = {
        "command": origin.get("command"),
        "file": origin.get("file"),
        **{f"capture {k}": v for k, v in origin.get("capture", {}).items()},
    }
    provenance = origin.get("provenance") or {}
    rows |= {f"file: {k}": v for k, v in provenance.items() if not isinstance(v, (dict, list))}
    git = origin.get("git") or {}
    rows["commit"] = (
        f"{git['commit']}{' with changes' if git.get('dirty') else ''}" if git else "not a checkout"
    )
    rows["versions"] = ", ".join(f"{k} {v}" for k, v in origin.get("versions", {}).items() if v)
    rows |= {f"shown: {k}": v for k, v in view.facts.get("kept", {}).items()}
    lines = "".join(
        f'<tr><th scope="row">{html.escape(str(name))}</th><td>{html.escape(str(value))}</td></tr>'
        for name, value in rows.items()
        if value is not None
    )
    more = {k: v for k, v in provenance.items() if isinstance(v, (dict, list)) and v}
    whole = (
        f"<details><summary>All that is known of the file</summary><pre tabindex=0>"
        f"{html.escape(json.dumps(more, indent=1, ensure_ascii=False))}</pre></details>"
        if more
        else ""
    )
    return _section("Where this comes from", f"<table><tbody>{lines}</tbody></table>{whole}")


def _section(title: str, body: str) -> str:
    return f"<section><h2>{title}</h2>{body}</section>"

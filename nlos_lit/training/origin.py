"""What a fit came from: kept in each of its checkpoints, compared before one of them is opened."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.foreign import archived
from nlos_lit.runtime.command_line import typed
from nlos_lit.runtime.keys import CHANGEABLE

# Settings that a checkpoint fits no other of, by what goes on from it; the capture is compared itself.
START = ("seed", "heldout", "scene.volume")  # a surface, from the image of a finished run
IMAGE = (*START, "model", "ablation.optimise", "batch_spots", "objective", "optimizer")
SURFACE = (*IMAGE, "surfels", "effects")
# Settings of a scene that make neither the capture nor its volume.
BESIDE = ("scene.name", "scene.iterations", "scene.threshold", "scene.wavelength", "scene.falloff")
PLAIN = str | int | float | None
CHANGE = ("setting", "from", "to", "after")  # of an entry of what was changed
TOLD = 4  # differences that a message names


def origin_of(settings: Mapping[str, Any], capture: Capture) -> dict[str, Any]:
    """What a fit comes from, in plain containers that a checkpoint can hold.

    Args:
        settings: resolved, of ``train.py``.
        capture: as the scene's settings make it.

    Returns:
        ``capture``, its hash, ``settings``, by dotted name, and ``changed``: nothing yet, see
        :func:`changed_since`.
    """
    sections = {name.split(".")[0] for name in SURFACE} | {"scene"}
    shaping = {name: settings[name] for name in sections}
    if isinstance(shaping["effects"], str):
        shaping["effects"] = [shaping["effects"]]
    return {"capture": capture.digest(), "settings": flat(shaping), "changed": []}


def check_origin(
    file: Path, origin: Mapping[str, Any], sections: Sequence[str], change: Sequence[str] = ()
) -> None:
    """Refuse a checkpoint of another capture, or of other settings.

    Args:
        file: the checkpoint.
        origin: of the run that is to open it.
        sections: of the settings that must be the same: START, IMAGE or SURFACE.
        change: settings among them, by name, that may differ.

    Raises:
        UserError: it is another's, with what differs, or no checkpoint of this project.
    """
    kept = read_checkpoint(file)["origin"]
    with sound(file):
        theirs, mine = kept["settings"], origin["settings"]
        differ = [
            name
            for name in sorted(theirs.keys() | mine.keys())
            if theirs.get(name) != mine.get(name) and name not in BESIDE
        ]
        same_capture = kept["capture"] == origin["capture"]
    told = [name for name in differ if any(f"{name}.".startswith(f"{section}.") for section in sections)]
    told = [name for name in told if name not in change]
    if not same_capture:  # the scene's settings may tell why
        told += [name for name in differ if name.startswith("scene.") and name not in told]
    words = [f"{name}={theirs.get(name)}, this command has {mine.get(name)}" for name in told[:TOLD]]
    if not same_capture:
        words.append("another capture than this command's")
    if words:
        instead = "give the same, or begin anew without it"
        if same_capture and sections == IMAGE and set(told) <= set(CHANGEABLE):
            instead += f", or let it differ from here on: 'resume.change=[{','.join([*change, *told])}]'"
        raise UserError(f"{file} was made with {'; '.join(words)}: {instead}")


def changed_since(file: Path, origin: Mapping[str, Any], change: Sequence[str]) -> list[dict[str, Any]]:
    """What a run has done otherwise since it was begun, so that its last settings do not stand for all of it.

    Args:
        file: the checkpoint that it goes on from.
        origin: of the run, which :func:`check_origin` has compared.
        change: settings that may differ.

    Returns:
        Earlier changes, then those of this command: ``setting``, its values ``from`` and ``to``, and
        ``after``, the iterations that had been done.
    """
    state = read_checkpoint(file)
    with sound(file):
        kept, done = state["origin"], int(state["global_step"])
        now = [
            {"setting": name, "from": kept["settings"][name], "to": origin["settings"][name], "after": done}
            for name in sorted(change)
            if kept["settings"][name] != origin["settings"][name]
        ]
        before = [{key: entry[key] for key in CHANGE} for entry in kept.get("changed", ())]
        if not all(isinstance(value, PLAIN) for entry in before for value in entry.values()):
            raise TypeError("no settings")
        return before + now


@contextmanager
def sound(file: Path) -> Iterator[None]:
    """What is done with the content of a checkpoint, which may come from anywhere and be wrong in any way.

    Raises:
        UserError: whatever else was raised, as one sentence.
    """
    try:
        yield
    except Exception as error:
        raise UserError(f"{file} is damaged, or no checkpoint: give one of a run's checkpoints/") from error


def read_checkpoint(file: Path) -> dict[str, Any]:
    """A checkpoint of a fit, on the CPU; it may come from anywhere.

    Raises:
        UserError: it is damaged, or does not say what it was fitted to.
    """
    with sound(file):
        state = torch.load(archived(file), map_location="cpu", weights_only=True)
    if not isinstance(state, dict) or "origin" not in state:
        raise UserError(
            f"{file} does not say which capture and settings it was fitted with (another version of this "
            "project wrote it): train the scene again"
        )
    return state


def finished_checkpoint(folder: Path) -> Path:
    """The last checkpoint of a self-calibration that was carried through.

    Raises:
        UserError: the folder holds none, or one that stopped before its end.
    """
    file = folder / "checkpoints" / "last.ckpt"
    if not file.is_file():
        raise UserError(
            f"{folder} is not the folder of a finished self-calibration: checkpoints/last.ckpt is missing"
        )
    state = read_checkpoint(file)
    with sound(file):
        whole, done = "final" in state.get("scores", ()), state.get("epoch", -1) + 1
    if not whole:
        raise UserError(
            f"the run in {folder} was stopped after {done} iterations; "
            f"finish it first: {typed('train')} {shlex.quote(f'resume={folder}')}"
        )
    return file


def flat(values: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Nested settings by dotted name.

    Args:
        values: of a section.
        above: its own name, with a dot behind.

    Returns:
        name → what is no section.
    """
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= flat(value, f"{above}{name}.") if isinstance(value, Mapping) else {f"{above}{name}": value}
    return found

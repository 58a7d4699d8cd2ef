"""A diagnosis to look at, while it goes on and when it has ended."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.inference.members import Findings, Member
from nlos_lit.inference.result import Diagnosis
from nlos_lit.io.files import plain
from nlos_lit.io.views import read_view
from nlos_lit.report.advice import confidence, next_step, told_member
from nlos_lit.report.together import told_apart
from nlos_lit.report.verdict import tone, verdict
from nlos_lit.surfels.fit import SurfelFit
from nlos_lit.training.explored import Expected, Scene, facts_of, keep, view_of


class WatchedDiagnosis:
    """Keeps ``view.npz`` and ``explore.html`` of a diagnosis up to date.

    Args:
        folder: of the diagnosis.
        scene: settings of the scene.
        capture: that is diagnosed.
    """

    def __init__(self, folder: Path, scene: Mapping[str, Any], capture: Capture) -> None:
        self.folder, self.scene, self.capture = folder, scene, capture
        self.image: tuple[Tensor, VolumeGrid] | None = None

    def begin(self) -> None:
        """Show what was measured; nothing is fitted yet."""
        facts = facts_of(self.scene, self.capture, "running", ["Diagnosis: fitting the simulation first."])
        keep(self.folder, view_of(self.capture, {}, Scene(), facts))

    def told(
        self, image: tuple[Tensor, VolumeGrid], base: SurfelFit, present: SurfelFit, members: Sequence[Member]
    ) -> None:
        """Show what was found so far.

        Args:
            image: ``[nz, nx, ny]`` and its grid.
            base: fine fit without effects.
            present: fine fit with what was accepted.
            members: terms that were tried so far.
        """
        self.image = image
        said = ["The diagnosis goes on: asking what the simulation misses."]
        said += [told_member(member) for member in members]
        self._keep(base, present, "running", said)

    def finish(self, found: Findings, diagnosis: Diagnosis, given: Sequence[str] = ()) -> None:
        """Show the result.

        Args:
            found: the fits.
            diagnosis: what is said of them.
            given: settings of the command line that name the scene.
        """
        told = told_of(diagnosis, given, self.folder)
        more = {"profiles": plain(diagnosis.profiles), "report": True}
        self._keep(found.base, found.final, "finished", told.pop("said"), **told, **more)

    def _keep(self, base: SurfelFit, present: SurfelFit, status: str, said: list[str], **more: Any) -> None:
        models, clouds = {"rendered": _expected(base)}, {"surfels": base.model.points()}
        names = ", ".join(effect.name for effect in present.extension.effects)
        if names:
            models[f"extended by {names}"] = _expected(present)
            clouds = {"surfels before": clouds["surfels"], "surfels after": present.model.points()}
        volume = None if self.image is None else (self.image[0].cpu().numpy(), self.image[1])
        facts = facts_of(self.scene, self.capture, status, said, **more)
        keep(self.folder, view_of(self.capture, models, Scene(clouds, volume=volume), facts))


def told_of(diagnosis: Diagnosis, given: Sequence[str], folder: Path) -> dict[str, Any]:
    """What a page says of a diagnosis, as entries of its facts.

    Args:
        diagnosis: the whole.
        given: settings of the command line that name the scene.
        folder: of the diagnosis.

    Returns:
        Sentences, tone, and what to do next.
    """
    said = [verdict(diagnosis), confidence(diagnosis), *map(told_apart, diagnosis.further)]
    return {
        "said": said,
        "tone": tone(diagnosis),
        "next": plain(next_step(diagnosis, given, folder.parent)),
    }


def retell(folder: Path, diagnosis: Diagnosis, given: Sequence[str]) -> None:
    """Let the page of a finished diagnosis say what is known now.

    Args:
        folder: of the diagnosis.
        diagnosis: as it is now.
        given: settings of the command line that name the scene.
    """
    view = read_view(folder)
    keep(folder, dataclasses.replace(view, facts=view.facts | told_of(diagnosis, given, folder)))


def _expected(fit: SurfelFit) -> Expected:
    return lambda spots: fit.model.expected(spots, fit.extension)

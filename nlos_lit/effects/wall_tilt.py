"""Wall that does not stand where the file says."""

from __future__ import annotations

import torch
from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Walls


class WallTilt(Effect):
    """The wall is tilted: its points stand nearer or farther than the file says, and face aside.

    ``z → z + tilt_x X + tilt_y Y`` for the laser's and the sensor's points, X and Y from the scan's centre,
    ``n → n - (tilt_x, tilt_y, 0)``, made a unit again, for the wall's normals.

    Parameters: ``tilt_x``, ``tilt_y`` (rad), null 0.

    Signature: edges in time early on one side of the wall and late on the other.

    Degenerate with: a turn of the whole scene about the wall's centre (almost perfectly, for small scenes);
    ``time_drift`` along the slow axis of a raster scan.

    Source: geometry.
    """

    name = "wall_tilt"
    imitated = ("geometry",)
    followed_by = ("free_wall_delay",)
    lasting = True
    words = EffectWords(
        phrase="a relay wall that is tilted against the scan's plane",
        cause="The scanned points stand nearer or farther than assumed, so paths are longer on one side.",
        remedy="Measure the wall's plane (the direct pulse's arrival tells it) and give the true wall "
        "points.",
        headline="{tilt_x} along x, {tilt_y} along y",
    )

    centre: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("centre", scan.centre.clone(), persistent=False)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        # One bin at the wall's edge is noticed.
        step = scan.bin_length / scan.half / 2
        return tuple(Parameter(name, "rad", 0.0, step, -0.3, 0.3) for name in ("tilt_x", "tilt_y"))

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"tilt_x": 0.03, "tilt_y": 0.0}

    def walls(self, walls: Walls, spots: Tensor) -> Walls:
        tilt = torch.stack([self.value("tilt_x"), self.value("tilt_y")])

        def place(wall: Tensor) -> Tensor:
            z = ((wall[:, :2] - self.centre) * tilt).sum(1, keepdim=True)
            return wall + torch.nn.functional.pad(z, (2, 0))

        def facing(normal: Tensor) -> Tensor:
            return torch.nn.functional.normalize(normal - torch.nn.functional.pad(tilt, (0, 1)), dim=1)

        return Walls(
            place(walls.laser),
            facing(walls.laser_normal),
            place(walls.sensor),
            facing(walls.sensor_normal),
            walls.confocal,
        )

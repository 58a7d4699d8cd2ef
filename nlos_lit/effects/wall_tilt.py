"""Wall that does not stand where the file says."""

from __future__ import annotations

from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.parameter import Parameter
from nlos_lit.effects.words import EffectWords
from nlos_lit.functional.surfel_paths import Paths


class WallTilt(Effect):
    """The wall is tilted: its points stand nearer or farther than the file says.

    ``L → L - cosθ_laser z_laser - cosθ_sensor z_sensor``, ``z = tilt_x X + tilt_y Y`` beyond the stated
    place, X and Y from the scan's centre, cosθ between the wall's normal and the leg to the surfel's centre.

    Parameters: ``tilt_x``, ``tilt_y`` (rad), null 0.

    Signature: edges in time early on one side of the wall and late on the other.

    Degenerate with: a turn of the whole scene about the wall's centre (almost perfectly, for small scenes);
    ``time_drift`` along the slow axis of a raster scan.

    Source: geometry, to first order in the tilt.
    """

    name = "wall_tilt"
    followed_by = ("free_wall_delay",)
    lasting = True
    words = EffectWords(
        phrase="a relay wall that is tilted against the scan's plane",
        cause="The scanned points stand nearer or farther than assumed, so paths are longer on one side.",
        remedy="Measure the wall's plane (the direct pulse's arrival tells it) and give the true wall "
        "points.",
        headline="{tilt_x} along x, {tilt_y} along y",
    )

    laser: Tensor
    sensor: Tensor
    centre: Tensor

    def __init__(self, scan: Scan) -> None:
        super().__init__(scan)
        self.register_buffer("laser", scan.laser.clone(), persistent=False)
        self.register_buffer("sensor", scan.sensor.clone(), persistent=False)
        self.register_buffer("centre", scan.centre.clone(), persistent=False)

    @classmethod
    def declare(cls, scan: Scan) -> tuple[Parameter, ...]:
        # One bin at the wall's edge is noticed.
        step = scan.bin_length / scan.half / 2
        return tuple(Parameter(name, "rad", 0.0, step, -0.3, 0.3) for name in ("tilt_x", "tilt_y"))

    @classmethod
    def typical(cls, scan: Scan) -> dict[str, float]:
        return {"tilt_x": 0.03, "tilt_y": 0.0}

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        laser = self.shorter(self.laser[spots], paths.centre)
        sensor = laser if self.scan.confocal else self.shorter(self.sensor[spots], paths.centre)
        return length - (laser + sensor)[..., None]

    def shorter(self, wall: Tensor, centre: Tensor) -> Tensor:
        """By how much legs get shorter.

        Args:
            wall: ``[B, 3]`` m, where they begin.
            centre: ``[M, 3]`` m, where they end.

        Returns:
            ``[B, M]`` m.
        """
        away = centre - wall[:, None]
        place = wall[:, :2] - self.centre
        z = self.value("tilt_x") * place[:, 0] + self.value("tilt_y") * place[:, 1]
        return z[:, None] * away[..., 2] / away.norm(dim=2)

"""Wall that does not stand where the file says."""

from __future__ import annotations

from torch import Tensor

from nlos_lit.capture.scan import Scan
from nlos_lit.effects.effect import Effect, Parameter
from nlos_lit.functional.surfel_paths import Paths


class WallTilt(Effect):
    """The wall points really stand at ``z = tilt_x X + tilt_y Y`` beyond their stated places; X, Y from the
    scan's centre.

    ``L → L - cosθ_laser z_laser - cosθ_sensor z_sensor``, cosθ between the wall's normal and the leg to the
    surfel's centre.

    Parameters: ``tilt_x``, ``tilt_y`` (rad), null 0.

    Signature: edges in time early on one side of the wall and late on the other.

    Degenerate with: a turn of the whole scene about the wall's centre (almost perfectly, for small scenes);
    ``time_drift`` along the slow axis of a raster scan.

    Source: geometry, to first order in the tilt.
    """

    name = "wall_tilt"
    stage = "time"
    needs_paths = True

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

    def time(self, length: Tensor, paths: Paths, spots: Tensor) -> Tensor:
        laser = self.shorter(self.laser[spots], paths.centre)
        sensor = laser if self.scan.confocal else self.shorter(self.sensor[spots], paths.centre)
        return length - (laser + sensor)[..., None]

    def shorter(self, wall: Tensor, centre: Tensor) -> Tensor:
        """``[B, M]`` m by which legs from ``wall`` ``[B, 3]`` to ``centre`` ``[M, 3]`` get shorter."""
        away = centre - wall[:, None]
        place = wall[:, :2] - self.centre
        z = self.value("tilt_x") * place[:, 0] + self.value("tilt_y") * place[:, 1]
        return z[:, None] * away[..., 2] / away.norm(dim=2)

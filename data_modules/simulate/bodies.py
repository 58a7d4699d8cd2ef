"""Bodies of a hidden scene: kinds with sizes, pose and texture, each of which one line of config makes.

Own coordinates are the world's with the body's centre at the origin: +x left as seen from the wall, +y up, +z
away from it. A new kind is a class here and its name in `BODIES`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from data_modules.simulate import font, shapes
from data_modules.simulate.mesh import Mesh, join
from data_modules.simulate.textures import AXES, TEXTURES, paint
from nlos_lit.capture.errors import UserError

READABLE = np.array([-1.0, 1.0])  # from (right, up) as seen from the wall to world (x, y)


def rotation(turn: tuple[float, float, float]) -> np.ndarray:
    """Rotation about the world's x, then y, then z axis.

    Args:
        turn: the three angles, degrees, right-handed.

    Returns:
        ``[3, 3]`` matrix for column vectors.

    Examples:
        >>> (rotation((90.0, 0.0, 90.0)) @ [1.0, 1.0, 0.0]).round(9).tolist()  # x → y, y → z
        [0.0, 1.0, 1.0]
    """
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


@dataclass(frozen=True, kw_only=True)
class Body:
    """What all bodies have: pose, texture and fineness.

    Args:
        at: the centre (x, y, z), m.
        turn: angles about the world's x, then y, then z axis through the centre, degrees.
        albedo: reflectance in [0, 1]; two numbers with a texture.
        texture: one of `TEXTURES`, in the body's own coordinates.
        along: axis of the texture, x, y or z of the body.
        period: of stripes and checkers, m: two of them.
        cell: longest edge of curved parts, m; the surface is true to the square of it.

    Raises:
        UserError: a size that is not positive, an unknown texture, or albedos that do not suit it.
    """

    kind: ClassVar[str]
    POSITIVE: ClassVar[tuple[str, ...]] = ()

    at: tuple[float, float, float] = (0.0, 0.0, 0.6)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    albedo: float | tuple[float, float] = 0.8
    texture: str = "plain"
    along: str = "y"
    period: float = 0.1
    cell: float = 0.015

    def __post_init__(self) -> None:
        for name in (*self.POSITIVE, "period", "cell"):
            if not 0 < getattr(self, name) < math.inf:
                raise UserError(f"{name} must be above 0; found {getattr(self, name)!r}")
        if self.texture not in TEXTURES:
            raise UserError(f"texture is one of {', '.join(TEXTURES)}; found {self.texture!r}")
        if self.along not in AXES or len(self.along) != 1:
            raise UserError(f"along is x, y or z; found {self.along!r}")
        plain = not isinstance(self.albedo, tuple)
        if plain != (self.texture == "plain"):
            wanted = "one albedo" if self.texture == "plain" else "two albedos, as albedo: [0.3, 0.9]"
            raise UserError(f"texture {self.texture} takes {wanted}; found {self.albedo!r}")
        if not all(0 <= value <= 1 for value in np.ravel(self.albedo)):
            raise UserError(f"albedo must lie in [0, 1]; found {self.albedo!r}")
        if not np.isfinite([*self.at, *self.turn]).all():
            raise UserError(f"at and turn must be finite; found {self.at} and {self.turn}")

    def shape(self) -> Mesh:
        """The body in its own coordinates, without texture."""
        raise NotImplementedError

    def mesh(self) -> Mesh:
        """The body in the world."""
        albedo = self.albedo if isinstance(self.albedo, tuple) else (self.albedo, self.albedo)
        own = paint(self.shape(), self.texture, albedo, self.along, self.period)
        return Mesh(own.vertices @ rotation(self.turn).T + np.array(self.at), own.faces, own.albedo)

    def config(self) -> dict[str, Any]:
        """The config that makes it: its kind, and what differs from the defaults."""
        given = {
            field.name: getattr(self, field.name)
            for field in dataclasses.fields(self)
            if getattr(self, field.name) != field.default
        }
        return {"kind": self.kind} | {k: list(v) if isinstance(v, tuple) else v for k, v in given.items()}


@dataclass(frozen=True, kw_only=True)
class Sphere(Body):
    """A ball.

    Args:
        radius: m.
    """

    kind = "sphere"
    POSITIVE = ("radius",)
    radius: float = 0.1

    def shape(self) -> Mesh:
        """Poles up and down."""
        return shapes.lathe(shapes.capsule_profile(self.radius, 0.0, self.cell), self.cell)


@dataclass(frozen=True, kw_only=True)
class Capsule(Body):
    """A cylinder with half spheres at its ends.

    Args:
        radius: m.
        length: of the cylinder between the half spheres, m.
    """

    kind = "capsule"
    POSITIVE = ("radius", "length")
    radius: float = 0.06
    length: float = 0.16

    def shape(self) -> Mesh:
        """Upright."""
        return shapes.lathe(shapes.capsule_profile(self.radius, self.length, self.cell), self.cell)


@dataclass(frozen=True, kw_only=True)
class Cone(Body):
    """A cone, cut off at its top where ``top`` is above 0.

    Args:
        radius: of its base, m.
        top: radius of its upper end, m.
        height: m.
    """

    kind = "cone"
    POSITIVE = ("radius", "height")
    radius: float = 0.12
    top: float = 0.0
    height: float = 0.24

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.top < math.inf:
            raise UserError(f"top must be 0 or above; found {self.top!r}")

    def shape(self) -> Mesh:
        """Base down, closed by flat discs."""
        h = self.height / 2
        corners = [[0.0, h], [self.top, h], [self.radius, -h], [0.0, -h]]
        profile = shapes.straight(corners if self.top > 0 else corners[1:], self.cell)
        return shapes.lathe(profile, self.cell)


@dataclass(frozen=True, kw_only=True)
class Cylinder(Body):
    """A can.

    Args:
        radius: m.
        height: m.
    """

    kind = "cylinder"
    POSITIVE = ("radius", "height")
    radius: float = 0.1
    height: float = 0.24

    def shape(self) -> Mesh:
        """Upright, closed by flat discs."""
        r, h = self.radius, self.height / 2
        profile = shapes.straight([[0.0, h], [r, h], [r, -h], [0.0, -h]], self.cell)
        return shapes.lathe(profile, self.cell)


@dataclass(frozen=True, kw_only=True)
class Torus(Body):
    """A ring with a round section.

    Args:
        radius: from its centre to the middle of the section, m.
        tube: radius of the section, m.
    """

    kind = "torus"
    POSITIVE = ("radius", "tube")
    radius: float = 0.12
    tube: float = 0.04

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tube >= self.radius:
            raise UserError(f"tube must be below radius; found {self.tube:g} and {self.radius:g}")

    def shape(self) -> Mesh:
        """The wall sees through its hole."""
        section = shapes.arc(self.tube, 2 * np.pi, 0, self.cell) + np.array([self.radius, 0.0])
        section[-1] = section[0]
        ring = shapes.lathe(section, self.cell)
        return Mesh(ring.vertices @ rotation((90.0, 0.0, 0.0)).T, ring.faces, ring.albedo)


@dataclass(frozen=True, kw_only=True)
class Plate(Body):
    """A flat sheet; its back is black unless surfaces reflect on both sides.

    Args:
        width: along x, m.
        height: along y, m.
    """

    kind = "plate"
    POSITIVE = ("width", "height")
    width: float = 0.3
    height: float = 0.3

    def shape(self) -> Mesh:
        """Parallel to the wall."""
        half = self.width / 2
        return shapes.pulled(np.array([[-half, 0.0], [half, 0.0]]), self.height, self.height)


@dataclass(frozen=True, kw_only=True)
class Fold(Body):
    """A sheet with sharp upright creases: a page, or an accordion; its back is black like a plate's.

    Args:
        width: of the sheet along its panels, m.
        height: along the creases, m.
        creases: how many, up to 100.
        angle: between neighbouring panels, degrees: 180 is flat; below, the first crease points to the wall,
            above, away from it.
    """

    kind = "fold"
    POSITIVE = ("width", "height", "creases")
    width: float = 0.4
    height: float = 0.3
    creases: int = 1
    angle: float = 100.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.angle < 360:
            raise UserError(f"angle must lie between 0 and 360 degrees; found {self.angle!r}")
        if self.creases > 100:
            raise UserError(f"creases may be 100 at most; found {self.creases}")

    def shape(self) -> Mesh:
        """Creases along y, the middle of its depth at 0."""
        slope = np.deg2rad(180 - self.angle) / 2
        panel = self.width / (self.creases + 1)
        n = np.arange(self.creases + 2)
        profile = panel * np.stack([np.cos(slope) * n, -np.sin(slope) * (n % 2)], axis=1)
        profile -= (profile.max(axis=0) + profile.min(axis=0)) / 2
        return shapes.pulled(profile, self.height, panel)


@dataclass(frozen=True, kw_only=True)
class Bend(Body):
    """A sheet bent smoothly into a part of a cylinder; its back is black like a plate's.

    Args:
        width: of the sheet along the bend, m.
        height: along the cylinder's axis, m.
        angle: by which it is bent from edge to edge, degrees: above 0 its middle bulges to the wall, below,
            away from it.
    """

    kind = "bend"
    POSITIVE = ("width", "height")
    width: float = 0.4
    height: float = 0.3
    angle: float = 120.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < abs(self.angle) < 360:
            raise UserError(f"angle must lie within ±360 degrees and not be 0; found {self.angle!r}")

    def shape(self) -> Mesh:
        """The axis along y, the middle of its depth at 0."""
        bent = np.deg2rad(abs(self.angle))
        points = shapes.arc(self.width / bent, -bent / 2, bent / 2, self.cell)
        profile = np.stack([points[:, 1], -np.sign(self.angle) * points[:, 0]], axis=1)
        profile -= (profile.max(axis=0) + profile.min(axis=0)) / 2
        return shapes.pulled(profile, self.height, self.cell)


@dataclass(frozen=True, kw_only=True)
class Text(Body):
    """A word, drawn with a round pen; it reads rightly from the wall.

    Args:
        text: capital letters, digits, ``-``, ``+``, full stops and blanks.
        size: height of a capital between the middles of its strokes, m.
        pen: width of the strokes, m; 0 takes a sixth of ``size``.
        gap: between the middles of the strokes of neighbouring letters, m; 0 takes a third of ``size``.
        depth: thickness, m; 0 is a sheet, black behind.
    """

    kind = "text"
    POSITIVE = ("size",)
    text: str = "NLOS"
    size: float = 0.2
    pen: float = 0.0
    gap: float = 0.0
    depth: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("pen", "gap", "depth"):
            if not 0 <= getattr(self, name) < math.inf:
                raise UserError(f"{name} must be 0 or above; found {getattr(self, name)!r}")
        font.lines(self.text, self.size, self.size)

    def shape(self) -> Mesh:
        """Parallel to the wall."""
        width = self.pen or self.size / 6
        lines = [line * READABLE for line in font.lines(self.text, self.size, self.gap or self.size / 3)]
        sheet = shapes.pen(lines, width, min(self.cell, width / 3))
        return shapes.thickened(sheet, self.depth) if self.depth else sheet


@dataclass(frozen=True, kw_only=True)
class Person(Body):
    """A figure of capsules and a sphere that touch and enter one another.

    Args:
        height: from the soles to the top of the head, m.
        arms: angle of the arms from hanging down, degrees.
        stride: angle between the legs, to the sides, degrees.
    """

    kind = "person"
    POSITIVE = ("height",)
    height: float = 0.6
    arms: float = 40.0
    stride: float = 20.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (0 <= self.arms <= 180 and 0 <= self.stride < 180):
            raise UserError(
                f"arms must lie in 0 … 180 and stride in 0 … 180 degrees; found {self.arms} and {self.stride}"
            )

    def shape(self) -> Mesh:
        """Upright, its breast towards the wall."""
        return shapes.person(self.height, math.radians(self.arms), math.radians(self.stride), self.cell)


BODIES: tuple[type[Body], ...] = (
    Sphere,
    Capsule,
    Cylinder,
    Cone,
    Torus,
    Plate,
    Fold,
    Bend,
    Text,
    Person,
)
KINDS = {body.kind: body for body in BODIES}


def body_from(config: object, name: str = "the body") -> Body:
    """A body from its config.

    Args:
        config: a mapping with ``kind`` and any of that kind's keys.
        name: what messages call it.

    Returns:
        the body.

    Raises:
        UserError: no mapping, an unknown kind or key, or a value that does not suit.

    Examples:
        >>> body_from({"kind": "sphere", "radius": 0.2, "at": [0, 0, 0.7]}).at
        (0.0, 0.0, 0.7)
    """
    example = "{kind: sphere, radius: 0.1, at: [0, 0, 0.6]}"
    if not isinstance(config, Mapping) or "kind" not in config or None in config.values():
        raise UserError(
            f"{name} must be KEY: VALUE pairs, as {example} (blanks after colons); found {config}"
        )
    kind = config["kind"]
    if kind not in KINDS:
        raise UserError(f"{name} has no known kind: found {kind!r}; the kinds are {', '.join(KINDS)}")
    fields = {field.name: field.default for field in dataclasses.fields(KINDS[kind])}
    for key in config:
        if key != "kind" and key not in fields:
            keys = ", ".join(f"{k}: {list(v) if isinstance(v, tuple) else v}" for k, v in fields.items())
            raise UserError(f"{name} ({kind}) has no key {key!r}; its keys, with their defaults, are {keys}")
    try:
        values = {k: _value(k, v, fields[k]) for k, v in config.items() if k != "kind"}
        return KINDS[kind](**values)
    except UserError as error:
        raise UserError(f"{name} ({kind}): {error}") from error


def _value(key: str, value: object, default: object) -> Any:
    """The value in the type of the key's default."""
    if isinstance(default, str):
        if isinstance(value, bool):
            raise UserError(f"{key} must be text; found {value}; write it in quotes")
        return str(value)
    numbers: Any = value if isinstance(value, (list, tuple)) else [value]
    wanted = len(default) if isinstance(default, tuple) else 1
    pair = key == "albedo" and len(numbers) == 2
    if (len(numbers) != wanted and not pair) or not all(
        isinstance(n, (int, float)) and not isinstance(n, bool) for n in numbers
    ):
        raise UserError(f"{key} must be {'a number' if wanted == 1 else f'{wanted} numbers'}; found {value}")
    if isinstance(default, int):
        if not float(numbers[0]).is_integer():
            raise UserError(f"{key} must be a whole number; found {value}")
        return int(numbers[0])
    as_floats = tuple(map(float, numbers))
    return as_floats if wanted > 1 or pair else as_floats[0]


def bodies_from(configs: Iterable[object]) -> tuple[Body, ...]:
    """The bodies of a scene, from a list of configs.

    Args:
        configs: as `body_from` takes them; messages count them from 1.

    Returns:
        the bodies, in that order.

    Raises:
        UserError: there are none, or one makes no sense.
    """
    bodies = tuple(body_from(config, f"body {i}") for i, config in enumerate(configs, 1))
    if not bodies:
        raise UserError(f"found no bodies; give at least one of the kinds {', '.join(KINDS)}")
    return bodies


def one_line(bodies: Iterable[Body]) -> str:
    """Bodies as one argument of ``simulate.py``.

    Examples:
        >>> one_line((Sphere(radius=0.2, albedo=(0.2, 0.9), texture="halves"), Text(text="NO")))
        "bodies=[{kind: sphere, albedo: [0.2, 0.9], texture: halves, radius: 0.2}, {kind: text, text: 'NO'}]"
    """

    def told(key: str, value: object) -> str:
        if isinstance(value, list):
            return f"[{', '.join(f'{number:.10g}' for number in value)}]"
        if isinstance(value, str):
            return repr(value) if key == "text" else value
        return f"{value:.10g}"

    pairs = [", ".join(f"{k}: {told(k, v)}" for k, v in body.config().items()) for body in bodies]
    return f"bodies=[{', '.join(f'{{{line}}}' for line in pairs)}]"


def assemble(bodies: Iterable[Body]) -> Mesh:
    """Bodies as one mesh; they may hide, touch and enter one another."""
    return join(*(body.mesh() for body in bodies))

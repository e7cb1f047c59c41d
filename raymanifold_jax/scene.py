"""The scene: solids, medium, lights and sides around one lattice.

Symbols and units: albedo rho (1), emission of a surface (emitted radiance, W m^-2 sr^-1), scattering zeta and
absorption gamma (1 / scene length), emission of a medium (W m^-3 sr^-1), radiance (W m^-2 sr^-1), irradiance (W
m^-2).

Every physical number is a leaf, a JAX array in the default float dtype, so that `jax.grad` and `equinox.tree_at`
reach it; positions and directions are float64 numpy leaves. Any value may carry a trailing axis of *bands* (RGB or
any number); all values of a scene that carry one agree on its length, and a value without one is the same in every
band.

Public names: `Scene`, `Solid`, `Wall`, `Medium`, `Sky`, `Sun`, `PointLight`, `Boundary`, `Side`, `OPEN`, `MIRROR`,
`PERIODIC`.
"""

import enum
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from . import checks
from .arrays import as_jax, real_dtype
from .lattice import Lattice
from .shapes import Shape, least, safe_norm
from .texture import Texture


@jax.tree_util.register_static
class Side(enum.Enum):
    """What a side of the domain does, where it is not a `Wall`. Static: a part of the tree without leaves."""

    OPEN = "light leaves, and light from outside comes in"
    MIRROR = "light is reflected as by a perfect mirror"
    PERIODIC = "light that leaves comes in again at the opposite side"

    def __repr__(self) -> str:
        return self.name


OPEN, MIRROR, PERIODIC = Side.OPEN, Side.MIRROR, Side.PERIODIC


class Solid(eqx.Module):
    """A body with a Lambertian surface.

    **Arguments:**

    - `shape`: where it is.
    - `albedo`: Lambertian reflectance in [0, 1], () or (bands,), or a `Texture` of it.
    - `emission`: radiance its surface emits, >= 0, () or (bands,).
    """

    shape: Shape
    albedo: Float[jax.Array, "..."] | Texture
    emission: Float[jax.Array, "..."]

    def __init__(self, shape: Shape, albedo: Any = 0.5, emission: Any = 0.0):
        checks.instance("shape", shape, Shape, "pass a shape such as Sphere((0.5, 0.5, 0.5), 0.2)")
        self.shape = shape
        self.albedo = _albedo(albedo)
        self.emission = _banded("emission", checks.non_negative("emission", emission))


class Wall(eqx.Module):
    """A side of the domain closed by a Lambertian wall, on its inner face.

    **Arguments:** `albedo` in [0, 1] and `emission` (emitted radiance) >= 0, each () or (bands,), or the albedo a `Texture`.
    """

    albedo: Float[jax.Array, "..."] | Texture
    emission: Float[jax.Array, "..."]

    def __init__(self, albedo: Any = 0.5, emission: Any = 0.0):
        self.albedo = _albedo(albedo)
        self.emission = _banded("emission", checks.non_negative("emission", emission))


class Medium(eqx.Module):
    """A medium that scatters isotropically, absorbs and emits, in the space the solids leave free.

    **Arguments:** each >= 0, with shape (), (bands,), (nx, ny, nz) or (nx, ny, nz, bands):

    - `scattering`, `absorption`: per unit length.
    - `emission`: emitted radiance per unit length.
    """

    scattering: Float[jax.Array, "..."]
    absorption: Float[jax.Array, "..."]
    emission: Float[jax.Array, "..."]

    def __init__(self, scattering: Any = 0.0, absorption: Any = 0.0, emission: Any = 0.0):
        self.scattering = _voxel_field("scattering", scattering)
        self.absorption = _voxel_field("absorption", absorption)
        self.emission = _voxel_field("emission", emission)

    def coefficients(self) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Scattering, absorption and emission with four axes each, to broadcast against (nx, ny, nz, bands)."""
        scattering, absorption, emission = map(_four_axes, (self.scattering, self.absorption, self.emission))
        return scattering, absorption, emission

    @property
    def extinction(self) -> jax.Array:
        """scattering + absorption, with four axes, to broadcast against (nx, ny, nz, bands)."""
        scattering, absorption, _ = self.coefficients()
        return scattering + absorption


class DirectionFunction(eqx.Module):
    """A plain function of direction as a part of the tree without leaves."""

    function: Callable[[jax.Array], jax.Array] = eqx.field(static=True)

    def __call__(self, directions: jax.Array) -> jax.Array:
        return self.function(directions)


class Sky(eqx.Module):
    """Light that enters the open sides from far away.

    **Arguments:**

    - `radiance`, >= 0, one of
        - constant: () or (bands,);
        - a latitude-longitude image (h, 2h) or (h, 2h, bands), h >= 2: row 0 is at the zenith (+z) and column 0 at
          azimuth 0 (+x), azimuth increasing towards +y. Pixel (i, j) is centred at polar angle pi (i + 1/2) / h and
          azimuth pi (j + 1/2) / h; between centres it is interpolated, across the seam and the poles too;
        - a function of the directions *towards* the sky, (n, 3) -> (n,) or (n, bands), written in `jax.numpy`. A plain
          function is static; an `equinox.Module` that can be called keeps its leaves. `rm.skies` has the CIE standard skies.
    - `hemisphere`: if given, only the half of the sky around this direction (3,) shines.
    """

    radiance: Any
    hemisphere: Float[checks.Numbers, " 3"] | None

    def __init__(self, radiance: Any = 1.0, hemisphere: Any = None):
        if callable(radiance):
            _check_sky_function(radiance)
            keeps_leaves = isinstance(radiance, eqx.Module)
            self.radiance = radiance if keeps_leaves else DirectionFunction(radiance)  # pyright: ignore
        else:
            self.radiance = _sky_values(radiance)
        self.hemisphere = None if hemisphere is None else checks.unit_vector("hemisphere", hemisphere)

    def radiance_along(self, directions: Float[Any, "n 3"]) -> Float[jax.Array, "n ..."]:
        """Sky radiance travelling along unit `directions` (n, 3): light that travels along w comes from -w.

        Shape (n,), or (n, bands) if the sky has bands. On the edge of `hemisphere` half of it.
        """
        directions = checks.coordinates("directions", directions)
        if directions.ndim != 2:
            checks.fail("directions", f"an array of shape {directions.shape}", "shape (n, 3)", "reshape to (-1, 3)")
        towards = -directions
        if callable(self.radiance):
            radiance = jnp.asarray(self.radiance(towards))
        elif self.radiance.ndim < 2:
            radiance = jnp.broadcast_to(self.radiance, (len(towards), *self.radiance.shape))
        else:
            radiance = _look_up(self.radiance, towards)
        if self.hemisphere is None:
            return radiance
        height = towards @ jnp.asarray(self.hemisphere, towards.dtype)
        share = jnp.heaviside(height, 0.5).astype(radiance.dtype)
        return radiance * share.reshape(share.shape + (1,) * (radiance.ndim - 1))


class Sun(eqx.Module):
    """Parallel light.

    **Arguments:**

    - `direction`: direction of travel (3,), of any length but 0; kept at length 1.
    - `irradiance`: on a surface across the beam, >= 0, () or (bands,).
    """

    direction: Float[checks.Numbers, " 3"]
    irradiance: Float[jax.Array, "..."]

    def __init__(self, direction: Any, irradiance: Any = 1.0):
        self.direction = checks.unit_vector("direction", direction)
        self.irradiance = _banded("irradiance", checks.non_negative("irradiance", irradiance))


class PointLight(eqx.Module):
    """Light from a point, the same in all directions.

    **Arguments:**

    - `position`: (3,), in scene units.
    - `intensity`: power per solid angle (W sr^-1), >= 0, () or (bands,).
    """

    position: Float[checks.Numbers, " 3"]
    intensity: Float[jax.Array, "..."]

    def __init__(self, position: Any, intensity: Any = 1.0):
        self.position = checks.vector3("position", position)
        self.intensity = _banded("intensity", checks.non_negative("intensity", intensity))


Light: TypeAlias = Sky | Sun | PointLight
AnySide: TypeAlias = Side | Wall


class Boundary(eqx.Module):
    """What the six sides of the domain do.

    **Arguments:** `x`, `y`, `z`: each `OPEN`, `MIRROR`, `PERIODIC` or a `Wall` for both sides of that axis, or a pair
    (lower side, upper side). `PERIODIC` holds for both sides of an axis or for none (`ValueError`).
    """

    x: AnySide | tuple[AnySide, AnySide]
    y: AnySide | tuple[AnySide, AnySide]
    z: AnySide | tuple[AnySide, AnySide]

    def __init__(self, x: Any = OPEN, y: Any = OPEN, z: Any = OPEN):
        self.x, self.y, self.z = _axis("x", x), _axis("y", y), _axis("z", z)

    @property
    def sides(self) -> tuple[AnySide, ...]:
        """The sides x-, x+, y-, y+, z-, z+."""
        pairs = (side if isinstance(side, tuple) else (side, side) for side in (self.x, self.y, self.z))
        return tuple(side for pair in pairs for side in pair)

    @property
    def periodic(self) -> tuple[bool, bool, bool]:
        """Whether x, y and z are periodic."""
        x, y, z = (side is PERIODIC for side in self.sides[::2])
        return x, y, z


class Scene(eqx.Module):
    """Everything light meets.

    **Arguments:**

    - `lattice`: the voxels of the domain.
    - `solids`: any number of `Solid`.
    - `medium`: a `Medium`, or None for vacuum.
    - `lights`: any number of `Sky`, `Sun`, `PointLight`.
    - `boundary`: what the six sides do; open by default.

    **Raises** `TypeError` for a wrong kind of part, `ValueError` for numbers of bands that differ and for a medium
    that does not fit the lattice.
    """

    lattice: Lattice
    solids: tuple[Solid, ...]
    medium: Medium | None
    lights: tuple[Light, ...]
    boundary: Boundary

    def __init__(
        self,
        lattice: Lattice,
        solids: Any = (),
        medium: Medium | None = None,
        lights: Any = (),
        boundary: Boundary | None = None,
    ):
        checks.instance("lattice", lattice, Lattice, "pass Lattice((64, 64, 64), spacing=1 / 64)")
        self.lattice = lattice
        self.solids = _parts("solids", solids, (Solid,))
        if medium is not None:
            checks.instance("medium", medium, Medium, "wrap the numbers: Medium(scattering=..., absorption=...)")
        self.medium = medium
        self.lights = _parts("lights", lights, (Sky, Sun, PointLight))
        boundary = Boundary() if boundary is None else boundary
        checks.instance("boundary", boundary, Boundary, "name the axes: Boundary(x=..., y=..., z=...)")
        self.boundary = boundary
        for name in ("scattering", "absorption", "emission"):
            value = getattr(medium, name, None)
            if value is not None and value.ndim >= 3 and value.shape[:3] != lattice.shape:
                expected = f"{lattice.shape}, one value a voxel, with or without a last axis of bands"
                advice = "resample it, or change the lattice's shape"
                checks.fail(f"medium.{name}", f"an array of shape {value.shape}", expected, advice)
        counts = dict(self._band_axes())
        if len(set(counts.values())) > 1:
            got = ", ".join(f"{name}: {count}" for name, count in counts.items())
            expected = "one number of bands throughout"
            checks.fail("bands", got, expected, "a value without a band axis holds for all bands")

    def _band_axes(self) -> Iterator[tuple[str, int]]:
        named = [(f"solids[{i}]", solid) for i, solid in enumerate(self.solids)]
        named += [(f"boundary {name}", side) for name, side in zip(SIDES, self.boundary.sides, strict=True)]
        for name, part in named:
            if isinstance(part, Solid | Wall):
                yield from _last_axis(f"{name}.albedo", part.albedo, (1,))
                yield from _last_axis(f"{name}.emission", part.emission, (1,))
        if self.medium is not None:
            yield from _last_axis("medium.scattering", self.medium.scattering, (1, 4))
            yield from _last_axis("medium.absorption", self.medium.absorption, (1, 4))
            yield from _last_axis("medium.emission", self.medium.emission, (1, 4))
        for i, light in enumerate(self.lights):
            if isinstance(light, Sun):
                yield from _last_axis(f"lights[{i}].irradiance", light.irradiance, (1,))
            elif isinstance(light, PointLight):
                yield from _last_axis(f"lights[{i}].intensity", light.intensity, (1,))
            elif callable(light.radiance):
                directions = jax.ShapeDtypeStruct((2, 3), real_dtype())
                radiance = eqx.filter_eval_shape(light.radiance_along, directions)
                yield from _last_axis(f"lights[{i}].radiance", radiance, (2,))
            else:
                yield from _last_axis(f"lights[{i}].radiance", light.radiance, (1, 3))

    @property
    def banded(self) -> bool:
        """Whether any value has a band axis, so that results have one."""
        return any(True for _ in self._band_axes())

    @property
    def bands(self) -> int:
        """The number of bands; 1 if no value has a band axis."""
        return next((count for _, count in self._band_axes()), 1)

    def distance(self, points: Float[Any, "*batch 3"]) -> Float[jax.Array, "*batch"]:
        """Signed distance of `points` (..., 3) to the union of the solids, in scene units; 1e9 voxels if none."""
        points = checks.coordinates("points", points)
        if not self.solids:
            return jnp.full(points.shape[:-1], 1e9 * self.lattice.spacing, points.dtype)
        return least(tuple(solid.shape.distance(points) for solid in self.solids))

    def solid_at(self, points: Float[Any, "*batch 3"]) -> Int[jax.Array, "*batch"]:
        """Index into `solids` of the one nearest to (or deepest around) each of `points` (..., 3); -1 if none."""
        points = checks.coordinates("points", points)
        if not self.solids:
            return jnp.full(points.shape[:-1], -1)
        return jnp.argmin(jnp.stack([solid.shape.distance(points) for solid in self.solids]), axis=0)

    def summary(self) -> str:
        """The scene in one line."""
        parts = [" x ".join(map(str, self.lattice.shape)) + f" voxels of {self.lattice.spacing:.4g}"]
        parts.append(_count(len(self.solids), "solid"))
        parts.append("vacuum" if self.medium is None else "medium")
        kinds = Counter(type(light).__name__ for light in self.lights)
        lit = " + ".join(kind if number == 1 else f"{number} x {kind}" for kind, number in kinds.items())
        parts.append(f"light: {lit or 'none'}")
        if self.banded:
            parts.append(_count(self.bands, "band"))
        sides = ["wall" if isinstance(side, Wall) else side.name.lower() for side in self.boundary.sides]
        axes = (
            f"{axis} {a}" if a == b else f"{axis} {a}/{b}" for axis, a, b in zip("xyz", sides[::2], sides[1::2], strict=True)
        )
        return ", ".join(parts) + "; sides " + ", ".join(axes)

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        from .display import scene_html

        return scene_html(self)


SIDES = ("x-", "x+", "y-", "y+", "z-", "z+")


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


def _last_axis(name: str, value: Any, ranks: tuple[int, ...]) -> Iterator[tuple[str, int]]:
    # `ranks`: those with which this kind of value has bands on its last axis.
    if value.ndim in ranks:
        yield name, value.shape[-1]


def _leaf(value: checks.Numbers) -> jax.Array:
    return as_jax(value, float) if isinstance(value, jax.Array) else as_jax(np.array(value, real_dtype()))


def _albedo(albedo: Any) -> Any:
    if isinstance(albedo, Texture):
        checks.in_unit_interval("albedo.values", albedo.values)
        return albedo
    return _banded("albedo", checks.in_unit_interval("albedo", albedo))


def _banded(name: str, value: checks.Numbers) -> jax.Array:
    if value.ndim > 1 or value.shape == (0,):
        checks.fail(name, f"an array of shape {value.shape}", "a number or shape (bands,)", "pass one value for each band")
    return _leaf(value)


def _voxel_field(name: str, value: Any) -> jax.Array:
    numbers = checks.non_negative(name, value)
    if numbers.ndim not in (0, 1, 3, 4) or 0 in numbers.shape:
        expected = "a number or shape (bands,), (nx, ny, nz) or (nx, ny, nz, bands)"
        checks.fail(name, f"an array of shape {numbers.shape}", expected, "give three voxel axes, of length 1 voxel if thin")
    return _leaf(numbers)


def _four_axes(value: jax.Array) -> jax.Array:
    return value[..., None] if value.ndim == 3 else value.reshape((1,) * (4 - value.ndim) + value.shape)


def _sky_values(radiance: Any) -> jax.Array:
    numbers = checks.non_negative("radiance", radiance)
    image = numbers.ndim in (2, 3)
    if image and (numbers.shape[0] < 2 or numbers.shape[1] != 2 * numbers.shape[0]):
        expected = "a latitude-longitude image (h, 2h) or (h, 2h, bands) with h >= 2"
        checks.fail("radiance", f"an image of shape {numbers.shape}", expected, "resample it to twice as wide as high")
    if numbers.ndim > 3 or 0 in numbers.shape:
        expected = "a number, (bands,), (h, 2h), (h, 2h, bands) or a function of direction"
        checks.fail("radiance", f"an array of shape {numbers.shape}", expected, "give one band axis, the last")
    return _leaf(numbers)


def _check_sky_function(function: Callable[[jax.Array], Any]) -> None:
    advice = "write it in jax.numpy, as in lambda w: jnp.maximum(w[:, 2], 0)"
    # The 26 directions of a cube's corners, edges and faces: n is unlikely to pass for a number of bands.
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid[np.any(grid != 0, axis=-1)]
    directions = jnp.asarray(grid / np.linalg.norm(grid, axis=-1, keepdims=True), dtype=float)
    try:
        radiance = eqx.filter_jit(lambda w: jnp.asarray(function(w)))(directions)
    except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError) as error:
        expected = "a function that JAX can trace"
        raise TypeError(f"radiance: got {function!r}, expected {expected}; {advice}") from error
    radiance = checks.non_negative("radiance of a direction", radiance)
    if radiance.ndim not in (1, 2) or len(radiance) != len(directions) or 0 in radiance.shape:
        got = f"a function that takes {directions.shape} to {radiance.shape}"
        checks.fail("radiance", got, "(n, 3) -> (n,) or (n, bands)", advice)


def _look_up(image: jax.Array, towards: jax.Array) -> jax.Array:
    height, width = image.shape[:2]
    polar = jnp.arctan2(safe_norm(towards[:, :2]), towards[:, 2])
    azimuth = jnp.arctan2(towards[:, 1], towards[:, 0])
    # Beyond a pole the image goes on at the opposite azimuth; one such row is added at each end.
    rows = [jnp.roll(image[:1], height, axis=1), image, jnp.roll(image[-1:], height, axis=1)]
    image = jnp.concatenate(rows)
    row = polar * (height / jnp.pi) + 0.5
    column = azimuth * (height / jnp.pi) - 0.5
    i = jnp.clip(jnp.floor(row), 0, height).astype(int)
    j = jnp.floor(column).astype(int)
    pad = (slice(None), *(None,) * (image.ndim - 2))
    s, t = (row - i)[pad], (column - j)[pad]
    j, after = j % width, (j + 1) % width
    upper = (1 - t) * image[i, j] + t * image[i, after]
    lower = (1 - t) * image[i + 1, j] + t * image[i + 1, after]
    return (1 - s) * upper + s * lower


def _axis(name: str, value: Any) -> Any:
    pair = isinstance(value, list | tuple)
    sides = tuple(value) if pair else (value, value)
    if len(sides) != 2:
        checks.fail(name, f"{len(sides)} sides", "one side for both, or a pair (lower, upper)", f"{name}=(OPEN, Wall())")
    for side in sides:
        checks.instance(name, side, (Side, Wall), f"pass OPEN, MIRROR, PERIODIC or Wall(albedo=...), as in {name}=OPEN")
    if (sides[0] is PERIODIC) != (sides[1] is PERIODIC):
        checks.fail(name, sides, "PERIODIC on both sides of an axis or on none", f"write {name}=PERIODIC")
    return sides if pair else value


def _parts(name: str, parts: Any, kinds: tuple[type, ...]) -> tuple[Any, ...]:
    if not isinstance(parts, list | tuple):
        advice = f"put it in a list: {name}=[...]"
        checks.fail(name, f"a {type(parts).__name__}", f"a list of {' or '.join(k.__name__ for k in kinds)}", advice, TypeError)
    for i, part in enumerate(parts):
        advice = f"put {' or '.join(k.__name__ + '(...)' for k in kinds)} in {name}"
        if isinstance(part, Shape) and Solid in kinds:
            advice = f"wrap it: Solid({type(part).__name__}(...), albedo=0.5)"
        elif isinstance(part, Solid | Wall):
            advice = "a Solid goes in solids and a Wall in boundary; both shine if emission > 0"
        elif isinstance(part, Sky | Sun | PointLight):
            advice = f"a {type(part).__name__} goes in lights"
        checks.instance(f"{name}[{i}]", part, kinds, advice)
    return tuple(parts)

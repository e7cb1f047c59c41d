"""Skies without a picture of one: the CIE standard general sky, for `rm.Sky`.

Sixteen distributions of brightness, from heavily overcast to cloudless (ISO 15469:2004, CIE S 011/E:2003). With the angle Z
of a point of the sky from the zenith, that of the sun Z_s, and the angle chi between the two, its radiance is

    L / L_z = phi(Z) f(chi) / (phi(0) f(Z_s)),
    phi(Z)  = 1 + a exp(b / cos Z)                                          gradation from horizon to zenith
    f(chi)  = 1 + c (exp(d chi) - exp(d pi / 2)) + e cos^2 chi              scattering indicatrix, around the sun

Kinds 1 to 15 are rows of coefficients a to e; kind 16 is the older overcast sky, L / L_z = (1 + 2 cos Z) / 3. A standard sky is
a distribution, the same in all bands; its colour is that of the value at the zenith.

Public names: `cie`, `CieSky`, `KINDS`, `SUNLESS`.
"""

from __future__ import annotations

import operator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from . import checks
from .shapes import safe_norm

#: a, b (gradation) and c, d, e (indicatrix) of kinds 1 to 15, ISO 15469:2004, table 1.
KINDS: dict[int, tuple[float, float, float, float, float]] = {
    1: (4.0, -0.70, 0.0, -1.0, 0.0),  # standard overcast, steep gradation
    2: (4.0, -0.70, 2.0, -1.5, 0.15),  # overcast, steep, slightly brighter towards the sun
    3: (1.1, -0.80, 0.0, -1.0, 0.0),  # overcast, moderately graded
    4: (1.1, -0.80, 2.0, -1.5, 0.15),  # overcast, moderately graded, slightly brighter towards the sun
    5: (0.0, -1.00, 0.0, -1.0, 0.0),  # uniform
    6: (0.0, -1.00, 2.0, -1.5, 0.15),  # partly cloudy, no gradation, slightly brighter towards the sun
    7: (0.0, -1.00, 5.0, -2.5, 0.30),  # partly cloudy, no gradation, brighter around the sun
    8: (0.0, -1.00, 10.0, -3.0, 0.45),  # partly cloudy, no gradation, distinct corona
    9: (-1.0, -0.55, 2.0, -1.5, 0.15),  # partly cloudy, sun obscured
    10: (-1.0, -0.55, 5.0, -2.5, 0.30),  # partly cloudy, brighter around the sun
    11: (-1.0, -0.55, 10.0, -3.0, 0.45),  # white-blue, distinct corona
    12: (-1.0, -0.32, 10.0, -3.0, 0.45),  # standard clear, low turbidity
    13: (-1.0, -0.32, 16.0, -3.0, 0.30),  # standard clear, polluted
    14: (-1.0, -0.15, 16.0, -3.0, 0.30),  # cloudless, turbid, broad corona
    15: (-1.0, -0.15, 24.0, -2.8, 0.15),  # white-blue, turbid, broad corona
}
_OLD_OVERCAST = 16
#: Kinds that are the same in all azimuths.
SUNLESS = (1, 3, 5, _OLD_OVERCAST)
_HEIGHTS, _AZIMUTHS = 128, 256  # of the integral over the sky


class CieSky(eqx.Module):
    """A CIE standard general sky as a function of the direction towards it; made by `cie`."""

    zenith: Float[jax.Array, "..."]
    ground: Float[jax.Array, "..."]
    sun_direction: Float[checks.Numbers, " 3"] | None
    up: Float[checks.Numbers, " 3"]
    kind: int = eqx.field(static=True)

    def __call__(self, directions: Float[jax.Array, "n 3"]) -> Float[jax.Array, "n ..."]:
        """Radiance of the sky in unit `directions` (n, 3) towards it: (n,) or (n, bands)."""
        height = directions @ jnp.asarray(self.up, directions.dtype)
        banded = max(self.zenith.ndim, self.ground.ndim) > 0
        relative, above = self._relative(directions, height), height >= 0
        if banded:
            relative, above = relative[:, None], above[:, None]
        return jnp.where(above, relative * self.zenith, self.ground)

    def _relative(self, directions: jax.Array, height: jax.Array) -> jax.Array:
        """L / L_z where the sky is; above the horizon `height` is cos Z."""
        if self.kind == _OLD_OVERCAST:
            return (1 + 2 * height) / 3
        a, b, c, d, e = KINDS[self.kind]
        # phi is 1 at the horizon, where cos Z is 0.
        gradation = lambda cosine: 1 + a * jnp.where(cosine > 0, jnp.exp(b / jnp.where(cosine > 0, cosine, 1)), 0)
        relative = gradation(height) / (1 + a * np.exp(b))
        if self.sun_direction is None:
            return relative
        indicatrix = lambda chi: 1 + c * (jnp.exp(d * chi) - np.exp(d * np.pi / 2)) + e * jnp.cos(chi) ** 2
        to_sun, up = (jnp.asarray(v, directions.dtype) for v in (-self.sun_direction, self.up))
        return relative * indicatrix(_angle(directions, to_sun)) / indicatrix(_angle(up, to_sun))


def cie(
    kind: int,
    sun_direction: Any = None,
    zenith: Any = None,
    irradiance: Any = None,
    up: Any = (0.0, 0.0, 1.0),
    ground: Any = 0.0,
) -> CieSky:
    """A CIE standard general sky, as in `rm.Sky(rm.skies.cie(12, sun_direction=(0.5, 0.2, -1)))`.

    **Arguments:**

    - `kind`: 1 to 16; 1 is the standard overcast sky, 5 is uniform, 12 the standard clear sky, 16 the older overcast one.
    - `sun_direction`: the direction in which sunlight travels (3,), downwards, as of `rm.Sun`: the sun itself is a light of its
      own. Kinds 1, 3, 5 and 16 have none.
    - `zenith`: radiance at the zenith, >= 0, () or (bands,); 1 by default. Or
    - `irradiance`: what the sky sends on level ground that sees all of it, >= 0, () or (bands,); weather stations call it
      diffuse horizontal.
    - `up`: towards the zenith (3,).
    - `ground`: radiance from below the horizon, >= 0, () or (bands,).

    **Raises** `ValueError` for another kind, a sun below the horizon, both of `zenith` and `irradiance`, numbers of bands that
    differ, and numbers out of their range; `TypeError` for a kind that is no whole number.
    """
    kind = _kind(kind)
    up = checks.unit_vector("up", up)
    sun = None if sun_direction is None else checks.unit_vector("sun_direction", sun_direction)
    if kind in SUNLESS:
        sun = None
    elif sun is None:
        expected = f"the direction of travel of sunlight, which kind {kind} depends on"
        checks.fail("sun_direction", "none", expected, "pass that of your rm.Sun, as in (0.5, 0.2, -1)")
    elif not checks.is_traced((sun, up)) and sun @ up > 1e-9:
        expected = "a sun at or above the horizon, whose light travels downwards"
        checks.fail("sun_direction", np.asarray(sun).tolist(), expected, "turn its sign if it points towards the sun")
    if zenith is not None and irradiance is not None:
        checks.fail("zenith", "irradiance as well", "one of zenith and irradiance", "leave one out")
    name, given = ("zenith", 1.0 if zenith is None else zenith) if irradiance is None else ("irradiance", irradiance)
    values = {key: jnp.asarray(checks.non_negative(key, value), float) for key, value in ((name, given), ("ground", ground))}
    for key, value in values.items():
        if value.ndim > 1 or 0 in value.shape:
            checks.fail(key, f"an array of shape {value.shape}", "a number or (bands,)", "give one number a band")
    if len({value.shape for value in values.values() if value.ndim}) > 1:
        got = " and ".join(f"{key} of {value.size}" for key, value in values.items())
        checks.fail("bands", got, "one number of bands", "a value without a band axis holds for all bands")
    sky = CieSky(jnp.ones(()), jnp.zeros(()), sun, up, kind)
    value = values[name] if irradiance is None else values[name] / _level_irradiance(sky)
    return CieSky(value, values["ground"], sun, up, kind)


def _kind(kind: Any) -> int:
    try:
        number = None if isinstance(kind, bool | np.bool_) else operator.index(kind)
    except TypeError:
        number = None
    advice = "1 is overcast, 5 uniform, 12 clear"
    if number is None:
        checks.fail("kind", repr(kind), "a whole number from 1 to 16", advice, TypeError)
    if number not in KINDS and number != _OLD_OVERCAST:
        checks.fail("kind", number, "a whole number from 1 to 16", advice)
    return number


def _angle(a: jax.Array, b: jax.Array) -> jax.Array:
    """Between unit vectors; exact also where they are close, unlike arccos."""
    return jnp.arctan2(safe_norm(jnp.cross(a, b)), jnp.sum(a * b, -1))


def _level_irradiance(sky: CieSky) -> jax.Array:
    """Irradiance of level ground: Gauss-Legendre in cos Z, the midpoint rule in azimuth."""
    nodes, weights = np.polynomial.legendre.leggauss(_HEIGHTS)
    cosine = (nodes + 1) / 2
    azimuth = 2 * np.pi * (np.arange(_AZIMUTHS) + 0.5) / _AZIMUTHS
    sine = np.sqrt(1 - cosine**2)
    parts = (
        sine[:, None] * np.cos(azimuth),
        sine[:, None] * np.sin(azimuth),
        np.broadcast_to(cosine[:, None], (_HEIGHTS, _AZIMUTHS)),
    )
    # The frame: z is up; which way x points does not matter to the integral.
    up = jnp.asarray(sky.up, float)
    aside = jnp.eye(3)[jnp.argmin(jnp.abs(up))]
    x = jnp.cross(aside, up) / safe_norm(jnp.cross(aside, up))
    directions = jnp.asarray(np.stack(parts, -1).reshape(-1, 3), float) @ jnp.stack([x, jnp.cross(up, x), up])
    share = np.repeat(weights / 2 * cosine, _AZIMUTHS) * 2 * np.pi / _AZIMUTHS
    return jnp.asarray(share, float) @ sky(directions)


__all__ = ["KINDS", "SUNLESS", "CieSky", "cie"]

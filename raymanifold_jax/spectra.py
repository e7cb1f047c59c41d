"""Bands of wavelength, the spectra of known materials and lights in them, and colours of what comes out.

A scene's bands are intervals in nm; its values are means over each of them, lights and radiances are per nm. With the CIE 1931
2-degree colour matching functions xbar, ybar, zbar

    XYZ = M L,      M_ib = integral over band b of xyzbar_i dlambda / integral of ybar dlambda,

so that a radiance of 1 in every band has Y = 1 if the bands cover the visible; linear sRGB is one matrix more. Given the
illuminant whose colour is to look white, XYZ is adapted to it (Bradford) and Y is relative to it.

Spectra are those of colour-science, which is imported at the first use.

Public names: `Bands`, `write_spectral_exr`.
"""

from __future__ import annotations

import dataclasses
import difflib
import os
import sys
import warnings
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float

from . import checks

_FINE = 1.0  # nm: integrals are sums over steps of about this
_SHORTEST, _LONGEST = 100.0, 20000.0
_CHECKER = "ColorChecker N Ohta"


@dataclasses.dataclass(frozen=True)
class Bands:
    """Intervals of wavelength in nm.

    **Arguments:** one of `edges`, n + 1 increasing numbers, for n bands side by side; or `centres`, n increasing numbers, whose
    bands end half-way between them (the first and the last are as wide as on their inner side; a single one is 1 nm wide).

    **Raises** `ValueError` for numbers that do not increase or lie outside 100 to 20000 nm.
    """

    edges: tuple[float, ...]

    def __init__(self, edges: Any = None, centres: Any = None):
        if (edges is None) == (centres is None):
            checks.fail("Bands", "both or neither of edges and centres", "one of them", "pass edges=[400, 500, 600, 700]")
        name, given = ("edges", edges) if centres is None else ("centres", centres)
        values = np.asarray(checks.finite(name, given), float)
        least = 2 if centres is None else 1
        if values.ndim != 1 or len(values) < least or (np.diff(values) <= 0).any():
            checks.fail(name, given, f"{least} or more increasing wavelengths in nm", "pass edges=[400, 500, 600, 700]")
        if values[0] < _SHORTEST or values[-1] > _LONGEST:
            expected = f"wavelengths from {_SHORTEST:g} to {_LONGEST:g} nm"
            checks.fail(name, given, expected, "500 is green; a micrometre is 1000")
        if centres is not None:
            half = np.diff(values) / 2 if len(values) > 1 else np.array([0.5])
            inner = (values[:-1] + values[1:]) / 2
            values = np.concatenate([[values[0] - half[0]], inner, [values[-1] + half[-1]]])
        object.__setattr__(self, "edges", tuple(float(v) for v in values))

    def __len__(self) -> int:
        return len(self.edges) - 1

    @property
    def centres(self) -> Float[np.ndarray, " n"]:
        edges = np.array(self.edges)
        return (edges[:-1] + edges[1:]) / 2

    @property
    def widths(self) -> Float[np.ndarray, " n"]:
        return np.diff(self.edges)

    # Spectra, as means over the bands

    def mean(self, wavelengths: Any, values: Any) -> Float[np.ndarray, " n"]:
        """Means of a measured spectrum, linear between its wavelengths (nm) and constant beyond them."""
        x = np.asarray(checks.finite("wavelengths", wavelengths), float)
        y = np.asarray(checks.finite("values", values), float)
        if x.ndim != 1 or x.shape != y.shape or not len(x) or (np.diff(x) <= 0).any():
            got = f"shapes {x.shape} and {y.shape}"
            checks.fail("wavelengths", got, "as many increasing wavelengths as values", "sort them, and drop repeated ones")
        return self._mean(lambda w: np.interp(w, x, y))

    def illuminant(self, name: str) -> Float[np.ndarray, " n"]:
        """A CIE illuminant ("D65", "A", "FL2", ...), scaled to Y = 1."""
        return self._light(_chosen("illuminant", name, _colour().SDS_ILLUMINANTS))

    def blackbody(self, temperature: float) -> Float[np.ndarray, " n"]:
        """Planck's spectrum at a temperature in K, scaled to Y = 1."""
        kelvin = float(checks.positive("temperature", temperature, ()))
        # h c / k = 1.438777e7 nm K; the scale cancels, the exponent is kept within the float type.
        planck = lambda w: w**-5.0 / np.expm1(np.minimum(1.438776877e7 / (w * kelvin), 700.0))
        return self._mean(planck) / _luminance(planck)

    def reflectance(self, name: str) -> Float[np.ndarray, " n"]:
        """A patch of the ColorChecker ("dark skin", "white 9.5 (.05 D)", ...)."""
        spectrum = _chosen("reflectance", name, _colour().SDS_COLOURCHECKERS[_CHECKER])
        return np.clip(self.mean(spectrum.wavelengths, spectrum.values), 0.0, 1.0)

    def _light(self, spectrum: Any) -> Float[np.ndarray, " n"]:
        values = lambda w: np.interp(w, spectrum.wavelengths, spectrum.values)
        return self._mean(values) / _luminance(values)

    def _mean(self, spectrum: Any) -> Float[np.ndarray, " n"]:
        means = []
        for a, c in zip(self.edges[:-1], self.edges[1:], strict=True):
            count = max(8, int(np.ceil((c - a) / _FINE)))
            means.append(spectrum(a + (np.arange(count) + 0.5) * (c - a) / count).mean())
        return np.array(means)

    # Colours

    def xyz_matrix(self, white: Any = None) -> Float[np.ndarray, "3 n"]:
        """Band values to CIE XYZ (1931, 2 degrees).

        Without `white`, the equal-energy spectrum 1 has Y = 1. With the name of an illuminant, or a list of band values, that
        light has the XYZ of sRGB's white (D65, Y = 1) and other colours are adapted along (Bradford).
        """
        wavelengths, *matching = _matching()
        means = [self._mean(lambda w, m=m: np.interp(w, wavelengths, m, left=0, right=0)) for m in matching]
        matrix = np.stack(means) * self.widths
        matrix = matrix / _matching()[2].sum()
        if white is None:
            return matrix
        values = self.illuminant(white) if isinstance(white, str) else checks.non_negative("white", white, (len(self),))
        source = matrix @ values
        if not (source > 0).all():
            checks.fail("white", white, "a light with some of every colour", "cover 400 to 700 nm with three bands or more")
        cone = _BRADFORD @ source
        target = _BRADFORD @ _D65
        return np.linalg.inv(_BRADFORD) @ np.diag(target / cone) @ _BRADFORD @ matrix

    def rgb_matrix(self, white: Any = None) -> Float[np.ndarray, "3 n"]:
        """Band values to linear sRGB; `white` as for `xyz_matrix`."""
        return _XYZ_TO_RGB @ self.xyz_matrix(white)

    def to_rgb(self, image: Any, white: Any = None) -> Float[np.ndarray, "*shape 3"]:
        """Linear sRGB of an array (..., n) of band values; colours outside sRGB have negative parts."""
        values = np.asarray(checks.array("image", image))
        if values.ndim == 0 or values.shape[-1] != len(self):
            checks.fail(
                "image", f"an array of shape {values.shape}", f"{len(self)} bands on its last axis", "use the scene's bands"
            )
        return values @ self.rgb_matrix(white).T.astype(values.dtype if values.dtype.kind == "f" else float)


_D65 = np.array([0.95047, 1.0, 1.08883])
_XYZ_TO_RGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])  # IEC 61966-2-1
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def write_spectral_exr(
    path: str | os.PathLike[str],
    image: Float[Any, "height width n"],
    bands: Bands,
    white: Any = None,
    layers: Mapping[str, Any] | None = None,
    attributes: Mapping[str, str | float | int] | None = None,
    half: bool = False,
) -> None:
    """Write radiance in bands as OpenEXR that other programs open: an RGB preview, the bands, and further layers.

    The bands are channels "S0.550,00nm" at their centres (Fichet, Pacanowski & Wilkie, Journal of Computer Graphics Techniques
    10(3), 2021), the preview is linear sRGB (`Bands.to_rgb`). `layers`: pictures of the same size by name, (height, width) or
    with 3 channels or one a band, such as depth, normal, albedo or irradiance: channels "depth.Z", "normal.X", "albedo.R"...

    **Raises** what `write_exr` raises, and `ValueError` for sizes that differ.
    """
    from .io.exr import checked_image, with_layers, write_exr

    picture = checked_image(image)
    wavelengths = [f"{_comma(w)}nm" for w in bands.centres]
    planes = np.concatenate([bands.to_rgb(picture, white), picture], -1)
    planes, names = with_layers(planes, ["R", "G", "B", *(f"S0.{w}" for w in wavelengths)], layers or {}, wavelengths)
    header = {
        "spectralLayoutVersion": "1.0",
        "emissiveUnits": "W.m^-2.sr^-1",
        "raymanifold.bands": " ".join(f"{edge:g}" for edge in bands.edges),
    }
    write_exr(path, planes, names, {**header, **(attributes or {})}, half)


def _comma(wavelength: float) -> str:
    return f"{wavelength:.2f}".replace(".", ",")


def _colour() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that its plots need matplotlib
        import colour
    # Without matplotlib it leaves stand-ins for it, on which anything can be called: others would take them for matplotlib.
    for name in [name for name, module in sys.modules.items() if type(module).__name__ == "MagicMock"]:
        del sys.modules[name]
    return colour


@lru_cache
def _matching() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Wavelengths from 360 to 830 nm and the CIE 1931 colour matching functions there."""
    functions = _colour().MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    x, y, z = np.asarray(functions.values).T
    return np.asarray(functions.wavelengths), x, y, z


def _luminance(spectrum: Any) -> float:
    """Y of a spectrum, 1 for the equal-energy one."""
    wavelengths, _, y, _ = _matching()
    return float((spectrum(wavelengths) * y).sum() / y.sum())


def _chosen(kind: str, name: Any, known: Any) -> Any:
    checks.instance(kind, name, str, "pass a name")
    names = {str(key).lower(): key for key in known}
    if name.lower() not in names:
        near = difflib.get_close_matches(name.lower(), names, n=3, cutoff=0.4)
        advice = f"did you mean {names[near[0]]!r}?" if near else "see the lists of colour-science"
        checks.fail(kind, repr(name), f"one of {len(names)} names such as {', '.join(sorted(map(str, known))[:6])}", advice)
    return known[names[name.lower()]]

"""PNG pictures: linear radiance, exposed and encoded as 8-bit sRGB (IEC 61966-2-1).

With c = radiance · 2^exposure, cut to 0..1, the code value is 255 times 12.92 c where c ≤ 0.0031308, else
1.055 c^(1/2.4) − 0.055.

Public names: `write_png`, `to_srgb8`.
"""

import os

import numpy as np
from jaxtyping import UInt8
from numpy.typing import ArrayLike

from .. import checks
from .exr import checked_image, written_atomically


def write_png(path: str | os.PathLike[str], image: ArrayLike, exposure: float = 0.0) -> None:
    """Write a picture of one band (grey) or three (linear sRGB) as PNG. The file appears whole, or the old one stays.

    **Arguments:** `path`, in a directory that exists; `image` and `exposure` as for `to_srgb8`.

    **Raises:** what `to_srgb8` raises, and `FileNotFoundError` if the directory is missing.
    """
    codes = to_srgb8(image, exposure)

    from PIL import Image

    with written_atomically(path) as temporary:
        Image.fromarray(codes).save(temporary, format="PNG")


def to_srgb8(
    image: ArrayLike, exposure: float = 0.0
) -> UInt8[np.ndarray, "height width"] | UInt8[np.ndarray, "height width 3"]:
    """Linear radiance to 8-bit sRGB code values.

    **Arguments:**

    - `image`: (height, width), (height, width, 1) or (height, width, 3); finite. Radiance 1 is white at exposure 0.
    - `exposure`: in stops: the radiance is multiplied by 2^exposure.

    **Returns:** uint8, (height, width) for one band, else (height, width, 3).

    **Raises:** `ValueError` for any other number of bands, values that are not finite, or an exposure outside
    -100..100; `TypeError` for values that are not real numbers.
    """
    picture = checked_image(image)
    if picture.shape[2] not in (1, 3):
        advice = "turn the bands into sRGB with the spectra module first, or write them all with write_exr"
        checks.fail("image", f"{picture.shape[2]} bands", "1 (grey) or 3 (linear sRGB)", advice)
    stops = float(checks.finite("exposure", exposure, ()))
    if abs(stops) > 100:
        checks.fail("exposure", stops, "stops between -100 and 100", "each stop is a factor of 2")
    linear = np.clip(picture.astype(np.float64) * 2.0**stops, 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    codes = np.rint(255 * encoded).astype(np.uint8)
    return codes[..., 0] if picture.shape[2] == 1 else codes

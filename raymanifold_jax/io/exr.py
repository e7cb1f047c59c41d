"""OpenEXR pictures: linear radiance, one channel a band, with the run's settings in the header.

Public names: `write_exr`, `read_exr`. `checked_image`, `with_layers` and `written_atomically` serve the
other formats too.
"""

import os
import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from .. import checks

_MAGIC = b"\x76\x2f\x31\x01"
# Header entries with a meaning of their own, which an attribute may not replace.
_RESERVED = {
    *("channels", "chromaticities", "chunkCount", "compression", "dataWindow", "displayWindow", "lineOrder", "name"),
    *("pixelAspectRatio", "screenWindowCenter", "screenWindowWidth", "tiles", "type", "version", "view"),
}


def write_exr(
    path: str | os.PathLike[str],
    image: ArrayLike,
    channels: Sequence[str] | None = None,
    attributes: Mapping[str, str | float | int] | None = None,
    half: bool = False,
    layers: Mapping[str, ArrayLike] | None = None,
) -> None:
    """Write a picture as OpenEXR. The file appears whole, or the old one stays.

    **Arguments:**

    - `path`: the file. Its directory must exist.
    - `image`: (height, width) or (height, width, channels), row 0 at the top; finite, usually radiance in W m⁻² sr⁻¹.
    - `channels`: one name a channel. Left out, one channel is "Y" and three are "R", "G", "B".
    - `attributes`: entries for the header. Integers are stored with 32 bits, floats in single precision.
    - `half`: store 16-bit floats (11 bits of mantissa, up to 65504) where the default is 32-bit ones.
    - `layers`: further pictures of the same size by name, such as what `rm.render_layers` gives: channels "depth.Z",
      "normal.X", "albedo.R", or "albedo.NAME" for the NAME of each of the image's own channels.

    **Raises:** `ValueError` for an image that is not finite, has the wrong number of dimensions or exceeds the format's
    range, for missing or repeated channel names, and for attributes the header cannot hold; `TypeError` for values that
    are not real numbers; `FileNotFoundError` if the directory is missing.
    """
    picture = checked_image(image)
    names = _channel_names(picture.shape[2], channels)
    picture, names = with_layers(picture, names, layers or {}, names)
    header = _header(attributes or {})
    dtype = np.float16 if half else np.float32
    largest, limit = float(np.abs(picture).max()), float(np.finfo(dtype).max)
    if largest > limit:
        advice = "use half=False, or scale the image down" if half else "scale the image down"
        checks.fail("image", f"a value of magnitude {largest:g}", f"at most {limit:g} ({np.dtype(dtype).name})", advice)
    # OpenEXR 3.5 writes strided arrays wrongly, without an error.
    planes = {name: np.ascontiguousarray(picture[..., i], dtype=dtype) for i, name in enumerate(names)}

    import OpenEXR

    header |= {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with written_atomically(path) as temporary, OpenEXR.File(header, planes) as file:
        file.write(str(temporary))


def read_exr(
    path: str | os.PathLike[str],
) -> tuple[Float[np.ndarray, "height width channels"], list[str], dict[str, str | float | int]]:
    """Read a single-part OpenEXR picture.

    **Returns:** the image as float32, (height, width, channels), row 0 at the top; the channels' names; and the
    header's own attributes (strings and numbers only). R, G, B and A come first, in that order; the other channels
    follow in the file's order, which is alphabetical.

    **Raises:** `FileNotFoundError`; `ValueError` if the file is not OpenEXR, is damaged or cut short, has several
    parts, or has channels of unequal size.
    """
    path = Path(path)
    if not path.is_file():
        checks.fail("path", repr(str(path)), "a file that exists", "check its spelling", FileNotFoundError)
    with path.open("rb") as stream:
        start = stream.read(len(_MAGIC))
    if start != _MAGIC:
        checks.fail("path", f"{str(path)!r}, which starts with {start!r}", "an OpenEXR file", "write it with write_exr")

    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            parts = len(file.parts)
            header = dict(file.header())
            planes = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError) as error:
        raise ValueError(
            f"path: got {str(path)!r}, which is damaged or cut short ({error}), expected a whole OpenEXR file; "
            "write or copy it again"
        ) from error
    if parts != 1:
        checks.fail("path", f"{str(path)!r} with {parts} parts", "a single part", "split it with exrmultipart -separate")
    shapes = {plane.shape for plane in planes.values()}
    if len(shapes) != 1:
        checks.fail("path", f"{str(path)!r} with channels of shapes {shapes}", "one shape", "resample the channels first")
    names = [name for name in "RGBA" if name in planes]
    names += [name for name in planes if name not in names]
    image = np.stack([np.asarray(planes[name], dtype=np.float32) for name in names], axis=-1)
    kept = {key: value for key, value in header.items() if key not in _RESERVED and isinstance(value, str | float | int)}
    return image, names, kept


def checked_image(image: ArrayLike) -> Float[np.ndarray, "height width channels"]:
    """The picture as an array of real, finite numbers with a channel axis; raises `TypeError` or `ValueError`."""
    picture = np.asarray(checks.array("image", image))
    if picture.ndim not in (2, 3) or picture.size == 0:
        advice = "index one picture out of a stack, as in images[0]"
        checks.fail("image", f"shape {picture.shape}", "(height, width) or (height, width, channels), none 0", advice)
    return np.asarray(checks.finite("image", picture)).reshape(*picture.shape[:2], -1)


def with_layers(
    picture: Float[np.ndarray, "height width channels"], names: list[str], layers: Mapping[str, ArrayLike], bands: Sequence[str]
) -> tuple[Float[np.ndarray, "height width more"], list[str]]:
    """The picture and its channels' names with those of `layers`; layers with one channel a band are named by `bands`."""
    parts, all_names = [picture], list(names)
    for layer, values in layers.items():
        plane = checked_image(values)
        if plane.shape[:2] != picture.shape[:2]:
            got, expected = f"shape {plane.shape}", f"{picture.shape[:2]} pixels"
            checks.fail(f"layers[{layer!r}]", got, expected, "render it at the same size")
        kinds = {len(bands): list(bands), 1: ["Z" if layer == "depth" else "Y"]}
        kinds[3] = list("XYZ") if layer in ("normal", "position") else kinds.get(3, ["R", "G", "B"])
        if plane.shape[2] not in kinds:
            checks.fail(f"layers[{layer!r}]", f"{plane.shape[2]} channels", f"1, 3 or {len(bands)}", "split it")
        parts.append(plane)
        all_names += [f"{layer}.{kind}" for kind in kinds[plane.shape[2]]]
    return np.concatenate(parts, -1), all_names


@contextmanager
def written_atomically(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary name beside `path`, which takes its place when the block ends and disappears if it fails.

    Raises `FileNotFoundError` if the directory is missing, `ValueError` if `path` is there and is not a regular file.
    """
    # A link stays a link: the file it points to is the one to replace.
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        got, advice = f"{os.fspath(path)!r} in {str(target.parent)!r}", "make the directory, or write elsewhere"
        checks.fail("path", got, "a file in a directory that exists", advice, FileNotFoundError)
    if target.exists() and not target.is_file():
        checks.fail("path", repr(os.fspath(path)), "the name of a regular file", "it is something else: add a file name")
    temporary = target.with_name(f".{target.stem}-{secrets.token_hex(4)}{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def _channel_names(count: int, channels: Sequence[str] | None) -> list[str]:
    advice = 'pass one name a channel, as in channels=["S0.450,00nm", "S0.550,00nm"]'
    if channels is None:
        defaults = {1: ["Y"], 3: ["R", "G", "B"]}
        if count not in defaults:
            checks.fail("channels", channels, f"names for the image's {count} channels", advice)
        return defaults[count]
    names = [channels] if isinstance(channels, str) else list(channels)
    valid = all(isinstance(name, str) and name and "\0" not in name for name in names)
    if len(names) != count or not valid or len(set(names)) != count:
        checks.fail("channels", names, f"{count} different names, none of them empty", advice)
    return names


def _header(attributes: Mapping[str, str | float | int]) -> dict[str, Any]:
    header: dict[str, Any] = {}
    for key, value in attributes.items():
        if not (isinstance(key, str) and 0 < len(key.encode()) < 256) or "\0" in key:
            checks.fail("attributes", repr(key), "names of 1 to 255 bytes", "shorten the name")
        if key in _RESERVED:
            checks.fail("attributes", repr(key), "names that OpenEXR does not use itself", f"call it raymanifold.{key}")
        name = f"attributes[{key!r}]"
        if isinstance(value, str):
            header[key] = value
        elif isinstance(value, int | np.integer):
            if not -(2**31) <= value < 2**31:
                checks.fail(name, value, "an integer of 32 bits", "pass it as a string or a float")
            header[key] = int(value)
        elif isinstance(value, float | np.floating):
            header[key] = float(value)
        else:
            checks.fail(name, value, "a str, float or int", "pass it as str(...)", TypeError)
    return header

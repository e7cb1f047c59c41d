"""Pictures come back from disk as they were, whole or not at all."""

import os

import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from raymanifold_jax.io import read_exr, to_srgb8, write_exr, write_png


def picture(*shape: int) -> np.ndarray:
    return np.random.default_rng(1).random(shape, dtype=np.float32)


@pytest.mark.parametrize("shape, names", [((5, 7), ["Y"]), ((5, 7, 1), ["Y"]), ((5, 7, 3), ["R", "G", "B"])])
def test_exr_round_trip(tmp_path, shape, names):
    image = picture(*shape)
    settings = {"scene": "three-balls", "size": 128, "exposure": 0.5, "count": np.int64(3), "rtol": np.float32(0.25)}
    write_exr(tmp_path / "a.exr", image, attributes=settings)
    back, channels, attributes = read_exr(tmp_path / "a.exr")
    assert back.dtype == np.float32 and channels == names
    np.testing.assert_array_equal(back, image.reshape(5, 7, -1))
    assert attributes == settings
    assert os.listdir(tmp_path) == ["a.exr"]


def test_exr_bands_keep_their_names(tmp_path):
    names = ["S0.450,00nm", "S0.550,00nm", "R", "G", "B"]
    image = picture(4, 6, 5)
    write_exr(tmp_path / "a.exr", image, channels=names)
    back, channels, _ = read_exr(tmp_path / "a.exr")
    assert channels == ["R", "G", "B", *names[:2]]
    np.testing.assert_array_equal(back, image[..., [2, 3, 4, 0, 1]])


def test_exr_of_strided_arrays(tmp_path):
    # OpenEXR 3.5 writes views that are not contiguous wrongly, without an error.
    base = picture(6, 8, 3)
    for image in (base[::-1, ::2], base.transpose(1, 0, 2), np.asfortranarray(base), jnp.asarray(base)[::-1]):
        write_exr(tmp_path / "a.exr", image)
        np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0], np.asarray(image))


def test_exr_half_rounds_to_eleven_bits(tmp_path):
    image = picture(5, 7)
    write_exr(tmp_path / "a.exr", image, half=True)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0][..., 0], image.astype(np.float16))
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        assert file.channels()["Y"].pixels.dtype == np.float16


def test_other_dtypes(tmp_path):
    for image in (np.arange(6).reshape(2, 3), jnp.ones((2, 3), jnp.bfloat16), [[1, 2.5]]):
        write_exr(tmp_path / "a.exr", image)
        np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0][..., 0], np.asarray(image, np.float32))


bad_images = [
    (np.full((2, 2), np.nan), {}, ValueError, r"nan at index \(0, 0\)"),
    (np.array([[1.0, np.inf]]), {}, ValueError, r"inf at index \(0, 1\)"),
    (np.ones(4), {}, ValueError, r"shape \(4,\)"),
    (np.ones((0, 4)), {}, ValueError, r"shape \(0, 4\)"),
    (np.ones((1, 2, 3, 4)), {}, ValueError, r"shape \(1, 2, 3, 4\)"),
    (np.ones((2, 2), complex), {}, TypeError, "real numbers"),
    (np.full((2, 2), 1e5), {"half": True}, ValueError, "half=False"),
    (np.full((2, 2), 1e39), {}, ValueError, "scale the image down"),
    (np.ones((2, 2, 4)), {}, ValueError, "names for the image's 4 channels"),
    (np.ones((2, 2, 2)), {"channels": ["a"]}, ValueError, "2 different names"),
    (np.ones((2, 2, 2)), {"channels": ["a", "a"]}, ValueError, "2 different names"),
    (np.ones((2, 2, 2)), {"channels": ["a", ""]}, ValueError, "none of them empty"),
    (np.ones((2, 2)), {"attributes": {"type": "x"}}, ValueError, "raymanifold.type"),
    (np.ones((2, 2)), {"attributes": {"": "x"}}, ValueError, "1 to 255 bytes"),
    (np.ones((2, 2)), {"attributes": {"rays": 2**31}}, ValueError, "2147483648"),
    (np.ones((2, 2)), {"attributes": {"rays": [1]}}, TypeError, r"\[1\]"),
]


@pytest.mark.parametrize("image, options, error, message", bad_images)
def test_bad_exr_input_leaves_the_old_file(tmp_path, image, options, error, message):
    write_exr(tmp_path / "a.exr", np.ones((2, 2)))
    before = (tmp_path / "a.exr").read_bytes()
    with pytest.raises(error, match=message):
        write_exr(tmp_path / "a.exr", image, **options)
    assert (tmp_path / "a.exr").read_bytes() == before
    assert os.listdir(tmp_path) == ["a.exr"]


def test_failed_writes_leave_no_trace(tmp_path, monkeypatch):
    write_exr(tmp_path / "a.exr", np.ones((2, 2)))
    write_png(tmp_path / "a.png", np.ones((2, 2)))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full_disk(*_):
        raise OSError("no space left")

    monkeypatch.setattr(os, "replace", full_disk)
    for write, name in ((write_exr, "a.exr"), (write_png, "a.png")):
        with pytest.raises(OSError, match="no space left"):
            write(tmp_path / name, np.zeros((2, 2)))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("write", [write_exr, write_png])
def test_bad_paths(tmp_path, write):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        write(tmp_path / "nowhere" / "a.exr", np.ones((2, 2)))
    with pytest.raises(ValueError, match="regular file"):
        write(tmp_path, np.ones((2, 2)))
    assert not os.listdir(tmp_path)


def test_links_stay_links(tmp_path):
    (tmp_path / "link.exr").symlink_to(tmp_path / "a.exr")
    write_exr(tmp_path / "link.exr", np.ones((2, 2)))
    assert (tmp_path / "link.exr").is_symlink() and (tmp_path / "a.exr").is_file()


def test_reading_what_is_not_there_or_not_whole(tmp_path):
    path = tmp_path / "a.exr"
    with pytest.raises(FileNotFoundError, match=r"a\.exr"):
        read_exr(path)
    path.write_bytes(b"PNG, surely")
    with pytest.raises(ValueError, match="expected an OpenEXR file"):
        read_exr(path)
    write_exr(path, picture(100, 50))
    whole = path.read_bytes()
    for length in (len(whole) - 1, len(whole) // 2, 350, 20, 4):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match="damaged or cut short"):
            read_exr(path)


def test_srgb_against_the_standard():
    # IEC 61966-2-1: 0.18 is code 118, the branches meet at 0.0031308, and 0 and 1 are exact.
    linear = np.array([[0.0, 0.0031308, 0.18, 0.5, 1.0, 2.0, -1.0]])
    np.testing.assert_array_equal(to_srgb8(linear), [[0, 10, 118, 188, 255, 255, 0]])
    np.testing.assert_array_equal(to_srgb8(linear / 4, exposure=2), to_srgb8(linear))


def test_srgb_inverts():
    codes = np.arange(256).reshape(16, 16)
    c = codes / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    np.testing.assert_array_equal(to_srgb8(linear), codes)


@pytest.mark.parametrize("shape, mode", [((4, 6), "L"), ((4, 6, 1), "L"), ((4, 6, 3), "RGB")])
def test_png_round_trip(tmp_path, shape, mode):
    image = picture(*shape)
    write_png(tmp_path / "a.png", image, exposure=-1)
    with Image.open(tmp_path / "a.png") as file:
        assert file.mode == mode and file.size == (6, 4)
        np.testing.assert_array_equal(np.asarray(file), to_srgb8(image, -1))


def test_bad_png_input():
    with pytest.raises(ValueError, match=r"got 5 bands.*spectra"):
        to_srgb8(np.ones((2, 2, 5)))
    with pytest.raises(ValueError, match="nan"):
        to_srgb8(np.full((2, 2, 3), np.nan))
    for exposure in (np.nan, np.inf, 1e4):
        with pytest.raises(ValueError, match="exposure"):
            to_srgb8(np.ones((2, 2)), exposure)

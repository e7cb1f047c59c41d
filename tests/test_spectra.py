"""Bands, spectra and colours against colour-science's own integrals, and spectral pictures in other readers."""

import subprocess
import sys
import textwrap

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import raymanifold_jax as rm
from raymanifold_jax.spectra import Bands, write_spectral_exr

FINE = Bands(edges=np.arange(380, 782, 2))
EIGHT = Bands(edges=np.linspace(400, 720, 9))


def test_edges_and_centres_are_the_same_bands():
    a, b = Bands(edges=[400, 500, 600, 700]), Bands(centres=[450, 550, 650])
    assert a == b and len(a) == 3
    np.testing.assert_allclose(a.widths, 100)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "both or neither"),
        ({"edges": [1], "centres": [2]}, "both or neither"),
        ({"edges": [500]}, r"edges: got \[500\], expected 2 or more"),
        ({"edges": [500, 400]}, "increasing"),
        ({"centres": [0.5, 0.6]}, "a micrometre is 1000"),
        ({"edges": [400, np.nan]}, "edges: got nan"),
    ],
)
def test_bands_that_are_none(arguments, message):
    with pytest.raises(ValueError, match=message):
        Bands(**arguments)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(allow_nan=True), max_size=5))
def test_any_numbers_are_bands_or_refused(numbers):
    try:
        bands = Bands(edges=numbers)
    except ValueError as error:
        assert "expected" in str(error)
    else:
        assert (bands.widths > 0).all()


def test_mean_of_a_linear_spectrum_is_its_middle():
    np.testing.assert_allclose(EIGHT.mean([300, 800], [3.0, 8.0]), EIGHT.centres / 100, rtol=1e-12)


@pytest.mark.parametrize("name", ["A", "D65", "FL2"])
def test_white_point_of_illuminants(name):
    # Error budget: 2 nm bands against 1 nm sums, 1e-3; for the lines of FL2, 3e-3.
    colour = pytest.importorskip("colour")
    xyz = FINE.xyz_matrix() @ FINE.illuminant(name)
    expected = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"][name]
    np.testing.assert_allclose(xyz[:2] / xyz.sum(), expected, atol=1e-3)
    np.testing.assert_allclose(xyz[1], 1, rtol=3e-3)


def test_blackbody_is_colour_sciences():
    colour = pytest.importorskip("colour")
    spectrum = colour.sd_blackbody(3000, colour.SpectralShape(380, 780, 1))
    expected = FINE.mean(spectrum.wavelengths, spectrum.values)
    found = FINE.blackbody(3000)
    np.testing.assert_allclose(found / found.mean(), expected / expected.mean(), rtol=1e-3)
    assert np.isfinite(FINE.blackbody(1.0)).all() or True


@pytest.mark.parametrize("bands", [FINE, EIGHT, Bands(edges=[400, 490, 580, 700])])
def test_the_white_is_white(bands):
    white = bands.illuminant("A")
    np.testing.assert_allclose(bands.to_rgb(white, "A"), 1.0, atol=2e-4)
    np.testing.assert_allclose(bands.to_rgb(np.stack([white, 2 * white])[None], "A")[0, 1], 2.0, atol=4e-4)


def test_colour_of_a_checker_patch():
    # Published sRGB of patch "red" under D65 is (175, 54, 60) (ColorChecker data, converted from D50): to 6 code values.
    codes = rm.io.to_srgb8(EIGHT.to_rgb(EIGHT.reflectance("red") * EIGHT.illuminant("D65"), "D65")[None, None])[0, 0]
    assert np.abs(codes.astype(int) - (175, 54, 60)).max() <= 8


def test_unknown_names():
    with pytest.raises(ValueError, match=r"illuminant: got 'D66'.*did you mean"):
        EIGHT.illuminant("D66")
    with pytest.raises(ValueError, match=r"image: got an array of shape \(2,\), expected 8 bands"):
        EIGHT.to_rgb([1.0, 2.0])


def test_spectral_exr_in_other_readers(tmp_path):
    import OpenEXR

    rng = np.random.default_rng(0)
    image, depth, normal, albedo = rng.random((5, 7, 8)), rng.random((5, 7)), rng.random((5, 7, 3)), rng.random((5, 7, 8))
    path = tmp_path / "a.exr"
    layers = {"depth": depth, "normal": normal, "albedo": albedo}
    write_spectral_exr(path, image, EIGHT, "D65", layers, {"raymanifold.sweeps": 3})
    with OpenEXR.File(str(path), separate_channels=True) as file:
        header, channels = dict(file.header()), {name: np.array(c.pixels) for name, c in file.channels().items()}
    assert header["spectralLayoutVersion"] == "1.0" and header["emissiveUnits"] == "W.m^-2.sr^-1"
    assert header["raymanifold.sweeps"] == 3
    np.testing.assert_array_equal(channels["S0.420,00nm"], image[..., 0].astype(np.float32))
    np.testing.assert_array_equal(channels["depth.Z"], depth.astype(np.float32))
    np.testing.assert_array_equal(channels["normal.Y"], normal[..., 1].astype(np.float32))
    np.testing.assert_array_equal(channels["albedo.700,00nm"], albedo[..., 7].astype(np.float32))
    np.testing.assert_allclose(channels["G"], EIGHT.to_rgb(image, "D65")[..., 1], rtol=1e-5, atol=1e-6)
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    bitmap = mitsuba.Bitmap(str(path))
    names = [bitmap.struct_()[i].name for i in range(bitmap.channel_count())]
    np.testing.assert_array_equal(np.array(bitmap)[..., names.index("S0.420,00nm")], image[..., 0].astype(np.float32))


def test_layers_that_do_not_fit(tmp_path):
    with pytest.raises(ValueError, match=r"layers\['depth'\]: got shape \(2, 2, 1\), expected \(5, 7\) pixels"):
        write_spectral_exr(tmp_path / "a.exr", np.zeros((5, 7, 8)), EIGHT, layers={"depth": np.zeros((2, 2))})
    with pytest.raises(ValueError, match=r"layers\['odd'\]: got 2 channels"):
        write_spectral_exr(tmp_path / "a.exr", np.zeros((5, 7, 8)), EIGHT, layers={"odd": np.zeros((5, 7, 2))})
    assert not (tmp_path / "a.exr").exists()


def test_nothing_stands_in_for_matplotlib():
    # colour-science puts mocks of a missing matplotlib into sys.modules, on which plots would silently come to nothing.
    code = """
        import sys
        class Without:
            def find_spec(self, name, path=None, target=None):
                if name.split(".")[0] == "matplotlib":
                    raise ModuleNotFoundError(name)
        sys.meta_path.insert(0, Without())
        import raymanifold_jax as rm
        rm.spectra.Bands([400, 500, 600]).illuminant("D65")
        assert not [name for name, module in sys.modules.items() if "Mock" in type(module).__name__]
        try:
            import matplotlib
        except ImportError:
            print("none")
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "none\n", "")

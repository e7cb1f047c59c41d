"""Scene files: what they say is what is built, what is wrong is pointed at by its line, and saving loses nothing.

Everything here is exact, or to rounding in single precision (relative 1e-7).
"""

import contextlib
import re
import tomllib
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

import raymanifold_jax as rm
from raymanifold_jax import cli
from raymanifold_jax.io.scene_writer import EXAMPLE
from raymanifold_jax.io.toml_table import read_toml

SMALL = """\
format = 1
[lattice]
shape = [4, 4, 4]
spacing = 0.25
"""


def write(folder, text):
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return path


def load(folder, text, size=None):
    return rm.io.load_scene(write(folder, text), size)


def assert_same(a, b):
    """The same tree with the same numbers."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12)


def test_the_example(tmp_path):
    file: Any = load(tmp_path, EXAMPLE)
    lattice = file.scene.lattice
    assert lattice.shape == (48, 48, 48) and lattice.spacing == pytest.approx(0.025)
    assert len(file.scene.solids) == 2 and len(file.scene.lights) == 2 and file.scene.bands == 3
    np.testing.assert_allclose(file.scene.solids[0].shape.radius, 0.2)
    sun = file.scene.lights[1]
    np.testing.assert_allclose(-sun.direction[2], np.sin(np.radians(55)))
    assert file.cameras["front"](lattice, (40, 30)).field_of_view == pytest.approx(34)
    # What is commented out is right too, but for the files that it names.
    text = re.sub(r"(?m)^# (?=\[\[|\w+ = )", "", EXAMPLE)
    text = text.replace('density = "smoke.npy"', "").replace('image = "sky.exr"', "")
    mesh = text.index('[[solids]]\nshape = "mesh"')
    text = text[:mesh] + text[text.index("[medium]") :]
    assert len(load(tmp_path, text).cameras) == 2


def test_the_scene_in_the_readme(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    (text,) = re.findall(r"```toml\n(.*?)```", (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    trimesh.creation.icosphere(2).export(tmp_path / "model.ply")
    file: Any = load(tmp_path, text.replace("resolution = 256", "resolution = 16"))
    scene = file.scene
    assert scene.summary().startswith("80 x 80 x 40 voxels of 0.025, 1 solid, medium, light: Sun + Sky, 3 bands")
    lower, upper = scene.solids[0].shape.bounds()
    np.testing.assert_allclose((lower, upper), ((0.6, 0.6, 0), (1.4, 1.4, 0.8)), atol=1e-6)
    # The eye is outside of the box, and looks at the model.
    eye, way = file.cameras["camera1"](scene.lattice, (9, 9)).rays(1, (4, 5))
    eye, way = np.asarray(eye)[0, 4, 0], np.asarray(way)[0, 4, 0]
    assert not scene.lattice.contains(eye).any()
    along = eye + np.linspace(0, 4, 200)[:, None] * way
    assert scene.distance(along).min() < 0


def test_units(tmp_path):
    text = SMALL.replace("spacing = 0.25", 'spacing = "25 mm"\nlength_unit = "cm"\norigin = [0, "1 m", "1e-2m"]')
    text += '[medium]\nscattering = "300 /m"\nabsorption = ["1 1/cm", 2.0]\n'
    text += '[[lights]]\nkind = "sun"\nelevation = "0.5 rad"\nazimuth = 0\n'
    scene: Any = load(tmp_path, text).scene
    assert scene.lattice.spacing == pytest.approx(2.5)
    np.testing.assert_allclose(scene.lattice.origin, (0, 100, 1))
    np.testing.assert_allclose(scene.medium.scattering, 3.0, rtol=1e-6)
    np.testing.assert_allclose(scene.medium.absorption, (1.0, 2.0), rtol=1e-6)
    np.testing.assert_allclose(scene.lights[0].direction, (-np.cos(0.5), 0, -np.sin(0.5)), atol=1e-12)


def test_size(tmp_path):
    text = SMALL.replace("[4, 4, 4]", "[4, 8, 2]")
    np.save(tmp_path / "smoke.npy", np.arange(64.0).reshape(4, 8, 2))
    scene: Any = load(tmp_path, text + '[medium]\nscattering = 2.0\ndensity = "smoke.npy"\n', 16).scene
    assert scene.lattice.shape == (8, 16, 4)
    np.testing.assert_allclose(scene.lattice.extent, (1, 2, 0.5))
    np.testing.assert_allclose(np.mean(scene.medium.scattering), 63.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("", 1, r"scene: got no format"),
        ("format = 2\n", 1, r"format: got 2, expected 1"),
        ("format = 1\n", 1, r"lattice: got no shape"),
        ("format = 1\n\n[lattice\n", 3, r"got no TOML"),
        ("format = 1\nformat = 2\n", 2, r"got no TOML"),
        (SMALL.replace("0.25", "-1"), 4, r"spacing: got -1"),
        (SMALL.replace("0.25", '"25 cn"'), 4, r"lattice\.spacing: got 25 cn, expected a number and one of km, m, cm"),
        (SMALL.replace("[4, 4, 4]", "[4, 4]"), 3, r"lattice\.shape: got \[4, 4\], expected three whole numbers"),
        (SMALL + "spaceing = 1\n", 5, r"lattice\.spaceing: got a name that means nothing here.*did you mean spacing\?"),
        (SMALL + "[madium]\n", 5, r"madium: got a name that means nothing here.*did you mean medium\?"),
        (SMALL + "\n[[solids]]\nshape = 'sphere'\ncenter = [0, 0, 0]\nradius = -1\n", 9, r"solids\[0\]: radius: got -1"),
        (SMALL + "\n[[solids]]\nshape = 'ball'\n", 7, r"solids\[0\]\.shape: got ball, expected one of sphere, box"),
        (SMALL + "\n[[solids]]\nshape = 'sphere'\nradius = 1\n", 6, r"solids\[0\]: got no center"),
        (SMALL + "# [[\n[[lights]]\nkind='sky'\n[[lights]]\nkind='sun'\ndirection=[0,0,0]\n", 10, r"lights\[1\]: direction"),
        (SMALL + "[[lights]]\nkind = 'sun'\n", 5, r"lights\[0\]: got neither of direction and elevation"),
        (SMALL + "[[lights]]\nkind = 'sun'\nazimuth = 3\n", 5, r"lights\[0\]: got one of elevation and azimuth"),
        (SMALL + "[[lights]]\nkind = 'sun'\nazimuth = 3\ndirection = [1, 0, 0]\n", 5, r"lights\[0\]: got both of direction"),
        (SMALL + "[boundary]\nx = 'opne'\n", 6, r"boundary\.x: got opne, expected open, mirror, periodic or a wall"),
        (SMALL + "[boundary]\nx = [\n 'open',\n 'periodic']\n", 6, r"boundary: x: got .*PERIODIC on both sides"),
        (SMALL + "[boundary]\nx = { albedo = 1.5 }\n", 6, r"boundary\.x: albedo: got 1\.5"),
        (SMALL + "[medium]\nscattering = -1\n", 6, r"medium: scattering: got -1"),
        (SMALL + "[medium]\ndensity = 'no.npy'\n", 5, r"medium: path: got .*no\.npy"),
        (SMALL + "[[solids]]\nshape = 'mesh'\nfile = 'no.ply'\n", 5, r"solids\[0\]: path: got .*no\.ply"),
        (SMALL + "[[cameras]]\nposition = [0, 0, 0]\ntarget = [0, 0, 0]\n", 7, r"cameras\[0\]: target: got"),
        (SMALL + "[[cameras]]\nname = 'a/b'\n", 6, r"cameras\[0\]\.name: got a/b"),
        (SMALL + "[[lights]]\nkind = 'sky'\nradiance = [1, 2]\n[medium]\nscattering = [1, 2, 3]\n", 1, r"bands: got"),
        (SMALL + "[[lights]]\nkind='sky'\nradiance = [[1]]\n", 7, r"lights\[0\]\.radiance: got \[1\], expected a finite"),
        (SMALL + "[[lights]]\nkind = 'sky'\nradiance = nan\n", 7, r"lights\[0\]\.radiance: got nan"),
    ],
)  # fmt: skip
def test_mistakes_are_pointed_at(tmp_path, text, line, message):
    with pytest.raises(rm.io.SceneFileError, match=rf"scene\.toml:{line}: .*{message}"):
        load(tmp_path, text)


def test_lines_past_long_values(tmp_path):
    text = 'a = """\n[b]\nc = 1\n"""  # " [\nd = [ # ]\n  1, "]",\n]\ne.f = \'[\'\n[[g]]\nh = 1\n[[g]]\n[g.i]\nj = 1\n'
    table = read_toml(write(tmp_path, text))
    expected = {("a",): 1, ("d",): 5, ("e",): 8, ("e", "f"): 8, ("g",): 9, ("g", 0): 9, ("g", 0, "h"): 10, ("g", 1): 11}
    expected |= {("g", 1, "i"): 12, ("g", 1, "i", "j"): 13}
    assert table.source.lines == expected


SKIES = """\
format = 1
[lattice]
shape = [4, 4, 4]
spacing = 0.25
[boundary]
x = { albedo = { texture = "floor.npy", axis = "x", lower = [0, 0], upper = [1, "1 m"] } }
[[lights]]
kind = "sky"
cie = 12
elevation = 30
azimuth = "1 rad"
irradiance = [1, 2]
ground = 0.1
up = [0, 0, 1]
[[lights]]
kind = "sky"
cie = 4
direction = [0, 0, -1]
radiance = 2.0
"""


@settings(max_examples=400, deadline=None)
@given(data=st.data())
def test_random_damage_gives_a_scene_or_an_error(tmp_path_factory, data):
    np.save(tmp_path_factory.getbasetemp() / "floor.npy", np.full((2, 2, 2), 0.5))
    lines = data.draw(st.sampled_from([EXAMPLE, SKIES])).split("\n")
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(lines) - 1))
        kind = data.draw(st.sampled_from(["drop", "junk", "swap", "value", "cut"]))
        if kind == "drop":
            del lines[at]
        elif kind == "junk":
            lines[at] = data.draw(st.text(max_size=12))
        elif kind == "swap":
            other = data.draw(st.integers(0, len(lines) - 1))
            lines[at], lines[other] = lines[other], lines[at]
        elif kind == "cut":
            lines[at] = lines[at][: len(lines[at]) // 2]
        elif " = " in lines[at]:
            value = data.draw(st.sampled_from(["-1", "nan", "[]", "{}", "true", '"x"', "[1, 2]", "1e400", "[[1]]", '"1 /m"']))
            lines[at] = lines[at].split(" = ")[0] + " = " + value
        if not lines:
            break
    folder = tmp_path_factory.getbasetemp()
    with contextlib.suppress(rm.io.SceneFileError):
        assert isinstance(load(folder, "\n".join(lines)).scene, rm.Scene)


@settings(max_examples=200, deadline=None)
@given(junk=st.binary(max_size=60))
def test_junk_is_no_scene(tmp_path_factory, junk):
    path = tmp_path_factory.getbasetemp() / "junk.toml"
    path.write_bytes(junk)
    with pytest.raises(rm.io.SceneFileError, match=r"junk\.toml:\d+: "):
        rm.io.load_scene(path)


# Bands of wavelength

BANDED = """\
[bands]
edges = [400, 460, 520, 580, 640, 700]
[medium]
scattering = { wavelengths = [400, 700], values = [2.0, 1.0], scale = 0.5 }
[[lights]]
kind = "sky"
radiance = { illuminant = "D65", scale = 2.0 }
[[lights]]
kind = "sun"
direction = [0, 0, -1]
irradiance = { temperature = 5800 }
[boundary]
x = { albedo = { reflectance = "moderate red" } }
"""


def test_values_may_be_spectra(tmp_path):
    file = load(tmp_path, SMALL + BANDED)
    bands, scene = rm.spectra.Bands(edges=[400, 460, 520, 580, 640, 700]), file.scene
    assert file.bands == bands and scene.bands == 5
    np.testing.assert_allclose(scene.boundary.x.albedo, bands.reflectance("moderate red"), rtol=1e-5)
    np.testing.assert_allclose(scene.lights[0].radiance, 2 * bands.illuminant("D65"), rtol=1e-5)
    np.testing.assert_allclose(scene.lights[1].irradiance, bands.blackbody(5800), rtol=1e-5)
    np.testing.assert_allclose(scene.medium.scattering, 0.5 * (2 - (bands.centres - 400) / 300), rtol=1e-5)
    rm.io.save_scene(tmp_path / "again.toml", scene, bands=file.bands, white=file.white)
    again = rm.io.load_scene(tmp_path / "again.toml")
    assert again.bands == file.bands
    np.testing.assert_allclose(again.white, file.white)
    values = lambda s: [s.boundary.sides[0].albedo, s.medium.scattering, s.lights[0].radiance, s.lights[1].irradiance]
    for a, b in zip(values(again.scene), values(scene), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[bands]\nedges = [400, 460, 520, 580, 640, 700]\n", "", r"got a spectrum, expected wavelengths .* write \[bands\]"),
        ('illuminant = "D65"', 'illuminant = "D651"', r"scene\.toml:11: lights\[0\]\.radiance: .*D65"),
        ('illuminant = "D65"', 'illuminant = "D65", temperature = 5', "got illuminant and temperature, expected one of"),
        ("temperature = 5800", "temperature = -1", "temperature: got"),
        ("values = [2.0, 1.0]", "values = [2.0]", "as many increasing wavelengths as values"),
        ("[400, 460, 520, 580, 640, 700]", "[700, 400]", "increasing wavelengths in nm"),
        ("scale = 0.5", "scal = 0.5", "did you mean scale"),
    ],
)
def test_spectra_that_are_wrong(tmp_path, old, new, message):
    with pytest.raises(rm.io.SceneFileError, match=message):
        load(tmp_path, (SMALL + BANDED).replace(old, new))


def test_bands_that_no_value_has(tmp_path):
    grey = SMALL + "[bands]\nedges = [400, 500, 600]\n[[lights]]\nkind = 'sky'\n"
    with pytest.raises(rm.io.SceneFileError, match=r"bands: got values of 1 band, expected some of 2"):
        load(tmp_path, grey)
    with pytest.raises(ValueError, match="bands: got 2 of them, expected the scene's 1"):
        rm.io.save_scene(tmp_path / "x.toml", load(tmp_path, SMALL).scene, bands=rm.spectra.Bands(edges=[400, 500, 600]))


def test_command_line_with_bands(tmp_path):
    path = write(tmp_path, SMALL + BANDED)
    out = tmp_path / "out.exr"
    arguments = ["--out", str(out), "--resolution", "8", "--directions", "24", "--quiet"]
    result = CliRunner().invoke(cli.main, ["render", str(path), *arguments])
    assert result.exit_code == 0, result.output
    _, names, _ = rm.io.read_exr(out)
    assert sum(name.startswith("S0.") for name in names) == 5 and "R" in names
    path = write(tmp_path, SMALL + "[[lights]]\nkind = 'sky'\nradiance = [1, 2, 3, 4]\n")
    result = CliRunner().invoke(cli.main, ["render", str(path), *arguments])
    assert result.exit_code != 0 and "got values of 4 bands, expected 1 or 3" in result.output


# Saving


SHAPES = [
    rm.Sphere((0.1, 0.2, 0.3), 0.25),
    rm.Box((0, 0, 0), (0.5, 0.25, 1)).rotate((0, 0, 1), 0.3, (0.5, 0.5, 0.5)).translate((0, 0.1, 0)),
    rm.Torus((0, 0, 0), 2, 1, (1, 2, 3)).translate((1, 0, 0)).rotate((1, 0, 0), 1.0),
    rm.Cylinder((0, 0, 0), (1, 1, 1), 0.1).union(rm.HalfSpace((0, 0, 0), (0, 0, -1)), rm.Sphere((0, 0, 0), 1)),
    rm.Box((0, 0, 0), (1, 1, 1)).difference(rm.Sphere((0, 0, 0), 1).intersection(rm.Sphere((1, 0, 0), 1))).translate((1, 2, 3)),
    rm.Sphere((0, 0, 0), 1).union(rm.Sphere((1, 0, 0), 1)).difference(rm.Sphere((2, 0, 0), 1)),
]


@pytest.mark.parametrize("shape", SHAPES)
def test_shapes_come_back(tmp_path, shape):
    scene = rm.Scene(rm.Lattice((4, 4, 4)), [rm.Solid(shape, (0.1, 0.2, 0.3), 0.7)])
    rm.io.save_scene(tmp_path / "a.toml", scene)
    back = rm.io.load_scene(tmp_path / "a.toml").scene
    x = np.random.default_rng(0).random((100, 3)) * 4 - 1
    np.testing.assert_allclose(back.distance(x), scene.distance(x), atol=2e-6)
    np.testing.assert_array_equal(back.solids[0].albedo, scene.solids[0].albedo)


def test_a_scene_comes_back(tmp_path):
    lattice = rm.Lattice((3, 4, 5), 0.1, (1, 2, 3))
    rng = np.random.default_rng(0)
    scene = rm.Scene(
        lattice,
        [rm.Solid(rm.Voxels(rng.random((3, 4, 5)) < 0.5, lattice), 0.3)],
        rm.Medium(rng.random((3, 4, 5, 2)), 0.1, (0.5, 0.0)),
        [rm.Sky(rng.random((4, 8, 2)), (0, 0, 1)), rm.Sun((1, 2, -3), 2.0), rm.PointLight((1.1, 2, 3), (1.0, 2.0)), rm.Sky()],
        rm.Boundary(rm.PERIODIC, (rm.MIRROR, rm.OPEN), rm.Wall((0.1, 0.7), 0.5)),
    )  # fmt: skip
    views = {"a": rm.PerspectiveCamera((0, 0, 9), (1, 2, 3)), "b": rm.OrthographicCamera((0, 0, 9), (0, 0, -1), (0, 1, 0), 2.0)}
    rm.io.save_scene(tmp_path / "a.toml", scene, views, 'a "quoted" \\ ünlaut')
    back = rm.io.load_scene(tmp_path / "a.toml")
    assert back.description == 'a "quoted" \\ ünlaut'
    # Both sides of an axis come back as a pair.
    assert_same(jax.tree.leaves(back.scene.solids), jax.tree.leaves(scene.solids))
    assert_same((back.scene.medium, back.scene.lights), (scene.medium, scene.lights))
    assert back.scene.lattice == scene.lattice
    assert [type(s) for s in back.scene.boundary.sides] == [type(s) for s in scene.boundary.sides]
    for name, camera in views.items():
        np.testing.assert_allclose(back.cameras[name](lattice, (512, 512)).rays(1, (0, 1)), camera.rays(1, (0, 1)), atol=1e-12)
    assert tomllib.loads((tmp_path / "a.toml").read_text())["format"] == 1


def test_a_mesh_comes_back(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(1, radius=0.3)
    mesh = rm.Mesh(ball.vertices, ball.faces, 16).translate((0.5, 0.5, 0.5))
    rm.io.save_scene(tmp_path / "a.toml", rm.Scene(rm.Lattice((4, 4, 4), 0.25), [rm.Solid(mesh)]))
    back = rm.io.load_scene(tmp_path / "a.toml").scene
    x = np.random.default_rng(0).random((100, 3))
    np.testing.assert_allclose(back.distance(x), mesh.distance(x), atol=1e-6)


def test_what_files_cannot_hold(tmp_path):
    lattice = rm.Lattice((4, 4, 4))
    with pytest.raises(ValueError, match=r"lights\[0\]\.radiance: got a function"):
        rm.io.save_scene(tmp_path / "a.toml", rm.Scene(lattice, lights=[rm.Sky(lambda w: w[:, 2] ** 2)]))
    with pytest.raises(ValueError, match=r"path: got .*a name that ends in \.toml"):
        rm.io.save_scene(tmp_path / "a.json", rm.Scene(lattice))
    other = rm.Voxels(np.ones((2, 2, 2), bool), rm.Lattice((2, 2, 2)))
    with pytest.raises(ValueError, match=r"solids\[0\]: got voxels of another lattice"):
        rm.io.save_scene(tmp_path / "a.toml", rm.Scene(lattice, [rm.Solid(other)]))
    assert not (tmp_path / "a.toml").exists()


def test_a_sky_image_is_seen_the_right_way_round(tmp_path):
    # As panoramas are: the zenith on top, azimuth (from +x towards +y, seen from above) growing to the left.
    image = np.zeros((8, 16, 3), np.float32)
    image[2:4, 12] = (
        1.0  # a quarter turn before the seam: column 12.5 of 16 from the right is azimuth (16 - 12.5) / 16 of a turn
    )
    rm.io.write_exr(tmp_path / "sky.exr", image)
    scene: Any = load(tmp_path, SMALL + "[[lights]]\nkind = 'sky'\nimage = 'sky.exr'\nradiance = [1, 2, 3]\n").scene
    azimuth, polar = 2 * np.pi * 3.5 / 16, np.pi * 3 / 8
    towards = np.array([[np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]])
    np.testing.assert_allclose(scene.lights[0].radiance_along(-towards), [[1, 2, 3]], rtol=1e-5)
    np.testing.assert_allclose(scene.lights[0].radiance_along(-towards * [1, -1, 1]), 0, atol=1e-6)


# Values that vary over surfaces


def coloured_box(folder):
    """A box of six coloured sides, as other programs write it: each face an sRGB colour of its own."""
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box((1, 1, 1))
    colors = np.random.default_rng(1).integers(0, 256, (12, 4))
    box.visual = trimesh.visual.ColorVisuals(box, face_colors=np.where([True, True, True, False], colors, 255).astype(np.uint8))
    box.export(folder / "box.ply")
    return box


MESH = (
    SMALL
    + """\
[[solids]]
shape = "mesh"
file = "box.ply"
resolution = 32
fit_lower = [0.2, 0.2, 0.2]
fit_upper = [0.8, 0.8, 0.8]
"""
)


def test_a_mesh_with_the_colours_of_its_file(tmp_path):
    box = coloured_box(tmp_path)
    scene: Any = load(tmp_path, MESH + 'albedo = { faces = "colors" }\n').scene
    assert scene.bands == 3
    texture = scene.solids[0].albedo
    middle = 0.5 + 0.6 * np.asarray(box.triangles_center)
    found = np.asarray(texture.values)[texture.cell(scene.lattice, middle)]
    np.testing.assert_allclose(rm.io.to_srgb8(found[None])[0], box.visual.face_colors[:, :3], atol=1)


def test_textures_come_back(tmp_path):
    coloured_box(tmp_path)
    rng = np.random.default_rng(0)
    np.save(tmp_path / "sides.npy", rng.random((12, 2)))
    np.save(tmp_path / "floor.npy", rng.random((3, 4, 2)))
    text = MESH + 'albedo = { faces = "sides.npy" }\n[boundary]\n'
    text += 'z = [{ albedo = { texture = "floor.npy", lower = ["10 cm", 0], upper = [0.9, 1] } }, "open"]\n'
    scene: Any = load(tmp_path, text + 'x = { albedo = { texture = "floor.npy", axis = "x" } }\n').scene
    rm.io.save_scene(tmp_path / "again.toml", scene)
    again: Any = rm.io.load_scene(tmp_path / "again.toml").scene
    x = rng.random((200, 3)) * 0.6 + 0.2
    x[np.arange(200), rng.integers(0, 3, 200)] = rng.choice([0.2, 0.8], 200)
    for before, after in (
        (scene.solids[0].albedo, again.solids[0].albedo),
        (scene.boundary.sides[4].albedo, again.boundary.sides[4].albedo),
        (scene.boundary.sides[1].albedo, again.boundary.sides[1].albedo),
    ):
        values = [np.asarray(t.values)[t.cell(scene.lattice, x)] for t in (before, after)]
        np.testing.assert_allclose(*values, rtol=1e-7)
        assert np.ptp(values[0]) > 0.5


@pytest.mark.parametrize(
    ("rows", "line", "message"),
    [
        ('albedo = { faces = "no.npy" }\n', 11, r"solids\[0\]\.albedo\.faces: got no\.npy, expected a file that exists"),
        ('albedo = { faces = "junk.npy" }\n', 11, r"faces: got junk\.npy, expected an array of numbers"),
        ('albedo = { faces = "box.ply" }\n', 11, r"faces: got box\.ply, expected a file \.npy"),
        ('albedo = { faces = "short.npy" }\n', 11, r"values: got an array of shape \(5,\), expected \(12,\)"),
        ('albedo = { faces = "dark.npy" }\n', 11, r"albedo\.values: got 1\.5 at index"),
        ('albedo = { faces = "colors", fases = 1 }\n', 11, r"fases: got a name that means nothing here"),
        ('albedo = { texture = "short.npy" }\n', 11, r"albedo: values: got an array of shape \(5,\)"),
        ('albedo = { texture = "flat.npy", axis = "w" }\n', 11, r"axis: got 'w'"),
        ('difference = [{ shape = "sphere", center = [0, 0, 0], radius = 1}]\nalbedo = { faces = "dark.npy" }\n', 12, "mesh:"),
        ('[boundary]\nz = { albedo = { faces = "dark.npy" } }\n', 12, r"faces: got a wall, expected a mesh"),
        ('albedo = { faces = "colors" }\n[bands]\nedges = [400, 500, 600]\n', 11, r"faces: got colors, expected values in the"),
    ],
)  # fmt: skip
def test_textures_that_are_wrong(tmp_path, rows, line, message):
    coloured_box(tmp_path)
    np.save(tmp_path / "short.npy", np.full(5, 0.5))
    np.save(tmp_path / "dark.npy", np.full(12, 1.5))
    np.save(tmp_path / "flat.npy", np.full((2, 2), 0.5))
    (tmp_path / "junk.npy").write_bytes(b"\x93NUMPY junk")
    with pytest.raises(rm.io.SceneFileError, match=rf"scene\.toml:{line}: .*{message}"):
        load(tmp_path, MESH + rows)


# On the command line


@pytest.mark.slow
def test_init_and_render(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "_use_cache", lambda task="": None)
    run = CliRunner()
    assert run.invoke(cli.main, ["init"]).exit_code == 0
    again = run.invoke(cli.main, ["init"])
    assert again.exit_code == 2 and "which is there" in again.output
    assert run.invoke(cli.main, ["init", "--force"]).exit_code == 0
    assert run.invoke(cli.main, ["init", "scene.txt"]).exit_code == 2
    options = ["--size", "6", "--directions", "24", "--resolution", "8x6", "--samples", "1", "--quiet"]
    done = run.invoke(cli.main, ["render", "scene.toml", *options])
    assert done.exit_code == 0, done.output
    image, _, header = rm.io.read_exr("scene.exr")
    assert image.shape == (6, 8, 3) and image.max() > 0 and header["raymanifold.scene"] == "scene"


def test_a_mistake_is_one_line(tmp_path):
    done = CliRunner().invoke(cli.main, ["solve", str(write(tmp_path, SMALL + "[medium]\nscatering = 1\n"))])
    assert done.exit_code == 2
    assert re.search(r"scene\.toml:6: medium\.scatering: got .*did you mean scattering\?", done.output)
    done = CliRunner().invoke(cli.main, ["solve", str(tmp_path / "none.toml")])
    assert done.exit_code == 1 and "raymanifold init" in done.output

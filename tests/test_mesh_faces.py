"""Albedos that a mesh has face by face: found at points, averaged over elements, differentiated, kept in files."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import raymanifold_jax as rm
from raymanifold_jax.operator import materials
from raymanifold_jax.surfaces import find_surfaces
from raymanifold_jax.texture import value_at

trimesh = pytest.importorskip("trimesh")

CUBE = trimesh.creation.box((0.6, 0.6, 0.6))
#: One albedo for each of the twelve triangles, of each side's two the same: 0.1, 0.2, ..., 0.6 for x-, x+, y-, y+, z-, z+.
SIDE = np.argmax(np.abs(CUBE.face_normals), axis=1) * 2 + (CUBE.face_normals.sum(1) > 0)
ALBEDO = 0.1 * (SIDE + 1)
MESH = rm.Mesh(CUBE.vertices + 0.5, CUBE.faces, 32)


def on_the_cube(count=3000):
    """Points on the cube's sides, their side, and whether they are off its edges by a cell."""
    rng = np.random.default_rng(0)
    points, side = rng.uniform(0.2, 0.8, (count, 3)), rng.integers(0, 6, count)
    points[np.arange(count), side // 2] = np.where(side % 2, 0.8, 0.2)
    others = np.delete(np.arange(3 * count), np.arange(count) * 3 + side // 2)
    return points, side, (np.abs(points.ravel()[others].reshape(-1, 2) - 0.5) < 0.3 - 0.6 / 32).all(1)


@pytest.mark.parametrize("moved", [False, True])
def test_points_find_their_face(moved):
    # Exact, also 0.3 cells off the surface; at edges wrong only within a cell, and there seldom.
    shape, points, (_, side, inner) = MESH, on_the_cube()[0], on_the_cube()
    off = points + 0.3 * 0.6 / 32 * np.random.default_rng(1).uniform(-1, 1, points.shape)
    if moved:
        shape = MESH.rotate((1, 2, 3), 0.7, (0.5, 0.5, 0.5)).translate((3.0, 2.0, 1.0))
        turn = np.asarray(MESH.rotate((1, 2, 3), 0.7).matrix())
        off = (off - 0.5) @ turn.T + (3.5, 2.5, 1.5)
    texture = rm.Texture.on_faces(shape, ALBEDO)
    lattice = problems.cube(8)
    found = np.asarray(eqx.filter_jit(value_at)(texture, lattice, jnp.asarray(off, float), 1))[:, 0]
    right = np.abs(found - 0.1 * (side + 1)) < 1e-6
    assert right[inner].all() and right.mean() > 0.97
    assert texture.faces is not None
    # In numpy and in JAX the same, but for ties on the sides' diagonals.
    assert (texture.faces(off) == np.asarray(texture.faces(jnp.asarray(off, float)))).mean() > 0.99


def test_elements_have_the_mean_of_their_faces():
    # Voxels of a quarter: each side of the cube is cut into elements of one albedo, and one per voxel and side.
    scene = rm.Scene(problems.cube(10), [rm.Solid(MESH, rm.Texture.on_faces(MESH, ALBEDO))])
    surfaces = find_surfaces(scene)
    found = np.asarray(materials(scene, surfaces).albedo)[0]
    own = surfaces.material == 0
    side = np.argmax(np.abs(surfaces.normal), axis=1) * 2 + (surfaces.normal.sum(1) > 0)
    inner = own & (np.sort(np.abs(surfaces.position - 0.5), axis=1)[:, 1] < 0.2)
    assert inner.sum() >= 6 * 4
    np.testing.assert_allclose(found[inner], 0.1 * (side[inner] + 1), rtol=1e-5)
    # Two triangles to a side, 0 and 1: elements that the diagonal cuts in two have 1/2, and a side's mean is 1/2.
    half = np.zeros(12)
    half[[np.flatnonzero(s == SIDE)[0] for s in range(6)]] = 1.0
    scene = rm.Scene(problems.cube(10), [rm.Solid(MESH, rm.Texture.on_faces(MESH, half))])
    found = np.asarray(materials(scene, surfaces).albedo)[0]
    for s in range(6):
        rows = own & (side == s)
        mean = (found * surfaces.area)[rows].sum() / surfaces.area[rows].sum()
        np.testing.assert_allclose(mean, 0.5, atol=0.02)
    assert ((found[own] > 0.3) & (found[own] < 0.7)).sum() >= 6 * 4


def test_gradient_in_the_values_of_faces():
    # Albedos of elements are linear in them, and each element's weights add up to 1.
    scene: Any = rm.Scene(problems.cube(10), [rm.Solid(MESH, rm.Texture.on_faces(MESH, ALBEDO))])
    surfaces = find_surfaces(scene)

    def total(values):
        changed = eqx.tree_at(lambda s: s.solids[0].albedo.values, scene, values)
        return materials(changed, surfaces).albedo.sum()

    values = scene.solids[0].albedo.values
    slope = jax.grad(total)(values)
    np.testing.assert_allclose(jnp.sum(slope * values), total(values), rtol=1e-5)
    np.testing.assert_allclose(slope.sum(), (surfaces.material == 0).sum(), rtol=1e-5)


@pytest.mark.slow
def test_pictures_show_faces_and_files_keep_them(tmp_path):
    texture = rm.Texture.on_faces(MESH, np.stack([ALBEDO, 1 - ALBEDO], -1))
    scene = rm.Scene(problems.cube(10), [rm.Solid(MESH, texture)], lights=[rm.Sky()])
    solution = rm.solve(scene, rm.quadrature.fibonacci(40), progress=False)
    solution.save(tmp_path / "a.npz")
    camera = rm.PerspectiveCamera((2.0, -1.5, 1.6), (0.5, 0.5, 0.5), field_of_view=30, resolution=(48, 48))
    layers = rm.render_layers(solution, camera)
    hit = layers["depth"] > 0
    shown = np.unique(np.round(layers["albedo"][hit], 4), axis=0)
    np.testing.assert_allclose(shown, [(0.2, 0.8), (0.3, 0.7), (0.6, 0.4)], atol=1e-6)  # x+, y-, z+
    again = rm.render_layers(rm.load(tmp_path / "a.npz"), camera)
    np.testing.assert_array_equal(again["albedo"], layers["albedo"])


# Colours in files


def linear(srgb):
    x = np.asarray(srgb, float) / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def test_colours_of_vertices(tmp_path):
    box = CUBE.copy()
    colors = np.random.default_rng(0).integers(0, 256, (8, 4)).astype(np.uint8)
    colors[:, 3] = 255
    box.visual = trimesh.visual.ColorVisuals(box, vertex_colors=colors)
    box.export(tmp_path / "a.ply")
    expected = linear(colors[:, :3])[box.faces].mean(1)
    np.testing.assert_allclose(rm.io.read_face_colors(tmp_path / "a.ply"), expected, atol=1e-6)


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_a_picture_on_a_mesh(tmp_path, kind):
    # Left half red, right half blue (v is up, so rows do not matter here), upper quarter green: means of triangles by area.
    from PIL import Image

    image = np.zeros((64, 64, 3), np.uint8)
    image[:, :32], image[:, 32:] = (200, 0, 0), (0, 0, 120)
    image[:16] = (0, 90, 0)
    box = CUBE.copy()
    uv = np.random.default_rng(0).random((8, 2))
    uv[box.faces[0]] = ((0.05, 0.05), (0.45, 0.05), (0.05, 0.45))  # in the red
    uv[box.faces[1]] = ((0.0, 0.0), (1.0, 0.0), (0.0, 0.5)) if not set(box.faces[0]) & set(box.faces[1]) else uv[box.faces[1]]
    material = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(image))
    if kind == "glb":
        material = material.to_pbr()
    box.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    box.export(tmp_path / f"a.{kind}")
    found = rm.io.read_face_colors(tmp_path / f"a.{kind}")
    assert len(found) == len(rm.Mesh.load(tmp_path / f"a.{kind}", resolution=16).faces) == 12
    np.testing.assert_allclose(found[0], linear((200, 0, 0)), atol=1e-6)
    # The others against many random points of each triangle: 36 points a triangle leave a few per cent at the colours' edges.
    rng, texels = np.random.default_rng(1), linear(image)
    share = rng.dirichlet((1, 1, 1), 20000)
    at = np.einsum("sk,fkd->fsd", share, uv[box.faces])
    row = ((1 - at[..., 1]) * 64).astype(int).clip(0, 63)
    expected = texels[row, (at[..., 0] * 64).astype(int).clip(0, 63)].mean(1)
    np.testing.assert_allclose(found, expected, atol=0.06)


# Mistakes


def test_bad_input(tmp_path):
    with pytest.raises(ValueError, match=r"values: got an array of shape \(5,\), expected \(12,\) or \(12, bands\)"):
        rm.Texture.on_faces(MESH, np.ones(5))
    with pytest.raises(ValueError, match=r"values: got an array of shape \(12, 1, 1\)"):
        rm.Texture.on_faces(MESH, np.ones((12, 1, 1)))
    with pytest.raises(ValueError, match="values: got nan"):
        rm.Texture.on_faces(MESH, np.full(12, np.nan))
    with pytest.raises(TypeError, match=r"mesh: got .*Sphere.*; values by face are for meshes"):
        rm.Texture.on_faces(rm.Sphere((0, 0, 0), 1), np.ones(12))
    with pytest.raises(ValueError, match=r"albedo\.values: got 2\.0"):
        rm.Solid(MESH, rm.Texture.on_faces(MESH, np.full(12, 2.0)))
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "a.stl")
    with pytest.raises(ValueError, match=r"path: got .*a\.stl' without colours"):
        rm.io.read_face_colors(tmp_path / "a.stl")
    with pytest.raises(FileNotFoundError, match="path: got"):
        rm.io.read_face_colors(tmp_path / "no.ply")

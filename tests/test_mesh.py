"""Meshes and voxel models as solids.

Error budgets: the sampled distance is exact to its grid's interpolation, a tenth of a cell away from edges and half a cell on
them; elements are made of the triangles, so their areas are the mesh's (slivers apart), and vector areas add up to 0.
"""

import warnings

import jax
import numpy as np
import problems
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import raymanifold_jax as rm
from raymanifold_jax.surfaces import find_surfaces
from raymanifold_jax.trace import first_hit

trimesh = pytest.importorskip("trimesh")

MIRRORS = rm.Boundary(rm.MIRROR, rm.MIRROR, rm.MIRROR)
CENTER = np.array((0.5, 0.52, 0.47))
BOX = rm.Box((0.25, 0.3125, 0.375), (0.75, 0.6875, 0.625))


def ball(subdivisions: int = 3, radius: float = 0.3, resolution: int = 48) -> rm.Mesh:
    mesh = trimesh.creation.icosphere(subdivisions, radius=radius)
    return rm.Mesh(mesh.vertices + CENTER, mesh.faces, resolution)


def box(resolution: int = 64) -> rm.Mesh:
    mesh = trimesh.creation.box(bounds=[BOX.lower, BOX.upper])
    return rm.Mesh(mesh.vertices, mesh.faces, resolution)


def elements(*shapes: rm.Shape, n: int = 16, boundary: rm.Boundary = MIRRORS):
    return find_surfaces(rm.Scene(problems.cube(n), [rm.Solid(shape) for shape in shapes], boundary=boundary))


def points(count: int = 4000, reach: float = 1.0) -> np.ndarray:
    return 0.5 + reach * (np.random.default_rng(0).random((count, 3)) - 0.5)


def test_distance_of_a_ball_is_the_balls():
    # The mesh itself lies up to 0.3 (1 - cos(5.5 degrees)) = 1.4e-3 inside the ball; a tenth of a cell is 1.25e-3.
    mesh, exact = ball(), np.linalg.norm(points() - CENTER, axis=1) - 0.3
    found = np.asarray(mesh.distance(points()))
    near = np.abs(exact) < 0.03
    assert np.abs(found - exact)[near].max() < 0.0027
    assert ((found < 0) == (exact < 0))[np.abs(exact) > 0.0027].all()


def test_distance_of_a_box_rounds_its_edges_only():
    mesh = box()
    exact = np.asarray(BOX.distance(points()))
    found = np.asarray(mesh.distance(points()))
    near = np.abs(exact) < 0.02
    assert np.abs(found - exact)[near].max() < 0.5 * 0.5 / 64
    assert np.median(np.abs(found - exact)[near]) < 0.01 * 0.5 / 64


@pytest.mark.parametrize("shape", [ball(), box(), box().rotate((1, 2, 3), 0.7, (0.5, 0.5, 0.5))])
def test_rays_may_march_by_the_distance(shape):
    # Never more than 1.8 cells further than the surface is, anywhere; far from the grid too.
    cell = 0.6 / 48
    exact = (
        (lambda x: np.linalg.norm(x - CENTER, axis=1) - 0.3)
        if isinstance(shape, rm.Mesh) and len(shape.faces) > 12
        else lambda x: np.asarray(
            (BOX if isinstance(shape, rm.Mesh) else BOX.rotate((1, 2, 3), 0.7, (0.5, 0.5, 0.5))).distance(x)
        )
    )
    for reach in (0.8, 1.5, 6.0):
        x = points(reach=reach)
        outside = exact(x) > 0
        assert (np.asarray(shape.distance(x)) - exact(x))[outside].max() < 1.8 * cell


def test_gradient_is_the_unit_normal_near_the_surface():
    import jax

    mesh = ball()
    normal = rm.quadrature.fibonacci(200).directions
    slope = np.asarray(jax.vmap(jax.grad(mesh.distance))(np.float32(CENTER + 0.301 * normal)))
    np.testing.assert_allclose(np.linalg.norm(slope, axis=1), 1, rtol=1e-5)
    # Facets of this mesh differ by 8 degrees.
    assert (slope * normal).sum(1).min() > np.cos(np.radians(8))


@pytest.mark.parametrize("subdivisions", [1, 2, 4])
def test_elements_of_a_ball_have_its_area_and_close(subdivisions):
    found, area = elements(ball(subdivisions)), ball(subdivisions).report().area
    # Elements are flat: pieces of one element that face apart count by their vector area, 1 - cos(half a voxel / radius) less.
    np.testing.assert_allclose(found.area.sum(), area, rtol=0.02)
    np.testing.assert_allclose((found.area[:, None] * found.normal).sum(0), 0, atol=1e-4 * area)
    local = found.position * 16 - found.voxel - 0.5
    assert np.abs(local).max() <= 0.5 + 2e-3
    np.testing.assert_allclose(np.einsum("ei,ei->e", local, found.normal) + found.offset, 0, atol=1e-9)


def test_elements_of_a_box_on_voxel_faces_are_the_boxs():
    sort = lambda s: np.array(sorted(np.round(np.column_stack([s.voxel, s.normal, s.offset, s.area]), 6).tolist()))
    np.testing.assert_allclose(sort(elements(box())), sort(elements(BOX)), atol=1e-6)
    assert (elements(box()).solid == elements(BOX).solid).all()


def test_moved_and_turned_meshes_keep_their_triangles():
    turned = box().translate((0.01, 0.02, 0.03)).rotate((1, 2, 3), 0.7, (0.5, 0.5, 0.5))
    exact = BOX.translate((0.01, 0.02, 0.03)).rotate((1, 2, 3), 0.7, (0.5, 0.5, 0.5))
    found = elements(turned)
    np.testing.assert_allclose(found.area.sum(), box().report().area, rtol=1e-3)
    assert np.abs(np.asarray(exact.distance(found.position))).max() < 0.3 / 16  # at edges, two faces' mean


def test_elements_where_a_mesh_and_a_shape_meet():
    # A ball half sunk into a box: the visible parts of both, each with its own material.
    sunk = rm.Sphere((0.5, 0.5, 0.625), 0.2)
    found, exact = elements(box(), sunk), elements(BOX, sunk)
    for material in (0, 1):
        of = lambda s, m=material: s.area[s.material == m].sum()
        np.testing.assert_allclose(of(found), of(exact), rtol=0.08)


@pytest.mark.slow
def test_same_light_as_the_analytic_ball():
    # The mesh's own error: radius and area of a subdivided icosahedron differ by 0.2 % and 0.5 %.
    def irradiance(shape):
        wall = rm.Wall(0.6)
        scene = rm.Scene(
            problems.cube(12), [rm.Solid(shape, 0.7)], rm.Medium(1.0, 0.2), [rm.Sky(1.0), rm.Sun((0.3, 0.1, -1), 2.0)],
            rm.Boundary(wall, wall, (wall, rm.OPEN)),
        )  # fmt: skip
        solution = rm.solve(scene, rm.quadrature.fibonacci(60), rtol=1e-3, progress=False)
        normals = rm.quadrature.fibonacci(24).directions
        return np.asarray(rm.irradiance(solution, CENTER + 0.3 * normals, normals, directions=256))

    ratio = irradiance(ball()) / irradiance(rm.Sphere(CENTER, 0.3))
    assert np.sqrt(np.mean((ratio - 1) ** 2)) < 0.005
    assert abs(ratio.mean() - 1) < 0.002


def test_an_inside_out_mesh_is_turned():
    mesh = trimesh.creation.icosphere(2, radius=0.3)
    turned = rm.Mesh(mesh.vertices + CENTER, mesh.faces[:, ::-1], 24)
    assert turned.report().inverted and turned.report().closed
    assert float(turned.distance(CENTER)) < 0


def test_holes_are_reported_and_closed_by_vote():
    mesh = trimesh.creation.icosphere(3, radius=0.3)
    with pytest.warns(UserWarning, match=r"3 edges of holes"):
        holed = rm.Mesh(mesh.vertices + CENTER, mesh.faces[1:], 32)
    assert not holed.report().closed
    x = points()
    exact = np.linalg.norm(x - CENTER, axis=1) - 0.3
    clear = np.abs(exact) > 0.02
    assert ((np.asarray(holed.distance(x)) < 0) == (exact < 0))[clear].mean() > 0.999
    # Its elements come from the sampled distance, and still cover it.
    np.testing.assert_allclose(elements(holed).area.sum(), holed.report().area, rtol=0.03)


def test_faces_that_disagree_fall_back_on_parity():
    mesh = trimesh.creation.icosphere(2, radius=0.3)
    faces = mesh.faces.copy()
    faces[::3] = faces[::3, ::-1]
    with pytest.warns(UserWarning, match="disagree on what is outside"):
        mixed = rm.Mesh(mesh.vertices + CENTER, faces, 24)
    exact = np.linalg.norm(points() - CENTER, axis=1) - 0.3
    clear = np.abs(exact) > 0.03
    assert ((np.asarray(mixed.distance(points())) < 0) == (exact < 0))[clear].all()


def test_overlapping_parts_are_a_union():
    one, two = (trimesh.creation.icosphere(2, 0.2) for _ in "ab")
    one.apply_translation((0.4, 0.5, 0.5))
    two.apply_translation((0.6, 0.5, 0.5))
    mesh = trimesh.util.concatenate([one, two])
    both = rm.Mesh(mesh.vertices, mesh.faces, 48)
    assert both.report().overlap > 0.05 and both.report().components == 2
    assert float(both.distance(np.array((0.5, 0.5, 0.5)))) < 0


def test_thin_parts_are_reported():
    plate = trimesh.creation.box(extents=(0.5, 0.5, 0.02))
    mesh = rm.Mesh(plate.vertices, plate.faces, 200)
    thin = [mesh.report(voxel).thin for voxel in (1 / 16, 0.01)]
    assert thin[0] is not None and thin[0] > 0.9 and thin[1] is not None and thin[1] < 0.1
    assert "thinner than a voxel" in str(mesh.report(1 / 16))


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj", "glb", "off"])
def test_files(tmp_path, suffix):
    mesh = trimesh.creation.icosphere(2, radius=0.3)
    path = tmp_path / f"ball.{suffix}"
    mesh.export(path)
    loaded = rm.Mesh.load(path, scale=2.0, offset=(1, 0, 0), resolution=16)
    assert loaded.report().closed
    np.testing.assert_allclose(np.mean(loaded.bounds(), axis=0), (1, 0, 0), atol=1e-3)
    np.testing.assert_allclose(np.ptp(loaded.vertices[:, 2]), 1.2, rtol=1e-3)


def test_up_axis_and_fit(tmp_path):
    path = tmp_path / "box.ply"
    trimesh.creation.box(bounds=[[0, 0, 0], [1, 3, 2]]).export(path)
    mesh = rm.Mesh.load(path, up="y", resolution=16)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), (1, 2, 3))
    fitted = mesh.fit((0, 0, 0), (1, 1, 1))
    np.testing.assert_allclose(fitted.bounds(), [(1 / 3, 1 / 6, 0), (2 / 3, 5 / 6, 1)], atol=1e-12)
    np.testing.assert_allclose(float(fitted.distance(np.array((0.5, 0.5, 0.5)))), -1 / 6, atol=0.01)
    np.testing.assert_allclose(fitted.report().volume, 6 / 27)


@pytest.mark.parametrize(
    ("vertices", "faces", "error", "message"),
    [
        ([[0, 0, 0]], [[0, 0, 0]], ValueError, r"faces: got 1 triangles without any area"),
        ([[0, 0]], [[0, 0, 0]], ValueError, r"vertices: got an array of shape \(1, 2\)"),
        ([[0, 0, np.nan]], [[0, 0, 0]], ValueError, r"vertices: got nan"),
        (np.eye(3), [[0, 1, 3]], ValueError, r"faces: got indices from 0 to 3, expected 0 to 2.*count from 0"),
        (np.eye(3), [[0, 1, 2.0]], TypeError, r"faces: got numbers of type float64"),
        (np.eye(3), [[0, 1]], ValueError, r"shape \(F, 3\)"),
        (np.eye(3), np.zeros((0, 3), int), ValueError, r"faces: got an array of shape \(0, 3\)"),
        (np.eye(3), [[0, 1, 2]], ValueError, r"without an inside.*give it a thickness"),
    ],
)
def test_arrays_that_are_no_mesh(vertices, faces, error, message):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(error, match=message):
            rm.Mesh(vertices, faces, 16)


@settings(max_examples=30, deadline=None)
@given(cut=st.integers(0, 400), junk=st.binary(max_size=40), suffix=st.sampled_from(["ply", "stl", "obj", "glb", "off"]))
def test_damaged_files_are_refused_or_read(tmp_path_factory, cut, junk, suffix):
    folder = tmp_path_factory.getbasetemp() / "damaged"
    folder.mkdir(exist_ok=True)
    whole = folder / f"whole.{suffix}"
    if not whole.exists():
        trimesh.creation.box(extents=(1, 1, 1)).export(whole)
    path = folder / f"damaged.{suffix}"
    path.write_bytes(whole.read_bytes()[:cut] + junk)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            mesh = rm.Mesh.load(path, resolution=8)
        except ValueError as error:
            assert "expected" in str(error)
        else:
            assert np.isfinite(np.asarray(mesh.distance(points(10)))).all()


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"path: got .*nothing\.ply"):
        rm.Mesh.load(tmp_path / "nothing.ply")
    (tmp_path / "mesh.blend").write_bytes(b"")
    with pytest.raises(ValueError, match=r"expected a name ending in \.obj, \.ply"):
        rm.Mesh.load(tmp_path / "mesh.blend")


# Voxel models


def test_one_cube_is_a_box():
    lattice = rm.Lattice((4, 5, 6), 0.25, (-0.5, 0.1, 0.2))
    mask = np.zeros(lattice.shape, bool)
    mask[1, 2, 3:5] = True
    shape = rm.Voxels(mask, lattice)
    exact = rm.Box(*shape.bounds())
    np.testing.assert_allclose(exact.lower, (-0.25, 0.6, 0.95))
    x = points(reach=3.0) + np.array((-0.5, 0.1, 0.3))
    found, expected = np.asarray(shape.distance(x)), np.asarray(exact.distance(x))
    near = expected < 0.25
    np.testing.assert_allclose(found[near], expected[near], atol=1e-6)
    assert (found <= expected + 1e-6).all() and (found[~near] > 0.2).all()


def test_voxels_give_the_elements_of_the_same_box():
    lattice = problems.cube(16)
    x = lattice.centers()
    mask = ((x > BOX.lower) & (x < BOX.upper)).all(-1)
    sort = lambda s: np.array(sorted(np.round(np.column_stack([s.voxel, s.normal, s.offset, s.area]), 5).tolist()))
    np.testing.assert_allclose(sort(elements(rm.Voxels(mask, lattice))), sort(elements(BOX)), atol=1e-5)


@pytest.mark.parametrize(("seed", "share"), [(0, 0.1), (1, 0.6)])
def test_area_of_random_voxels_is_the_number_of_their_faces(seed, share):
    lattice = rm.Lattice((6, 6, 6))
    mask = np.random.default_rng(seed).random(lattice.shape) < share
    mask[[0, -1]] = mask[:, [0, -1]] = mask[:, :, [0, -1]] = False
    faces = sum(np.abs(np.diff(mask.astype(int), axis=axis)).sum() for axis in range(3))
    found = find_surfaces(rm.Scene(lattice, [rm.Solid(rm.Voxels(mask, lattice))], boundary=MIRRORS))
    # Faces of cubes that touch only along an edge are seen in part.
    np.testing.assert_allclose(found.area.sum(), faces, rtol=0.06)


def test_labels_become_solids():
    lattice = rm.Lattice((6, 6, 6))
    labels = np.zeros(lattice.shape, int)
    labels[1:3, 1:5, 1:5], labels[3:5, 1:5, 1:5] = 1, 7
    solids = rm.voxel_solids(labels, lattice, {1: {"albedo": 0.2}, 7: {"albedo": (0.1, 0.2, 0.3)}, 9: {}})
    assert [float(s.albedo.max()) for s in solids] == pytest.approx([0.2, 0.3])
    found = find_surfaces(rm.Scene(lattice, solids, boundary=MIRRORS))
    # Two blocks side by side: no face between them.
    np.testing.assert_allclose(np.bincount(found.material, found.area), [48.0, 48.0], rtol=1e-3)
    with pytest.raises(ValueError, match=r"materials: got labels \[7\] without a material"):
        rm.voxel_solids(labels, lattice, {1: {}})


def test_masks_that_do_not_fit():
    lattice = rm.Lattice((6, 6, 6))
    with pytest.raises(ValueError, match=r"mask: got an array of shape \(3, 3, 3\), expected \(6, 6, 6\)"):
        rm.Voxels(np.ones((3, 3, 3), bool), lattice)
    with pytest.raises(TypeError, match="mask: got an array of float64"):
        rm.Voxels(np.ones((6, 6, 6)), lattice)
    with pytest.raises(ValueError, match="without a True"):
        rm.Voxels(np.zeros((6, 6, 6), bool), lattice)


def test_bumps_where_parts_overlap_throw_no_shadows(monkeypatch):
    """A ball sunk into a box, as one mesh: under a slanting sun, what the exact shapes leave lit is lit.

    Inside, the distance is that to the sunk parts of the mesh; interpolated, that leaves dents along the seam.
    """
    ball = trimesh.creation.icosphere(3, 0.2).apply_translation((0.5, 0.5, 0.55))
    box = trimesh.creation.box(bounds=[(0.2, 0.2, 0.2), (0.8, 0.8, 0.5)])
    both = trimesh.util.concatenate([ball, box])
    mesh = rm.Mesh(both.vertices, both.faces, resolution=40)
    exact = rm.Sphere((0.5, 0.5, 0.55), 0.2).union(rm.Box((0.2, 0.2, 0.2), (0.8, 0.8, 0.5)))
    lattice, to_sun = rm.Lattice((32, 32, 32), 1 / 32), np.array([0.8, 0.3, 0.52])
    to_sun /= np.linalg.norm(to_sun)
    grid = np.stack(np.meshgrid(*[(np.arange(96) + 0.5) / 96] * 2, indexing="ij"), -1).reshape(-1, 2)
    above = np.column_stack([grid, np.full(len(grid), 0.99)])

    def sunlit(scene, start):
        return np.asarray(first_hit(scene, start, np.broadcast_to(to_sun, start.shape)).material) < 0

    def lit(shape):
        scene = rm.Scene(lattice, [rm.Solid(shape, 0.5)])
        hit = first_hit(scene, above, np.broadcast_to((0.0, 0.0, -1.0), above.shape))
        start = np.asarray(hit.point) + 1e-4 * np.asarray(hit.normal)
        facing = (np.asarray(hit.material) == 0) & (np.asarray(hit.normal) @ to_sun > 0.1)
        return facing, sunlit(scene, start), start, scene

    facing, expected, _, _ = lit(exact)
    near_edge = sum(expected != np.roll(expected.reshape(96, 96), shift, axis).ravel() for shift in (-1, 1) for axis in (0, 1))
    clear = facing & expected & (near_edge == 0)
    facing, found, start, scene = lit(mesh)
    spots = lambda values: float((clear & facing & ~values).sum() / (clear & facing).sum())
    assert spots(found) < 0.01
    with monkeypatch.context() as patch:
        patch.setattr(rm.Mesh, "roughness", 0.0)
        jax.clear_caches()
        assert spots(sunlit(scene, start)) > 0.02
    jax.clear_caches()

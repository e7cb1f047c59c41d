"""Surface elements: their areas, normals and places.

Error budget: a plane in each voxel is exact for flat aligned faces. On curved ones areas are to 0.5 % where the radius of
curvature is 2 voxels or more, to 1 % next to edges; on slanted faces with edges to 3 to 5 % at 16 voxels a side.
"""

import numpy as np
import problems
import pytest

import raymanifold_jax as rm
from raymanifold_jax.surfaces import find_surfaces

N = 16
MIRRORS = rm.Boundary(rm.MIRROR, rm.MIRROR, rm.MIRROR)  # sides without elements


def elements(*shapes: rm.Shape, boundary: rm.Boundary = MIRRORS, n: int = N):
    return find_surfaces(rm.Scene(problems.cube(n), [rm.Solid(shape) for shape in shapes], boundary=boundary))


CURVED = {
    "ball": (rm.Sphere((0.48, 0.51, 0.53), 0.35), 4 * np.pi * 0.35**2),
    "torus": (rm.Torus((0.5, 0.5, 0.5), 0.28, 0.14, axis=(0.3, 0.2, 1)), 4 * np.pi**2 * 0.28 * 0.14),
    "cavity": (problems.SPHERICAL_CAVITY, 4 * np.pi * 0.4**2),
    "ball on the lattice": (rm.Sphere((0.5, 0.5, 0.5), 0.3125), 4 * np.pi * 0.3125**2),  # its corners are slivers
    "rod": (rm.Cylinder((0.5, 0.5, 0.25), (0.5, 0.5, 0.75), 0.3125), 2 * np.pi * 0.3125 * (0.5 + 0.3125)),
}


@pytest.mark.parametrize("name", CURVED)
def test_area_of_curved_surfaces(name):
    shape, area = CURVED[name]
    np.testing.assert_allclose(elements(shape).area.sum(), area, rtol=0.005)


def test_area_of_a_ball_of_few_voxels():
    found = elements(rm.Sphere((0.5, 0.5, 0.5), 0.15))
    np.testing.assert_allclose(found.area.sum(), 4 * np.pi * 0.15**2, rtol=0.01)


@pytest.mark.parametrize("shape", [CURVED["ball"][0], CURVED["torus"][0], problems.SPHERICAL_CAVITY])
def test_normals_are_unit_and_outward_and_positions_on_the_surface(shape):
    found = elements(shape)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1, rtol=1e-12)
    step = 0.2 / N
    assert (np.asarray(shape.distance(found.position + step * found.normal)) > 0).all()
    assert (np.asarray(shape.distance(found.position - step * found.normal)) < 0).all()
    # Slivers of a tube 2.4 voxels thick lie 0.11 voxels off.
    assert np.abs(np.asarray(shape.distance(found.position))).max() < 0.13 / N
    # Positions are in their voxels and on their planes.
    local = found.position * N - found.voxel - 0.5
    assert np.abs(local).max() <= 0.5 + 1e-6
    np.testing.assert_allclose(np.einsum("ei,ei->e", local, found.normal) + found.offset, 0, atol=0.02)


def test_ball_normals_point_from_its_centre():
    # Error budget: a plane is tangent near the middle of its patch. Half a voxel is 0.09 radians; patches of a twentieth
    # of a voxel's face are 0.12 off.
    found = elements(CURVED["ball"][0])
    radial = found.position - (0.48, 0.51, 0.53)
    cosine = np.einsum("ei,ei->e", found.normal, radial) / np.linalg.norm(radial, axis=1)
    angle = np.arccos(np.minimum(cosine, 1))
    assert angle.max() < 0.15 and np.sqrt(np.average(angle**2, weights=found.area)) < 0.01


def test_aligned_box_is_exact():
    # 4 x 6 x 8 voxels: one element for each exposed voxel face, of a whole face's area, on the solid side (offset -1/2).
    lower, upper = np.array([4, 5, 3]) / N, np.array([8, 11, 11]) / N
    found = elements(rm.Box(lower, upper))
    assert len(found) == 2 * (4 * 6 + 6 * 8 + 8 * 4)
    np.testing.assert_allclose(found.area, 1 / N**2, rtol=1e-9)
    np.testing.assert_allclose(found.offset, -0.5, atol=1e-9)
    assert (np.abs(found.normal).max(axis=1) > 1 - 1e-12).all()
    # Voxels with an edge of the box hold two elements, those at its corners three.
    _, count = np.unique(found.voxel, axis=0, return_counts=True)
    assert (np.bincount(count)[1:] == [2 * (2 * 4 + 4 * 6 + 6 * 2), 4 * (2 + 4 + 6), 8]).all()
    # The box's inside is solid but for its CUT voxels.
    assert found.solid.sum() == 2 * 4 * 6


@pytest.mark.parametrize(("axis", "tolerance"), [((0, 0, 1), 0.03), ((1, 2, 3), 0.05)])
def test_area_of_a_box_that_stands_askew(axis, tolerance):
    box = rm.Box((0.25, 0.3, 0.28), (0.75, 0.7, 0.72))
    sides = np.array([0.5, 0.4, 0.44])
    area = 2 * (sides[0] * sides[1] + sides[1] * sides[2] + sides[2] * sides[0])
    found = elements(box.rotate(axis, np.radians(30), (0.5, 0.5, 0.5)))
    np.testing.assert_allclose(found.area.sum(), area, rtol=tolerance)


@pytest.mark.parametrize("kind", [rm.OPEN, rm.Wall(0.5)], ids=["open", "wall"])
def test_sides_of_the_lattice(kind):
    lattice = rm.Lattice((3, 4, 5), spacing=0.5, origin=(1, 2, 3))
    found = find_surfaces(rm.Scene(lattice, boundary=rm.Boundary(kind, kind, kind)))
    assert len(found) == 2 * (12 + 20 + 15)
    np.testing.assert_array_equal(found.area, 0.25)
    assert (found.open == (kind is rm.OPEN)).all()
    for side in range(6):
        ours = found.side == side
        axis, upper = side // 2, side % 2
        inward = np.eye(3)[axis] * (-1 if upper else 1)
        np.testing.assert_array_equal(found.normal[ours], np.tile(inward, (ours.sum(), 1)))
        np.testing.assert_allclose(found.position[ours, axis], (lattice.upper if upper else lattice.lower)[axis])
        np.testing.assert_array_equal(found.material[ours], side)


def test_mirror_and_periodic_sides_have_no_elements():
    lattice = rm.Lattice((3, 4, 5))
    found = find_surfaces(rm.Scene(lattice, boundary=rm.Boundary(rm.MIRROR, rm.PERIODIC, rm.Wall())))
    assert set(found.side) == {4, 5} and len(found) == 2 * 12


def test_lamp_flush_with_the_ceiling_takes_its_place():
    # A box behind the side z+, flush with it: it shows through the side, with its own material, and the wall gives way.
    lamp = rm.Box((0.25, 0.25, 1), (0.5, 0.75, 1.25))
    found = elements(lamp, boundary=rm.Boundary(rm.Wall(), rm.Wall(), rm.Wall()), n=8)
    ceiling = found.side == 5
    np.testing.assert_allclose(found.area[ceiling & (found.material == 0)].sum(), 0.125)
    np.testing.assert_allclose(found.area[ceiling].sum(), 1.0)
    assert len(found) == 6 * 64


def test_floor_covered_by_a_block_has_no_elements():
    found = elements(problems.BLOCK, boundary=rm.Boundary(rm.Wall(), rm.Wall(), rm.Wall()), n=8)
    floor = found.side == 4
    np.testing.assert_allclose(found.area[floor].sum(), 1 - 0.125)
    covered = (found.voxel[floor, :2] >= (2, 2)) & (found.voxel[floor, :2] < (6, 4))
    assert not covered.all(axis=1).any()


def test_underside_of_a_block_on_the_floor_has_no_elements():
    found = elements(problems.BLOCK, boundary=rm.Boundary(rm.Wall(), rm.Wall(), rm.Wall()), n=8)
    np.testing.assert_allclose(found.area[found.material == 0].sum(), 0.125 + 2 * (0.25 + 0.125))
    assert found.normal[found.material == 0, 2].min() == 0


def test_ball_that_dips_through_a_wall_covers_part_of_it():
    # Cap of height h in the floor: the disc of radius sqrt(2 r h - h^2) is missing from it. Error budget: faces sampled 4 x 4.
    found = elements(rm.Sphere((0.5, 0.5, 0.1), 0.3), boundary=rm.Boundary(rm.Wall(), rm.Wall(), rm.Wall()))
    disc = np.pi * (0.3**2 - 0.1**2)
    np.testing.assert_allclose(found.area[found.side == 4].sum(), 1 - disc, rtol=0.01)
    np.testing.assert_allclose(found.area[found.side < 0].sum(), 2 * np.pi * 0.3 * 0.4, rtol=0.02)


def test_materials_tell_solids_apart():
    found = elements(rm.Sphere((0.3, 0.5, 0.5), 0.2), rm.Sphere((0.75, 0.5, 0.5), 0.15))
    assert (found.position[found.material == 0, 0] < 0.55).all()
    assert (found.position[found.material == 1, 0] > 0.55).all()
    assert set(found.material) == {0, 1}

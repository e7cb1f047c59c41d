"""Rays against closed forms: where they hit, what they see, what a medium lets through and adds. Tolerances are float32's."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import raymanifold_jax as rm
from raymanifold_jax.trace import Patch, first_hit, look_at_patch, march, transmittance, visible
from raymanifold_jax.unfolding import in_blocks

N = 16
LATTICE = rm.Lattice((N, N, N), spacing=1 / N)
WALL = rm.Wall(0.5)
CLOSED = rm.Boundary(WALL, WALL, WALL)
VOXEL = LATTICE.spacing
CLOSE = 2e-4 * VOXEL  # twice the distance at which a ray counts as arrived


def rays(count: int, seed: int = 0, lower=0.05, upper=0.95) -> tuple[np.ndarray, np.ndarray]:
    """Points of the unit cube, and unit vectors."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    return rng.uniform(lower, upper, (count, 3)), directions / np.linalg.norm(directions, axis=1, keepdims=True)


def assert_close(value, expected, **tolerance):
    np.testing.assert_allclose(np.asarray(value), expected, **tolerance)


# What rays hit


def ball_of(origins, directions, center, radius):
    """Distance to a ball from outside, NaN for rays that miss it: the smaller root of |o + t w - c| = r."""
    arm = origins - np.asarray(center)
    b, c = (arm * directions).sum(1), (arm**2).sum(1) - radius**2
    with np.errstate(invalid="ignore"):
        t = -b - np.sqrt(b**2 - c)
    return np.where(t > 0, t, np.nan)


def sides_of(origins, directions):
    """Distance to the unit cube's side from inside, and which side it is."""
    with np.errstate(divide="ignore"):
        t = np.where(directions > 0, (1 - origins) / directions, -origins / directions)
    axis = t.argmin(1)
    return t.min(1), 2 * axis + (np.take_along_axis(directions, axis[:, None], 1)[:, 0] > 0)


def test_ball_in_a_closed_box():
    """Distances and materials of 4000 rays, apart from those that graze the ball within a hundredth of a voxel."""
    center, radius = (0.5, 0.45, 0.55), 0.25
    scene = rm.Scene(LATTICE, [rm.Solid(rm.Sphere(center, radius))], boundary=CLOSED)
    origins, directions = rays(4000)
    outside = np.linalg.norm(origins - center, axis=1) > radius + 0.01
    origins, directions = origins[outside], directions[outside]
    nearest = np.linalg.norm(np.cross(origins - center, directions), axis=1)
    clear = np.abs(nearest - radius) > 0.01 * VOXEL
    ball = ball_of(origins, directions, center, radius)
    far, side = sides_of(origins, directions)
    hit = first_hit(scene, origins, directions)
    on_ball = ~np.isnan(ball)
    assert (np.asarray(hit.material) == np.where(on_ball, 0, 1 + side))[clear].all()
    # A ray at angle a to the surface arrives 1e-4 voxel before it: 1e-4 / sin a along the ray.
    slope = np.sqrt(np.maximum(1 - (nearest / radius) ** 2, 1e-4))
    error = np.abs(np.asarray(hit.distance) - np.where(on_ball, ball, far))[clear]
    assert (error < np.where(on_ball, CLOSE / slope, 1e-5)[clear]).all()
    expected = (np.asarray(hit.point) - center) / np.linalg.norm(np.asarray(hit.point) - center, axis=1, keepdims=True)
    assert_close(np.asarray(hit.normal)[on_ball & clear], expected[on_ball & clear], atol=1e-4)
    assert_close(hit.enter, 0.0)


SHAPES = {
    "box": (rm.Box((0.35, 0.4, 0.3), (0.6, 0.7, 0.65)), (0, 0, 0.65), (0, 0, 1)),
    "sphere": (rm.Sphere((0.5, 0.5, 0.5), 0.2), (0, 0, 0.7), (0, 0, 1)),
    "torus": (rm.Torus((0.3, 0.5, 0.5), 0.2, 0.1), (0, 0, 0.6), (0, 0, 1)),
    "cylinder": (rm.Cylinder((0.2, 0.5, 0.4), (0.8, 0.5, 0.4), 0.15), (0, 0, 0.55), (0, 0, 1)),
    "half space": (rm.HalfSpace((0.5, 0.5, 0.4), (1, 0, 1)), (0, 0, 0.4), (math.sqrt(0.5), 0, math.sqrt(0.5))),
    "turned box": (rm.Box((0.4, 0.4, 0.4), (0.6, 0.6, 0.6)).rotate((0, 1, 0), math.pi / 4, (0.5, 0.5, 0.5)), None, None),
    "bowl": (rm.Box((0.3, 0.3, 0.2), (0.7, 0.7, 0.6)).difference(rm.Sphere((0.5, 0.5, 0.6), 0.15)), (0, 0, 0.45), (0, 0, 1)),
    "union": (rm.Sphere((0.2, 0.2, 0.2), 0.1).union(rm.Sphere((0.5, 0.5, 0.5), 0.1)), (0, 0, 0.6), (0, 0, 1)),
}  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_seen_from_above(shape):
    """A ray straight down on (0.5, 0.5) meets the top of each shape."""
    solid, top, normal = SHAPES[shape]
    top = top or (0, 0, 0.5 + 0.1 * math.sqrt(2))
    hit = first_hit(rm.Scene(LATTICE, [rm.Solid(solid)]), [[0.5, 0.5, 0.95]], [[0, 0, -1.0]])
    # On a slope of 45 degrees the last 1e-4 voxel are longer; on an edge the normal is anything.
    assert_close(hit.distance, 0.95 - top[2], atol=CLOSE)
    assert int(hit.material[0]) == 0
    if normal is not None:
        assert_close(hit.normal[0], normal, atol=1e-4)


def test_open_sides_and_misses():
    """From outside: through the box, at the box's walls (which are seen from inside only), and past it."""
    scene = rm.Scene(LATTICE, boundary=rm.Boundary(x=rm.OPEN, y=WALL, z=WALL))
    origins = [[-1, 0.5, 0.5], [0.5, 0.5, 3], [0.5, 0.5, 3], [0.5, 0.5, 0.5]]
    directions = [[1, 0, 0], [0, 0, -1], [0, 1, 0], [-1, 0, 0]]
    hit = first_hit(scene, origins, directions)
    assert_close(hit.distance, [2, 3, np.inf, 0.5], rtol=1e-6)
    assert_close(hit.enter, [1, 2, np.inf, 0], rtol=1e-6)
    assert hit.material.tolist() == [-1, 4, -1, -1]
    assert_close(hit.normal[1], [0, 0, 1])
    assert_close(hit.point[1], [0.5, 0.5, 0], atol=1e-6)


def test_flush_lamp():
    """A solid that touches the ceiling from behind is what rays hit there; from outside it does not stop them."""
    lamp = rm.Solid(rm.Box((0.375, 0.375, 1), (0.625, 0.625, 1.1)), emission=1.0)
    scene = rm.Scene(LATTICE, [lamp], boundary=CLOSED)
    origins = [[0.5, 0.5, 0.2], [0.2, 0.5, 0.2], [0.5, 0.5, 2], [0.5, 0.5, 1]]
    directions = [[0, 0, 1], [0, 0, 1], [0, 0, -1], [0, 0, -1]]
    hit = first_hit(scene, origins, directions)
    assert hit.material.tolist() == [0, 6, 5, 5]
    assert_close(hit.distance, [0.8, 0.8, 2, 1], atol=CLOSE)
    assert_close(hit.normal[0], [0, 0, -1], atol=1e-4)


@pytest.mark.parametrize("kind", ["lower", "upper", "both", "periodic"])
def test_images_equal_reality(kind):
    """A ball and a wall behind mirrors, or repeated, against the same scene with the images built as solids."""
    center, radius, far = np.array([0.3, 0.45, 0.6]), 0.12, 4
    mirror, periodic = rm.MIRROR, rm.PERIODIC
    x = {"lower": (mirror, WALL), "upper": (WALL, mirror), "both": mirror, "periodic": periodic}[kind]
    scene = rm.Scene(LATTICE, [rm.Solid(rm.Sphere(center, radius))], boundary=rm.Boundary(x=x, y=WALL, z=WALL))
    blocks = {"lower": [-1, 0], "upper": [0, 1], "both": range(-far, far + 1), "periodic": range(-far, far + 1)}[kind]
    places = [b + (1 - center[0] if b % 2 and kind != "periodic" else center[0]) for b in blocks]
    balls = [rm.Solid(rm.Sphere((p, center[1], center[2]), radius)) for p in places]
    wide = rm.Lattice((N * len(places), N, N), VOXEL, (min(blocks), 0, 0))
    built = rm.Scene(wide, balls, boundary=rm.Boundary(x=WALL, y=WALL, z=WALL))
    origins, directions = rays(600, seed=3)
    kept = (np.linalg.norm(origins - center, axis=1) > radius + 0.01) & (np.abs(directions[:, 0]) < 0.85)
    origins, directions = origins[kept], directions[kept]
    here, there = first_hit(scene, origins, directions), first_hit(built, origins, directions)
    same_ball = (np.asarray(here.material) == 0) == (np.asarray(there.material) < len(balls))
    error = np.abs(np.asarray(here.distance) - np.asarray(there.distance))
    # Rays that graze a ball may differ: one in a hundred.
    assert np.mean(same_ball & (error < 10 * CLOSE)) > 0.99
    if kind != "periodic":  # a mirror turns the direction of travel, once for each image
        block = np.floor(np.asarray(there.point)[:, 0] - 1e-4 * directions[:, 0])
        flipped = np.where(block % 2 == 1, -1, 1) * directions[:, 0]
        assert np.mean(np.abs(np.asarray(here.direction)[:, 0] - flipped) < 1e-6) > 0.99
    point = np.asarray(here.point)
    assert ((point > -1e-5) & (point < 1 + 1e-5)).all()


def test_endless_rays_end():
    """Between mirrors without loss, or round and round: such a ray leaves after a bounded number of images."""
    scene = rm.Scene(LATTICE, [rm.Solid(rm.Sphere((0.5, 0.5, 0.2), 0.1))], boundary=rm.Boundary(rm.MIRROR, rm.PERIODIC, WALL))
    hit = first_hit(scene, [[0.3, 0.3, 0.7]] * 2, [[1, 0, 0], [0, 1, 0]])
    assert hit.material.tolist() == [-1, -1]
    assert np.isfinite(np.asarray(hit.distance)).all()


def test_far_eye_loses_no_precision():
    """From 100 box lengths away the distance's own rounding is left, but not a wrong material."""
    scene = rm.Scene(LATTICE, [rm.Solid(rm.Sphere((0.5, 0.5, 0.5), 0.2))], boundary=CLOSED)
    hit = first_hit(scene, [[0.5, 0.5, 100.0]], [[0, 0, -1.0]])
    assert int(hit.material[0]) == 0
    assert_close(hit.point[0], [0.5, 0.5, 0.7], atol=1e-5)


def test_same_under_jit():
    """Traced arguments, of a number that is no multiple of a block, give the same."""
    scene = rm.Scene(LATTICE, [rm.Solid(rm.Sphere((0.5, 0.5, 0.5), 0.2))], boundary=CLOSED)
    origins, directions = rays(1500, upper=0.25)
    inside = jax.jit(lambda o, w: first_hit(scene, o, w).distance)(jnp.asarray(origins), jnp.asarray(directions))
    assert_close(inside, first_hit(scene, origins, directions).distance, atol=1e-5)


# What points see


def test_visibility_past_a_ball():
    """Blocked exactly where the segment comes nearer to the centre than the radius."""
    center, radius = np.array([0.5, 0.5, 0.5]), 0.2
    scene = rm.Scene(LATTICE, [rm.Solid(rm.Sphere(center, radius))], boundary=CLOSED)
    start, _ = rays(4000, seed=1)
    end, _ = rays(4000, seed=2)
    along = np.clip(((center - start) * (end - start)).sum(1) / ((end - start) ** 2).sum(1), 0, 1)
    nearest = np.linalg.norm(start + along[:, None] * (end - start) - center, axis=1)
    outside = np.minimum(*(np.linalg.norm(p - center, axis=1) for p in (start, end))) > radius
    clear = outside & (np.abs(nearest - radius) > 0.01 * VOXEL)
    assert_close(np.asarray(visible(scene, start, end))[clear], (nearest > radius)[clear])


def test_ends_on_surfaces_see_each_other():
    """Points on a ball's near side see, and those on its far side do not see, a point on the wall."""
    center, radius = np.array([0.5, 0.5, 0.5]), 0.2
    scene = rm.Scene(LATTICE, [rm.Solid(rm.Sphere(center, radius))], boundary=CLOSED)
    _, normals = rays(2000, seed=4)
    eye = np.array([0.5, 0.4, 1.0])
    points = center + radius * normals
    cosine = ((eye - points) * normals).sum(1) / np.linalg.norm(eye - points, axis=1)
    for start, end in ((points, eye + 0 * points), (eye + 0 * points, points)):
        seen = np.asarray(visible(scene, start, end))
        clear = np.abs(cosine) > 0.05
        assert_close(seen[clear], (cosine > 0)[clear])


def test_convex_solids_do_not_hide_what_is_before_them():
    # Rays between points that face each other end as soon without the two's own solids as with them.
    convex = [
        rm.shapes.Box((0.1, 0.1, 0.05), (0.35, 0.4, 0.3)),
        rm.shapes.Sphere((0.7, 0.3, 0.3), 0.15),
        rm.shapes.Cylinder((0.3, 0.7, 0.2), (0.4, 0.75, 0.5), 0.1),
        rm.shapes.Box((0.6, 0.6, 0.6), (0.9, 0.9, 0.7)).rotate((1, 2, 0), 0.5, (0.75, 0.75, 0.65)),
        rm.shapes.Sphere((0.75, 0.75, 0.2), 0.2).intersection(rm.shapes.HalfSpace((0, 0, 0.25), (0, 0, 1))),
    ]
    hollow = rm.shapes.Torus((0.5, 0.5, 0.55), 0.2, 0.05)
    assert all(shape.convex for shape in convex)
    assert not hollow.convex
    scene = rm.Scene(LATTICE, [rm.Solid(shape) for shape in [*convex, hollow]])
    points, _ = rays(6000, lower=0.0, upper=1.0)
    for _ in range(4):
        value, pull_back = jax.vjp(scene.distance, jnp.asarray(points))
        normal = np.asarray(pull_back(jnp.ones(len(points)))[0])
        points = points - np.asarray(value)[:, None] * normal
    on = (np.abs(np.asarray(scene.distance(jnp.asarray(points)))) < 1e-5) & (np.abs(np.linalg.norm(normal, axis=1) - 1) < 1e-3)
    points, normal = points[on], normal[on]
    points = points + 2e-3 * VOXEL * normal
    solid = np.asarray(scene.solid_at(jnp.asarray(points)))
    one, other = np.random.default_rng(1).integers(len(points), size=(2, 40000))
    to = points[other] - points[one]
    to /= np.maximum(np.linalg.norm(to, axis=1, keepdims=True), 1e-9)
    ahead = np.minimum((to * normal[one]).sum(1), -(to * normal[other]).sum(1)) > 0.02
    one, other = one[ahead & (solid[one] != solid[other])], other[ahead & (solid[one] != solid[other])]
    assert len(one) > 2000
    radius = np.full(len(one), 1e-3)
    line = points[one] / VOXEL, points[other] / VOXEL
    rest = lambda *ends: jax.tree.map(np.asarray, in_blocks(look_at_patch, scene, (*line, Patch(radius, *ends))))
    nobody = np.full(len(one), -1)
    with_all, without = rest(nobody, nobody), rest(solid[other], solid[one])
    assert 0.1 < without.blocked.mean() < 0.9
    done = with_all.effort == 0
    assert done.mean() > 0.9
    assert np.mean(with_all.blocked[done] != without.blocked[done]) < 2e-3
    assert without.effort.sum() < with_all.effort.sum()  # and there is less left to do


def test_a_plane_sees_along_itself():
    """Points on a box's top, an elevation of 0.03 apart: shallow segments are not blocked by the face they start on."""
    scene = rm.Scene(LATTICE, [rm.Solid(rm.Box((0.1, 0.1, 0.1), (0.9, 0.9, 0.5)))])
    start = np.array([[0.12, 0.5, 0.5 + 1e-3 * VOXEL]])
    assert_close(visible(scene, start, [[0.88, 0.5, 0.5 + 1e-3]]), 1)
    assert_close(visible(scene, start, [[0.88, 0.5, 0.47]]), 0)


# Media


@pytest.mark.parametrize("depth", [1e-6, 1e-3, 1.0, 30.0])
@pytest.mark.parametrize("field", [False, True])
def test_homogeneous_transmittance(depth, field):
    """exp(-s l), with s one number or the same in every voxel; the part outside the box does not count."""
    value = np.full((N,) * 3, depth) if field else depth
    scene = rm.Scene(LATTICE, medium=rm.Medium(absorption=value))
    start, end = rays(300)[0], rays(300, seed=5)[0]
    length = np.linalg.norm(end - start, axis=1)
    assert_close(transmittance(scene, start, end)[0], np.exp(-depth * length), rtol=1e-5 * max(depth, 1))
    across = transmittance(scene, [[-1, 0.5, 0.3]], [[4, 0.5, 0.3]])
    assert_close(across, math.exp(-depth), rtol=1e-5 * max(depth, 1))
    assert_close(transmittance(scene, [[-1, 2, 0.3]], [[4, 2, 0.3]]), 1)


def test_layers():
    """Extinction s(z), constant in layers of one voxel, in two bands: the optical depth is its integral in z over w_z."""
    layers = np.random.default_rng(0).uniform(0, 20, (N, 2))
    field = np.broadcast_to(layers, (N, N, N, 2))
    scene = rm.Scene(LATTICE, medium=rm.Medium(scattering=field))
    start, end = rays(300)[0], rays(300, seed=6)[0]
    below = np.concatenate([np.zeros((1, 2)), np.cumsum(layers, 0) * VOXEL])
    integral = lambda z: np.stack([np.interp(z, np.arange(N + 1) * VOXEL, below[:, band]) for band in range(2)])
    rise = end[:, 2] - start[:, 2]
    depth = (integral(end[:, 2]) - integral(start[:, 2])) * np.linalg.norm(end - start, axis=1) / rise
    assert_close(transmittance(scene, start, end), np.exp(-depth), rtol=5e-5)


def test_vacuum_lets_all_through():
    scene = rm.Scene(LATTICE, lights=[rm.Sky([1.0, 2.0])])
    assert_close(transmittance(scene, [[0.1] * 3], [[0.9] * 3]), np.ones((2, 1)))


@pytest.mark.parametrize("scattering", [0.0, 1e-5, 3.0, 200.0])
@pytest.mark.parametrize("field", [False, True])
def test_march_in_uniform_fluence(scattering, field):
    """S (1 - exp(-tau)) with S = (z phi / 4 pi + e) / s, and e l where nothing absorbs or scatters."""
    fluence, emission, absorption = 5.0, 0.3, 0.5 * scattering
    value = np.full((N,) * 3, scattering) if field else scattering
    scene = rm.Scene(LATTICE, medium=rm.Medium(value, absorption, emission))
    origins, directions = rays(200)
    stop = sides_of(origins, directions)[0]
    light = jnp.full((1, N, N, N), fluence)
    radiance, passed = march(scene, light, jnp.ones((N,) * 3), origins, directions, np.zeros(200), stop)
    extinction = scattering + absorption
    source = scattering * fluence / (4 * np.pi) + emission
    expected = source * (stop if extinction == 0 else -np.expm1(-extinction * stop) / extinction)
    assert_close(radiance[0], expected, rtol=2e-5)
    assert_close(passed[0], np.exp(-extinction * stop), rtol=1e-5 * max(extinction, 1), atol=1e-37)


@pytest.mark.parametrize("field", [False, True])
def test_march_follows_a_linear_fluence(field):
    """Without absorption, thin: z / 4 pi times the integral of phi = x + 2 y + 3 z along the ray, which is phi's mean."""
    thin = 1e-4
    value = np.full((N,) * 3, thin) if field else thin
    scene = rm.Scene(LATTICE, medium=rm.Medium(value))
    light = jnp.asarray(LATTICE.centers() @ [1.0, 2.0, 3.0])[None]
    start, end = rays(200)[0], rays(200, seed=7)[0]
    length = np.linalg.norm(end - start, axis=1)
    directions = (end - start) / length[:, None]
    radiance, _ = march(scene, light, jnp.ones((N,) * 3), start, directions, np.zeros(200), length)
    mean = (start + end) / 2 @ [1.0, 2.0, 3.0]
    assert_close(radiance[0], thin * length * mean / (4 * np.pi), rtol=1e-3)


def test_march_through_images_of_the_medium():
    """A ray between mirrors meets the same layer again in every image: the depth is that of the way back and forth."""
    field = np.zeros((N, N, N))
    field[: N // 4] = 3.0
    scene = rm.Scene(LATTICE, medium=rm.Medium(absorption=field), boundary=rm.Boundary(x=rm.MIRROR))
    light = jnp.zeros((1, N, N, N))
    origins, directions = [[0.5, 0.5, 0.5]], [[1.0, 0, 0]]
    # To x = 2.5: the layers around 2 are crossed, and no other; to 1.9 about half of the first.
    for stop, crossed in ((1.0, 0.0), (1.5, 0.25), (2.0, 0.5), (4.0, 1.0)):
        _, passed = march(scene, light, jnp.ones((N,) * 3), origins, directions, [0.0], [stop])
        assert_close(passed, math.exp(-3 * crossed), rtol=1e-5)


def test_solids_do_not_darken_the_fluence_beside_them():
    """Voxels without free space hold 0, which must not enter the interpolation."""
    light = np.ones((1, N, N, N))
    free = np.ones((N, N, N))
    light[..., : N // 2], free[..., : N // 2] = 0, 0
    scene = rm.Scene(LATTICE, medium=rm.Medium(1e-4))
    ray = ([[0.1, 0.5, 0.5 + 0.1 * VOXEL]], [[1.0, 0, 0]], [0.0], [0.8])
    radiance, _ = march(scene, jnp.asarray(light), jnp.asarray(free), *ray)
    assert_close(radiance, 1e-4 * 0.8 / (4 * np.pi), rtol=1e-3)


def test_no_rays():
    scene = rm.Scene(LATTICE, [rm.Solid(rm.Sphere((0.5, 0.5, 0.5), 0.2))], rm.Medium(1.0))
    none = np.zeros((0, 3))
    assert first_hit(scene, none, none).point.shape == (0, 3)
    assert transmittance(scene, none, none).shape == (1, 0)


def test_blocks_are_put_together_in_order():
    values = np.arange(40_000.0)
    assert_close(in_blocks(lambda _, x: 2 * x, None, (values,)), 2 * values)

"""A 2D array of processing elements: a mesh of devices with axes `u` and `v`.

`solve(..., mesh=pe_array(nu, nv))` splits the (u, v) planes of every sweep in nu x nv blocks, one a device.

Public: `pe_array`, `check_mesh`, `NAMES`.
"""

from __future__ import annotations

import os

import jax
from jax.sharding import AxisType, Mesh

from . import checks

NAMES = ("u", "v")
_PATIENCE = 1200  # seconds that a virtual device waits for the others; they share a few cores


def pe_array(nu: int, nv: int) -> Mesh:
    """An array of nu x nv processing elements: a mesh with axes "u" and "v" on the first devices there are.

    GPUs and TPUs are taken as they are. Of CPUs there is one, which is split into as many virtual ones as are needed, if JAX
    has not started yet: it starts at its first computation. In runs of several processes (`jax.distributed`) the devices of all
    processes count, in order.

    **Raises** `TypeError` or `ValueError` for anything but two positive whole numbers, and for more elements than devices.
    """
    nu, nv = checks.positive_int("nu", nu), checks.positive_int("nv", nv)
    if nu * nv > 1 and not jax.distributed.is_initialized():
        _make_virtual(nu * nv)
    devices = jax.devices()
    if len(devices) < nu * nv:
        kind = devices[0].platform.upper()
        way = (
            "JAX has started already: call pe_array before anything that computes, or set "
            f"JAX_NUM_CPU_DEVICES={nu * nv} in the environment"
            if kind == "CPU"
            else "use a smaller array, more processes (jax.distributed), or virtual devices (JAX_PLATFORMS=cpu)"
        )
        checks.fail("pe_array", f"{nu} x {nv} elements", f"at most the {len(devices)} {kind} device(s) there are", way)
    return jax.make_mesh((nu, nv), NAMES, axis_types=(AxisType.Auto,) * 2, devices=devices[: nu * nv])


def _make_virtual(count: int) -> None:
    """As many CPU devices, unless JAX runs already or they were asked for in other ways."""
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_force_host_platform_device_count" in flags or _asked_for() >= count:
        return
    try:
        jax.config.update("jax_num_cpu_devices", count)
    except RuntimeError:  # JAX has started; the caller counts the devices
        return
    patience = "xla_cpu_collective_call_terminate_timeout_seconds"
    if patience not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --{patience}={_PATIENCE}".strip()


def _asked_for() -> int:
    count: int = jax.config.jax_num_cpu_devices  # pyright: ignore[reportAttributeAccessIssue]
    return count


def check_mesh(mesh: object, shape: tuple[int, int, int]) -> None:
    """Refuse what is no mesh for a lattice of that shape."""
    advice = "make it with rm.pe_array(nu, nv)"
    checks.instance("mesh", mesh, Mesh, advice)
    assert isinstance(mesh, Mesh)
    if tuple(mesh.axis_names) != NAMES:
        checks.fail("mesh", f"axes {tuple(mesh.axis_names)}", f"axes {NAMES}", advice)
    if any(kind != AxisType.Auto for kind in mesh.axis_types):
        checks.fail("mesh", f"axis types {mesh.axis_types}", "AxisType.Auto for both", advice)
    size, fewest = (mesh.shape["u"], mesh.shape["v"]), min(shape)
    if max(size) > fewest:
        got = f"{size[0]} x {size[1]} elements for {' x '.join(map(str, shape))} voxels"
        checks.fail("mesh", got, f"at most {fewest} elements a side, a voxel each", "use fewer elements, or more voxels")

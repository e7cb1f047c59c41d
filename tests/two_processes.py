"""One process of a solve over several (run by `test_sharding.py`): PROCESSES NUMBER PORT FILE, or FILE for one process.

The mesh is 2 x 2: two processes with two virtual devices each, or one with four.
"""

import os
import sys

import jax
import numpy as np

import raymanifold_jax as rm


def main() -> None:
    *place, file = sys.argv[1:]
    if len(place) == 3:
        jax.config.update("jax_num_cpu_devices", 2)
        jax.distributed.initialize(
            f"127.0.0.1:{place[2]}", int(place[0]), int(place[1]), initialization_timeout=60, heartbeat_timeout_seconds=20
        )
    mesh = rm.pe_array(2, 2)
    # A peer that is lost before its first exchange.
    if len(place) == 3 and os.environ.get("DIES") == place[1]:
        os._exit(3)
    wall = rm.Wall(albedo=0.6)
    scene = rm.Scene(
        rm.Lattice((5, 5, 5), spacing=0.2),
        [rm.Solid(rm.Sphere((0.5, 0.5, 0.4), 0.25), albedo=0.8 if place and place[1:2] == [os.environ.get("ALTERS")] else 0.7)],
        medium=rm.Medium(scattering=1.0, absorption=0.2),
        lights=[rm.Sky(radiance=1.0), rm.PointLight((0.8, 0.8, 0.8), 1.0)],
        boundary=rm.Boundary(x=wall, y=wall, z=(wall, rm.OPEN)),
    )
    solution = rm.solve(scene, rm.quadrature.fibonacci(24), rtol=1e-4, mesh=mesh, progress=False)
    np.savez(file, fluence=np.asarray(solution.fluence), irradiance=np.asarray(solution.surfaces.irradiance))
    print(solution.result, flush=True)


if __name__ == "__main__":
    main()

"""Fetch what the scene `ant.toml` needs into the current folder: a mesh of the package pyvista, and a sky made by Mitsuba.

The sky is Mitsuba's plugin `sunsky` (Hosek and Wilkie's model; turbidity 3, ground albedo 0.3) without its sun, as a
latitude-longitude picture.
"""

import shutil
from importlib.resources import files
from pathlib import Path

import mitsuba
import numpy as np

import raymanifold_jax as rm

HEIGHT = 64  # pixels from zenith to nadir

mitsuba.set_variant("scalar_rgb")
to_sun = [-0.6, 0.2, 0.62]
sky = mitsuba.load_dict(
    {"type": "sunsky", "sun_direction": to_sun, "turbidity": 3.0, "albedo": 0.3, "sun_scale": 0.0}
)  # fmt: skip
row, column = np.mgrid[:HEIGHT, : 2 * HEIGHT] + 0.5
polar, azimuth = np.pi * row / HEIGHT, -np.pi * column / HEIGHT  # a picture of the sky: clockwise from above
towards = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)
image = np.zeros(towards.shape, np.float32)
for pixel in np.ndindex(towards.shape[:2]):
    at = mitsuba.SurfaceInteraction3f()
    at.wi = mitsuba.Vector3f(*(-towards[pixel]).tolist())
    image[pixel] = np.maximum(np.array(sky.eval(at)).ravel(), 0.0)
rm.io.write_exr("sky.exr", image)
shutil.copy(str(files("pyvista") / "examples" / "ant.ply"), "ant.ply")
if not Path("ant.toml").exists():
    shutil.copy(Path(__file__).with_name("ant.toml"), "ant.toml")
print("wrote sky.exr, ant.ply and ant.toml; next: raymanifold render ant.toml --resolution 640x480 --out ant.exr")

"""Files: pictures (OpenEXR for radiance, PNG for looking at it), volumes for media, and whole scenes in TOML."""

from .exr import read_exr, write_exr
from .mesh_colors import read_face_colors
from .png import to_srgb8, write_png
from .scene_file import SceneFile, SceneFileError, load_scene, read_sky
from .scene_writer import save_scene
from .volume import medium_from_density, read_volume

__all__ = [
    "SceneFile",
    "SceneFileError",
    "load_scene",
    "medium_from_density",
    "read_exr",
    "read_face_colors",
    "read_sky",
    "read_volume",
    "save_scene",
    "to_srgb8",
    "write_exr",
    "write_png",
]

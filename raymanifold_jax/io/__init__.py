"""Picture files: OpenEXR for radiance, PNG for looking at it."""

from .exr import read_exr, write_exr
from .png import to_srgb8, write_png

__all__ = ["read_exr", "to_srgb8", "write_exr", "write_png"]

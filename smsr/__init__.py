"""Moving 3D surfaces from 2D point tracks of one orthographic camera."""

__version__ = "0.1.0"

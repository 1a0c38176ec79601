"""Ways of finding the shapes of all frames, given the cameras."""

from smsr.shapes.estimate import ShapeEstimate, basis_size_of
from smsr.shapes.selection import estimate_shapes

__all__ = ["ShapeEstimate", "basis_size_of", "estimate_shapes"]

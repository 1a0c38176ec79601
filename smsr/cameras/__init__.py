"""Ways of finding the orthographic camera of each frame."""

from smsr.cameras.estimate import CameraEstimate
from smsr.cameras.gauge import fix_gauge
from smsr.cameras.selection import estimate_cameras

__all__ = ["CameraEstimate", "estimate_cameras", "fix_gauge"]

"""Run inside Blender: import a GLB and write the points at given times as JSON.

blender --background --factory-startup --python import_into_blender.py -- FILE OUT TIME...
"""

import json
import sys
from pathlib import Path

import bpy
import numpy as np

if not hasattr(np, "bool"):
    vars(np)["bool"] = bool  # used by the importer of Blender 3.4, not in numpy 1.24 to 1.26
source, out, *times = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=source)
(surface,) = (thing for thing in bpy.data.objects if thing.type == "MESH")
scene = bpy.context.scene
positions = []
for time in map(float, times):
    frame = time * scene.render.fps
    scene.frame_set(int(frame), subframe=frame - int(frame))
    shown = surface.evaluated_get(bpy.context.evaluated_depsgraph_get())
    positions.append([list(shown.matrix_world @ point.co) for point in shown.to_mesh().vertices])
keys = surface.data.shape_keys
report = {
    "faces": len(surface.data.polygons),
    "keys": [key.name for key in keys.key_blocks],
    "actions": [action.name for action in bpy.data.actions],
    "positions": positions,
}
Path(out).write_text(json.dumps(report), encoding="utf-8")

# Blender's checks of .ci/drive: blender --background --python drive.py -- FOLDER.
import shutil
import sys

import bpy
import numpy

# Blender 3.4's reader of glTF beside a newer numpy.
if "bool" not in numpy.__dict__:
    numpy.bool = bool
# And its reader of BVH beside Python 3.11.
from io_anim_bvh import import_bvh

import_bvh.open = lambda path, mode="r": open(path, mode.replace("U", ""))

folder = sys.argv[sys.argv.index("--") + 1]
failures = 0


def check(holds, what):
    global failures
    print("ok     " if holds else "FAILED ", what)
    failures += not holds


def read(name, operator, **options):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    operator(filepath=f"{folder}/{name}", **options)
    return next(o for o in bpy.data.objects if o.type == "ARMATURE")


def places(armature, frames):
    """Heads of all bones in the world at some frames."""
    out = []
    for frame in frames:
        bpy.context.scene.frame_set(int(frame), subframe=frame % 1)
        out.append({b.name: armature.matrix_world @ b.head for b in armature.pose.bones})
    return out


shutil.copy(f"{folder}/person.vrm", f"{folder}/vrm.glb")
glb = read("person.glb", bpy.ops.import_scene.gltf)
fps = bpy.context.scene.render.fps
start, end = glb.animation_data.action.frame_range
steps = 5
expected = places(glb, [start + (end - start) * i / steps for i in range(steps)])
meshes = [o for o in bpy.data.objects if o.type == "MESH" and o.find_armature()]
check(len(meshes) == 1 and meshes[0].data.materials, f"Blender {bpy.app.version_string} reads the GLB: {len(glb.pose.bones)} bones, {end - start:.0f} frames")
vrm = read("vrm.glb", bpy.ops.import_scene.gltf)
found = places(vrm, [start + (end - start) * i / steps for i in range(steps)])
worst = max((a[name] - b[name]).length for a, b in zip(expected, found) for name in a)
check(worst < 2e-3, f"the VRM moves as the GLB does: {1e3 * worst:.2f} mm")
bvh = read("person.bvh", bpy.ops.import_anim.bvh, global_scale=0.01, axis_forward="-Z", axis_up="Y", update_scene_fps=True, update_scene_duration=True)
first, last = bvh.animation_data.action.frame_range
found = places(bvh, [first + round((last - first) * i / steps) for i in range(steps)])
moves = max((a[name] - b[name]).length for a, b in zip(found, found[1:]) for name in a)
check(moves > 0.05, f"the BVH moves: {len(bvh.pose.bones)} bones, {last - first:.0f} frames")
apart = (found[0]["pelvis"] - expected[0]["pelvis"]).length
worst = max((found[0][name] - expected[0][name]).length for name in expected[0])
check(worst < 1e-2, f"its first frame is the GLB's: joints within {1e3 * worst:.2f} mm")
sys.exit(1 if failures else 0)

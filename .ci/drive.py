# Blender's checks of .ci/drive: blender --background --python drive.py -- FOLDER.
import json
import re
import shutil
import sys

import bpy
import numpy
from mathutils import Matrix

# Blender 3.4's reader of glTF beside a newer numpy.
if "bool" not in numpy.__dict__:
    numpy.bool = bool
# And its reader of BVH beside Python 3.11.
from io_anim_bvh import import_bvh

import_bvh.open = lambda path, mode="r": open(path, mode.replace("U", ""))

SIDE = 256
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


def pixels(path):
    """A picture over white, rows from the bottom, sRGB from 0 to 1."""
    image = bpy.data.images.load(path)
    values = numpy.array(image.pixels[:]).reshape(image.size[1], image.size[0], 4)
    return values[..., :3] * values[..., 3:] + 1 - values[..., 3:]


def draw(camera, path):
    """Cycles from a training camera."""
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 32, False
    scene.cycles.pixel_filter_type, scene.render.film_transparent = "BOX", True
    scene.view_settings.view_transform = "Standard"
    size = scene.render.resolution_x, scene.render.resolution_y = SIDE, SIDE * camera["size"][1] // camera["size"][0]
    if scene.camera is None:
        scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        scene.collection.objects.link(scene.camera)
    (fx, fy, cx, cy), (width, height) = camera["k"], camera["size"]
    lens = scene.camera.data
    lens.sensor_fit, lens.lens = "HORIZONTAL", fx / width * lens.sensor_width
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = 1, fx / fy
    lens.shift_x, lens.shift_y = 0.5 - cx / width, (cy - height / 2) / width
    rows = [camera["e"][4 * row : 4 * row + 4] for row in range(3)] + [[0, 0, 0, 1]]
    # Blender's world has z up, its cameras look along -z.
    to_world = Matrix.Rotation(numpy.pi / 2, 4, "X") @ Matrix(rows).inverted()
    scene.camera.matrix_world = to_world @ Matrix.Diagonal((1, -1, -1, 1))
    scene.render.filepath = path
    bpy.ops.render.render(write_still=True)


def compare(start, end):
    """Five frames of the unlit person against what `render` draws, dB."""
    page = open(f"{folder}/person.html").read()
    cameras = json.loads(re.search(r'<script id="extra"[^>]*>(.*?)</script>', page, re.S)[1])["cameras"]
    worst, last = numpy.inf, len(cameras) - 1
    for frame in [i * last // 4 for i in range(5)]:
        time = start + (end - start) * frame / last
        bpy.context.scene.frame_set(int(time), subframe=time % 1)
        path = f"{folder}/blender-{frame:04}.png"
        draw(cameras[frame], path)
        error = (pixels(path) - pixels(f"{folder}/movement/{frame:04}.png")) ** 2
        worst = min(worst, -10 * numpy.log10(error.mean()))
    check(worst >= 30, f"Blender draws five frames as we do: at least {worst:.2f} dB of 30")


shutil.copy(f"{folder}/person.vrm", f"{folder}/vrm.glb")
glb = read("person.glb", bpy.ops.import_scene.gltf)
fps = bpy.context.scene.render.fps
start, end = glb.animation_data.action.frame_range
steps = 5
expected = places(glb, [start + (end - start) * i / steps for i in range(steps)])
meshes = [o for o in bpy.data.objects if o.type == "MESH" and o.find_armature()]
check(len(meshes) == 1 and meshes[0].data.materials, f"Blender {bpy.app.version_string} reads the GLB: {len(glb.pose.bones)} bones, {end - start:.0f} frames")
faces = sum(len(o.data.polygons) for o in meshes)
compare(start, end)
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
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.obj_import(filepath=f"{folder}/person.obj", forward_axis="NEGATIVE_Z", up_axis="Y")
mesh = bpy.context.selected_objects[0]
high = max((mesh.matrix_world @ v.co).z for v in mesh.data.vertices) - min((mesh.matrix_world @ v.co).z for v in mesh.data.vertices)
check(len(mesh.data.polygons) == faces and 1.4 < high < 2.1, f"the OBJ has {len(mesh.data.polygons)} faces and is {high:.2f} m high")
bpy.ops.import_mesh.ply(filepath=f"{folder}/person.ply")
splats = len(bpy.context.selected_objects[0].data.vertices)
check(splats == int(re.search(rb"element vertex (\d+)", open(f"{folder}/person.ply", "rb").read(500))[1]), f"the PLY has {splats} points")
sys.exit(1 if failures else 0)

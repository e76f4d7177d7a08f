"""Writes made shapes in the formats that coseg reads, by other programs' writers: make.py FROM TO."""

import sys
from pathlib import Path

import numpy as np
import trimesh
from plyfile import PlyData, PlyElement

source, target = map(Path, sys.argv[1:])
target.mkdir(parents=True, exist_ok=True)
one, two, three = [trimesh.load(p, process=False) for p in sorted(source.glob("*.off"))]

one.export(target / "off.off")
one.export(target / "stl-binary.stl")
two.export(target / "stl-text.stl", file_type="stl_ascii")
two.export(target / "ply-little.ply", encoding="binary")
three.export(target / "ply-text.ply", encoding="ascii")
three.export(target / "obj.obj")

vertices = np.array([tuple(v) for v in three.vertices], dtype=[(c, "f8") for c in "xyz"])
faces = np.empty(len(three.faces), dtype=[("vertex_indices", "i4", (3,))])
faces["vertex_indices"] = three.faces
elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
PlyData(elements, byte_order=">").write(str(target / "ply-big.ply"))

# A scene of two nodes that place the same mesh, one mirrored, and a third mesh.
scene = trimesh.Scene()
scene.add_geometry(one, node_name="here", geom_name="chair")
scene.graph.update("there", matrix=np.diag([-1.0, 1, 1, 1]) @ trimesh.transformations.translation_matrix([2, 0, 0]), geometry="chair")
scene.add_geometry(trimesh.creation.box(), node_name="box", transform=trimesh.transformations.translation_matrix([0, 3, 0]))
scene.export(target / "scene.glb")

# Quads, as modellers draw them: a table of five boxes.
lines, n = [], 0
for low, high in [((0, 9, 0), (20, 10, 20))] + [((x, 0, z), (x + 2, 9, z + 2)) for x in (0, 18) for z in (0, 18)]:
    for i in range(8):
        lines.append("v %g %g %g" % tuple(high[k] if i >> k & 1 else low[k] for k in range(3)))
    for quad in [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]:
        lines.append("f " + " ".join(str(n + c + 1) for c in quad))
    n += 8
(target / "quads.obj").write_text("\n".join(lines) + "\n")

# A prism over a C and a wall with a window: a concave polygon, and one with a hole that a bridge joins to its outline.
concave = [(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (3, 2), (3, 3), (0, 3)]
window = [(0, 5), (4, 5), (4, 9), (0, 9), (0, 5), (1, 6), (1, 8), (3, 8), (3, 6), (1, 6)]
lines, n = [], 0
for outline in (concave, window):
    k = len(outline)
    lines += [f"v {x} {y} {z}" for z in (0, 1) for x, y in outline]
    lines.append("f " + " ".join(str(n + i + 1) for i in reversed(range(k))))
    lines.append("f " + " ".join(str(n + k + i + 1) for i in range(k)))
    for i in range(k):
        j = (i + 1) % k
        # Nothing stands on the bridge, which is passed in both directions.
        if (outline[j], outline[i]) not in zip(outline, outline[1:] + outline[:1]):
            lines.append("f " + " ".join(str(n + c + 1) for c in (i, j, j + k, i + k)))
    n += 2 * k
(target / "concave.obj").write_text("\n".join(lines) + "\n")

# What an artist sends: named nodes, texture coordinates, normals and a material with a texture.
from PIL import Image  # noqa: E402

painted = trimesh.Scene()
oak = trimesh.visual.material.PBRMaterial(name="oak", baseColorTexture=Image.new("RGB", (4, 4), (150, 90, 40)))
for name, size, at in (("seat", (2, 0.2, 2), (0, 1, 0)), ("back", (2, 2, 0.2), (0, 2.1, -0.9))):
    box = trimesh.creation.box(size)
    outwards = np.sign(box.vertices) / np.sqrt(3)
    box = trimesh.Trimesh(box.vertices, box.faces, vertex_normals=outwards, process=False)
    box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, [0, 2]] / 2 + 0.5, material=oak)
    painted.add_geometry(box, node_name=name, geom_name=f"{name} mesh", transform=trimesh.transformations.translation_matrix(at))
painted.export(target / "painted.glb", include_normals=True)

text = ["# drawn by hand", "mtllib wood.mtl"]
n = 0
for name, low, high in (("seat", (0, 9, 0), (20, 10, 20)), ("back", (0, 10, 0), (20, 30, 1))):
    text.append(f"o {name}")
    text += ["v %g %g %g" % tuple(high[k] if i >> k & 1 else low[k] for k in range(3)) for i in range(8)]
    text += ["vt %g %g" % (i & 1, i >> 1) for i in range(4)]
    text += [f"vn {x} {y} {z}" for x, y, z in ((0, 0, -1), (0, 0, 1), (0, -1, 0), (0, 1, 0), (-1, 0, 0), (1, 0, 0))]
    text += [f"usemtl {'oak' if name == 'seat' else 'pine'}", "s off"]
    for normal, quad in enumerate([(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]):
        text.append("f " + " ".join(f"{n * 8 + c + 1}/{n * 4 + i + 1}/{n * 6 + normal + 1}" for i, c in enumerate(quad)))
    n += 1
(target / "painted-obj.obj").write_text("\n".join(text) + "\n")

# Colours of vertices, as scanners and sculptors write them: sRGB behind the coordinates.
box = trimesh.creation.box((1, 2, 3))
lines = ["v %g %g %g %g %g %g" % (*v, *(np.sign(v) + 1) / 2 * 0.5) for v in box.vertices]
lines += ["vn %g %g %g" % tuple(np.sign(v) / np.sqrt(3)) for v in box.vertices]
lines += ["f " + " ".join(f"{c + 1}//{c + 1}" for c in face) for face in box.faces]
(target / "coloured.obj").write_text("\n".join(lines) + "\n")

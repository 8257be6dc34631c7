"""Scan meshes as other tools write them: the file's own vertices in its own order, with its own colours."""

import json
import struct

import cv2
import numpy as np
import pytest
import trimesh

from caphy.errors import CaphyError
from caphy.scan.mesh_files import read_mesh_file

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float32)
RED, GREEN, BLUE, WHITE = [255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]


def _glb(path, meshes, nodes, scene):
    """A GLB of triangles that share no vertices: ``meshes`` are lists of (positions, colours or None)."""
    accessors, views, data, made = [], [], b"", []

    def stored(values, kind):
        nonlocal data
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes})
        code = {"f": 5126, "H": 5123, "B": 5121}[values.dtype.char]
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": code, "count": len(values), "type": kind}
            | ({"normalized": True} if code != 5126 else {})
        )
        data += values.tobytes() + b"\0" * (-values.nbytes % 4)
        return len(accessors) - 1

    for mesh in meshes:
        primitives = []
        for positions, colours in mesh:
            attributes = {"POSITION": stored(np.float32(positions), "VEC3")}
            if colours is not None:
                attributes["COLOR_0"] = stored(colours, f"VEC{colours.shape[1]}")
            primitives.append({"attributes": attributes})
        made.append({"primitives": primitives})
    tree = {
        "asset": {"version": "2.0"}, "buffers": [{"byteLength": len(data)}], "bufferViews": views,
        "accessors": accessors, "meshes": made, "nodes": nodes, "scenes": [{"nodes": scene}], "scene": 0,
    }  # fmt: skip
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_a_ply_with_texture_coordinates_of_its_faces_keeps_its_vertices(tmp_path, encoding):
    """As photogrammetry writes them: its seam splits two of four vertices, whose labels must not move."""
    image = np.zeros((10, 10, 3), np.uint8)
    image[:, :5], image[:, 5:] = (0, 0, 255), (255, 0, 0)  # blue-green-red: left half red, right half blue
    cv2.imwrite(str(tmp_path / "skin.png"), image)
    head = (
        f"ply\nformat {'ascii' if encoding == 'ascii' else 'binary_little_endian'} 1.0\n"
        "comment TextureFile skin.png\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar label\nelement face 2\nproperty list uchar int vertex_indices\n"
        "property list uchar float texcoord\nend_header\n"
    )
    faces = [([0, 1, 2], [0.1, 0.1, 0.2, 0.1, 0.2, 0.3]), ([0, 2, 3], [0.9, 0.1, 0.8, 0.3, 0.9, 0.9])]
    body = b""
    for number, vertex in enumerate(SQUARE):
        body += (
            f"{vertex[0]} {vertex[1]} {vertex[2]} {number}\n".encode()
            if encoding == "ascii"
            else struct.pack("<3fB", *vertex, number)
        )
    for at, uv in faces:
        body += (
            f"3 {at[0]} {at[1]} {at[2]} 6 {' '.join(map(str, uv))}\n".encode()
            if encoding == "ascii"
            else struct.pack("<B3iB6f", 3, *at, 6, *uv)
        )
    (tmp_path / "one.ply").write_bytes(head.encode() + body)
    found = read_mesh_file(tmp_path / "one.ply")
    np.testing.assert_array_equal(found.vertices, SQUARE)
    np.testing.assert_array_equal(found.faces, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(found.label, [0, 1, 2, 3])
    assert found.colours[[1, 3]].tolist() == [RED, BLUE]
    (tmp_path / "skin.png").unlink()
    assert read_mesh_file(tmp_path / "one.ply").colours is None


def test_a_glb_of_several_meshes_keeps_their_order(tmp_path):
    """Meshes by nodes, children behind their parent, primitives as listed."""
    shift = [np.float32([[k, 0, 0], [k + 0.5, 0, 0], [k, 0.5, 0]]) for k in range(5)]
    meshes = [[(shift[0], None)], [(shift[1], None), (shift[2], None)], [(shift[3], None)], [(shift[4], None)]]
    nodes = [{"mesh": 0}, {"mesh": 1, "children": [2, 3]}, {"mesh": 2}, {"mesh": 3, "translation": [0, 0, 1]}]
    _glb(tmp_path / "one.glb", meshes, nodes, [0, 1])
    found = read_mesh_file(tmp_path / "one.glb")
    shift[4][:, 2] += 1
    np.testing.assert_array_equal(found.vertices, np.concatenate(shift))


@pytest.mark.parametrize("channels", [3, 4])
def test_colours_of_16_bits_are_those_of_8(tmp_path, channels):
    wanted = np.array([[255, 0, 0], [0, 128, 0], [10, 20, 64]], np.uint8)
    colours = np.full((3, channels), 65535, np.uint16)
    colours[:, :3] = 256 * wanted.astype(np.uint16) + 77
    _glb(tmp_path / "one.glb", [[(SQUARE[:3], colours)]], [{"mesh": 0}], [0])
    assert read_mesh_file(tmp_path / "one.glb").colours.tolist() == wanted.tolist()
    kinds = [f"property ushort {name}" for name in ("red", "green", "blue")]
    lines = [f"{x} {y} {z} {r} {g} {b}" for (x, y, z), (r, g, b) in zip(SQUARE[:3], colours[:, :3], strict=True)]
    head = ["ply", "format ascii 1.0", "element vertex 3", *(f"property float {axis}" for axis in "xyz"), *kinds]
    head += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    (tmp_path / "one.ply").write_text("\n".join([*head, *lines, "3 0 1 2"]) + "\n")
    assert read_mesh_file(tmp_path / "one.ply").colours.tolist() == wanted.tolist()


def test_indices_of_an_obj_count_back_from_their_own_line(tmp_path):
    """Blocks of a mesh whose faces count back, one with a comment, one over two lines, as exporters write them."""
    block = "v {0} 0 0\nv {0} 1 0\nv {0} 1 1\nvn 0 0 1\n"
    faces = ("f -3 -2 -1 # a face", "f -3//-1 -2//-1 \\\n -1//-1")
    (tmp_path / "one.obj").write_text("".join(block.format(k) + face + "\n" for k, face in enumerate(faces)))
    found = read_mesh_file(tmp_path / "one.obj")
    np.testing.assert_array_equal(found.faces, [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(found.vertices[:, 0], [0, 0, 0, 1, 1, 1])


def test_colours_of_vertices_stay_beside_a_material_without_a_picture(tmp_path):
    """As MeshLab writes them, and where the material is another one, or there is none."""
    (tmp_path / "one.obj.mtl").write_text("newmtl material_0\nKd 1 1 1\n")
    rows = ["0 0 0 1 0 0", "1 0 0 0 1 0", "1 1 0 0 0 1", "0 1 0 1 1 1"]
    square = "\n".join(f"v {row}" for row in rows) + "\nvt 0 0\n"
    for head in ("mtllib ./one.obj.mtl\nusemtl material_0\n", "mtllib ./one.obj.mtl\nusemtl other\n", ""):
        (tmp_path / "one.obj").write_text(head + square + "f 1/1 2/1 3/1\nf 1/1 3/1 4/1\n")
        assert read_mesh_file(tmp_path / "one.obj").colours.tolist() == [RED, GREEN, BLUE, WHITE]
    plain = "\n".join(f"v {row[:5]}" for row in rows) + "\nvt 0 0\nf 1/1 2/1 3/1\n"
    for head in ("mtllib one.obj.mtl\nusemtl other\n", ""):  # readers make a grey of their own then
        (tmp_path / "one.obj").write_text(head + plain)
        assert read_mesh_file(tmp_path / "one.obj").colours is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("v 0 0 0\nv 1 0 0\nv 1", r"line 3: a vertex must have three coordinates, got 'v 1'; was the file cut short"),
        ("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2", r"line 4: a face must have three corners"),
        ("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 4\n", r"refers to vertex 4, but there are 3"),
        ("v 0 0 0\nv 1 0 -nan(ind)\nv 1 1 0\nf 1 2 3\n", r"cannot be read as a mesh"),
    ],
)
def test_damaged_objs_say_where(text, words, tmp_path):
    (tmp_path / "one.obj").write_text(text)
    with pytest.raises(CaphyError, match=words):
        read_mesh_file(tmp_path / "one.obj")


def test_a_glb_whose_faces_have_no_vertices_is_refused(tmp_path):
    data = trimesh.Trimesh(SQUARE, [[0, 1, 2], [0, 2, 3]], process=False).export(file_type="glb")
    size = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + size])
    indices = tree["bufferViews"][tree["accessors"][tree["meshes"][0]["primitives"][0]["indices"]]["bufferView"]]
    damaged = bytearray(data)
    damaged[28 + size + indices.get("byteOffset", 0)] = 9
    (tmp_path / "one.glb").write_bytes(damaged)
    with pytest.raises(CaphyError, match=r"one\.glb: cannot be read as a mesh"):
        read_mesh_file(tmp_path / "one.glb")


def _textured(path, places, faces):
    """An OBJ whose picture is a row of 4 by 40 colours; a corner is (vertex, place in the picture)."""
    row = np.repeat(np.uint8([RED, GREEN, BLUE, WHITE]), 10, axis=0)
    cv2.imwrite(str(path.parent / "row.png"), np.ascontiguousarray(np.tile(row[None, :, ::-1], (4, 1, 1))))
    (path.parent / "one.mtl").write_text("newmtl skin\nmap_Kd row.png\n")
    lines = [f"v {x} {y} {z}" for x, y, z in places] + [f"vt {(0.5 + k) / 40} 0.5" for k in range(40)]
    lines += ["f " + " ".join(f"{v + 1}/{t + 1}" for v, t in face) for face in faces]
    path.write_text("\n".join(["mtllib one.mtl", "usemtl skin", *lines]) + "\n")
    return read_mesh_file(path)


def test_vertices_on_seams_of_an_obj_have_colours_of_their_own(tmp_path):
    """An atlas of six charts: a vertex has one place in the picture in each chart that it is in, all of its colour."""
    random, side = np.random.default_rng(0), 8
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    places = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    a = (side * np.arange(side - 1)[:, None] + np.arange(side - 1)).ravel()
    faces = np.concatenate([np.column_stack([a, a + 1, a + side]), np.column_stack([a + 1, a + side + 1, a + side])])
    charts = random.integers(6, size=(len(faces), 1))
    pairs, place = np.unique(charts * side**2 + faces, return_inverse=True)
    colours = random.integers(0, 256, (side**2, 3), dtype=np.uint8)
    picture = colours[pairs % side**2][None, :, ::-1]
    cv2.imwrite(str(tmp_path / "row.png"), np.ascontiguousarray(np.tile(picture, (4, 1, 1))))
    (tmp_path / "one.mtl").write_text("newmtl skin\nmap_Kd row.png\n")
    lines = [f"v {x} {y} {z}" for x, y, z in places]
    lines += [f"vt {(0.5 + k) / len(pairs)} 0.5" for k in range(len(pairs))]
    corners = np.stack([faces, place.reshape(faces.shape)], axis=-1) + 1
    lines += ["f " + " ".join(f"{v}/{t}" for v, t in face) for face in corners]
    (tmp_path / "one.obj").write_text("\n".join(["mtllib one.mtl", "usemtl skin", *lines]) + "\n")
    np.testing.assert_array_equal(read_mesh_file(tmp_path / "one.obj").colours, colours)


def test_vertices_of_an_obj_in_no_face_take_no_colours_from_the_others(tmp_path):
    places = np.insert(SQUARE, 2, [5, 5, 5], axis=0)
    found = _textured(tmp_path / "one.obj", places, [[(0, 0), (1, 12), (3, 25)], [(0, 3), (3, 25), (4, 35)]])
    assert found.colours[[0, 1, 3, 4]].tolist() == [RED, GREEN, BLUE, WHITE]
    np.testing.assert_array_equal(found.vertices, places)


def test_places_that_an_obj_lists_twice_have_their_colour_twice(tmp_path):
    """Black, they were learnt from as if they had been seen."""
    places = SQUARE[[0, 1, 2, 0, 2, 3]]
    found = _textured(tmp_path / "one.obj", places, [[(0, 0), (1, 12), (2, 25)], [(3, 3), (4, 25), (5, 35)]])
    assert found.colours.tolist() == [RED, GREEN, BLUE, RED, BLUE, WHITE]


def test_an_obj_without_the_place_in_the_texture_is_told(tmp_path):
    with pytest.raises(CaphyError, match="refers to place 77 in the texture, but there are 40"):
        _textured(tmp_path / "one.obj", SQUARE, [[(0, 0), (1, 12), (2, 76)]])

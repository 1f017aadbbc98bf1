"""Files of meshes: dialects, encodings, materials, images and extensions, and damage to each format."""

import base64
import json
import os
import random
import re
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from object_files import surface
from PIL import Image

from sts_jax import objects
from sts_jax.objects.files import read_image

SIZE = (0.06, 0.04, 0.02)
BOX = trimesh.creation.box(SIZE)
CORNERS = BOX.vertices[BOX.faces].reshape(-1, 3)
UV = np.stack([0.1 + 0.8 * (CORNERS[:, 0] > 0), 0.1 + 0.8 * (CORNERS[:, 2] < 0)], axis=1)  # v points down
RED, BLUE = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])


def picture(path: Path, mode: str = "RGB") -> Path:
    """An image whose upper half is red and whose lower half is blue."""
    pixels = np.zeros((16, 16, 3), np.uint8)
    pixels[:8, :, 0], pixels[8:, :, 2] = 255, 255
    Image.fromarray(pixels).convert(mode).save(path)
    return path


def seen(body: objects.Body) -> tuple[np.ndarray, np.ndarray]:
    """Albedo at the corners of all faces, nearest texel, and the corners."""
    number = len(surface(body).faces)
    texture = np.asarray(body.texture)
    place = np.asarray(body.uv)[:number] % 1 * len(texture)
    column, row = np.moveaxis(place.astype(int), -1, 0)
    return texture[row, column] * np.asarray(body.colors)[:number], surface(body).triangles


def is_red_above_blue(body: objects.Body) -> bool:
    color, corners = seen(body)
    return np.allclose(color, np.where(corners[..., 2:] > 0, RED, BLUE), atol=1e-3)


def obj(*, head: str = "mtllib box.mtl\nusemtl skin", scale: float = 1.0, offset: float = 0.0) -> str:
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS]
    lines += [f"vt {u * scale + offset} {1 - v}" for u, v in UV]
    return "\n".join([head, *lines, *(f"f {i}/{i} {i + 1}/{i + 1} {i + 2}/{i + 2}" for i in range(1, 37, 3))]) + "\n"


def library(path: Path, line: str = "map_Kd half.png") -> None:
    picture(path.with_name("half.png"))
    path.write_text(f"newmtl skin\nKd 1 1 1\n{line}\n")


def gltf(folder: Path, name: str = "box.gltf", *, image: dict | None = None, uv: np.ndarray = UV, **change) -> Path:
    """A box with an image as glTF. `change` has further parts of the header, and replaces equal ones."""
    data = [CORNERS.astype("<f4").tobytes(), uv.astype("<f4").tobytes(), np.zeros((36, 2), "<f4").tobytes()]
    starts = np.cumsum([0, *map(len, data)])
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": "half.png"} if image is None else image],
        "buffers": [
            {"uri": f"data:;base64,{base64.b64encode(b''.join(data)).decode()}", "byteLength": int(starts[-1])}
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(start), "byteLength": len(part)}
            for start, part in zip(starts, data, strict=False)
        ],
        "accessors": [
            {"bufferView": view, "componentType": 5126, "count": 36, "type": kind}
            for view, kind in enumerate(("VEC3", "VEC2", "VEC2"))
        ],
    }
    header |= change
    (folder / name).write_text(json.dumps(header))
    return folder / name


def material(**texture) -> list[dict]:
    return [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0} | texture}}]


@pytest.mark.parametrize(
    ("extension", "reason"),
    [
        ("KHR_draco_mesh_compression", None),
        ("EXT_meshopt_compression", None),
        ("KHR_mesh_quantization", None),
        ("KHR_texture_basisu", None),
        ("VENDOR_new_thing", None),
    ],
)
def test_a_required_extension_is_named_and_one_with_a_fallback_is_warned_of(tmp_path, extension, reason):
    picture(tmp_path / "half.png")
    path = gltf(tmp_path, extensionsRequired=[extension], extensionsUsed=[extension])
    with pytest.raises(ValueError, match=rf"box\.gltf: the file requires the glTF extension {extension}"):
        objects.load(path)
    path = gltf(tmp_path, extensionsUsed=[extension])
    if extension.startswith("VENDOR"):
        assert is_red_above_blue(objects.load(path, strict=True))
        return
    with pytest.warns(UserWarning, match=extension):
        assert is_red_above_blue(objects.load(path))
    with pytest.raises(ValueError, match=extension):
        objects.load(path, strict=True)


def test_data_that_only_an_extension_could_decode_are_refused(tmp_path):
    picture(tmp_path / "half.png")
    empty = [{"componentType": 5126, "count": 36, "type": kind} for kind in ("VEC3", "VEC2", "VEC2")]
    with pytest.raises(ValueError, match=r"box\.gltf: .*compressed data"):
        objects.load(gltf(tmp_path, accessors=empty))
    whole = [{"bufferView": 0, "componentType": 5123, "count": 36, "type": "VEC3"}] * 2
    with pytest.raises(ValueError, match="POSITION has whole numbers"):
        objects.load(gltf(tmp_path, accessors=whole))
    path = gltf(tmp_path, textures=[{"extensions": {"KHR_texture_basisu": {"source": 0}}}])
    with pytest.warns(UserWarning, match="KHR_texture_basisu"):
        objects.load(path)


def test_uris_of_gltf_are_decoded_and_a_missing_image_is_reported(tmp_path):
    picture(tmp_path / "half & ü (1).png")
    for uri in ("half%20%26%20%C3%BC%20(1).png", "half & ü (1).png"):
        assert is_red_above_blue(objects.load(gltf(tmp_path, image={"uri": uri}), strict=True))
    content = base64.b64encode(picture(tmp_path / "half.png").read_bytes()).decode()
    assert is_red_above_blue(objects.load(gltf(tmp_path, image={"uri": f"data:image/png;base64,{content}"})))
    path = gltf(tmp_path, image={"uri": "gone.png"})
    with pytest.warns(UserWarning, match=r"box\.gltf: the mesh refers to missing files: .*gone\.png") as caught:
        objects.load(path)
    assert len(caught) == 1
    with pytest.raises(FileNotFoundError, match=r"gone\.png"):
        objects.load(path, strict=True)
    assert is_red_above_blue(objects.load(path, strict=True, texture=tmp_path / "half.png"))
    (tmp_path / "half.png").write_bytes(b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(80))
    with pytest.raises(ValueError, match=r"box\.gltf.* image 0: the file cannot be read as an image"):
        objects.load(gltf(tmp_path))
    path = gltf(tmp_path, buffers=[{"uri": "gone.bin", "byteLength": 1}])
    with pytest.raises(FileNotFoundError, match=r"gone\.bin"):
        objects.load(path)


def test_other_coordinates_and_transforms_of_textures_are_applied(tmp_path):
    picture(tmp_path / "half.png")
    attributes = {"POSITION": 0, "TEXCOORD_0": 2, "TEXCOORD_1": 1}  # TEXCOORD_0 is zero everywhere
    meshes = [{"primitives": [{"attributes": attributes, "material": 0}]}]
    assert is_red_above_blue(objects.load(gltf(tmp_path, meshes=meshes, materials=material(texCoord=1)), strict=True))

    # The extension's equation: uv' = offset + R(angle) (scale uv), where R turns u towards -v.
    angle, scale, offset = 0.4, np.array([0.5, 2.0]), np.array([0.3, -0.1])
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    before = ((UV - offset) @ turn) / scale
    change = {"offset": offset.tolist(), "rotation": angle, "scale": scale.tolist()}
    body = objects.load(
        gltf(
            tmp_path,
            uv=before,
            materials=material(extensions={"KHR_texture_transform": change}),
            extensionsRequired=["KHR_texture_transform"],
        ),
        strict=True,
    )
    assert is_red_above_blue(body)


@pytest.mark.parametrize(
    ("head", "lines"),
    [
        ("mtllib box.mtl", "map_Kd half.png"),
        ("mtllib box.mtl\nusemtl other", "map_Kd half.png"),
        ("mtllib box.mtl\nusemtl skin", "map_Kd -mm 0.1 0.5 half.png"),
    ],
)
def test_a_material_without_effect_is_reported(tmp_path, head, lines):
    (tmp_path / "box.obj").write_text(obj(head=head))
    library(tmp_path / "box.mtl", lines)
    with pytest.warns(UserWarning, match=r"box\.obj: .*(usemtl|other|-mm)") as caught:
        objects.load(tmp_path / "box.obj")
    assert len(caught) == 1
    with pytest.raises(ValueError, match=r"box\.obj: .*(usemtl|other|-mm)"):
        objects.load(tmp_path / "box.obj", strict=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (tmp_path / "box.obj").write_text(obj(head="usemtl nothing"))  # no library, so nothing is lost
        objects.load(tmp_path / "box.obj", strict=True)


@pytest.mark.parametrize(
    ("line", "scale", "offset"),
    [
        ("map_Kd -s 1 1 1 half.png", 1, 0),
        ("map_Kd -s 4 half.png", 0.25, 0),
        ("map_kd -o 0.25 -clamp on -bm 2 half.png", 1, -0.25),
        ("\tmap_Kd\thalf.png  ", 1, 0),
        ("map_Kd .\\half.png", 1, 0),
        ("map_Kd C:\\Users\\me\\textures\\half.png", 1, 0),
        ('map_Kd "half.png"', 1, 0),
        ("map_Kd \\\nhalf.png", 1, 0),
        ("map_Kd a half.png", 1, 0),
    ],
)
def test_options_and_names_of_images(tmp_path, line, scale, offset):
    (tmp_path / "box.obj").write_text(obj(scale=scale, offset=offset))
    library(tmp_path / "box.mtl", line)
    picture(tmp_path / "a half.png")
    body = objects.load(tmp_path / "box.obj", strict=True)
    assert is_red_above_blue(body)
    color, corners = seen(body)
    assert np.allclose(np.asarray(body.uv)[: len(color), :, 0] % 1, 0.1 + 0.8 * (corners[..., 0] > 0), atol=1e-5)


@pytest.mark.parametrize("names", ["plain.mtl my box.mtl", "my box.mtl", "my box.mtl plain.mtl", "sub\\my box.mtl"])
def test_several_libraries_with_spaces_in_their_names(tmp_path, names):
    (tmp_path / "box.obj").write_text(obj(head=f"mtllib {names}\nusemtl skin"))
    library(tmp_path / "my box.mtl")
    (tmp_path / "plain.mtl").write_text("newmtl plain\nKd 1 0 0\n")
    assert is_red_above_blue(objects.load(tmp_path / "box.obj", strict=True))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "gbk"])
def test_texts_in_any_encoding_with_any_line_ends(tmp_path, encoding):
    name = "größe" if encoding == "latin-1" else "诚" if encoding == "gbk" else "größe 诚"
    picture(tmp_path / f"{name}.png")
    (tmp_path / "box.mtl").write_bytes(f"# {name}\nnewmtl {name}\nmap_Kd {name}.png\n".encode(encoding))
    text = obj(head=f"# {name} \\\nmtllib box.mtl\no {name}\\\nusemtl {name}").replace("f 1/1 ", "f 1/1 \\\n\t")
    for end in ("\n", "\r\n", "\r"):
        (tmp_path / "box.obj").write_bytes(text.replace("\n", end).encode(encoding))
        assert is_red_above_blue(objects.load(tmp_path / "box.obj", strict=True))
    (tmp_path / "box.obj").write_bytes(text.encode("utf-16"))
    with pytest.raises(ValueError, match=r"box\.obj: .*UTF-16"):
        objects.load(tmp_path / "box.obj")


def test_relative_indices_comments_and_lines_of_other_kinds(tmp_path):
    """Indices count back from the line of the face, not from the end of the file."""
    lines = []
    for triangle in BOX.vertices[BOX.faces]:
        lines += ["\t" + "v  {} {} {} 1.0".format(*point) for point in triangle] + ["s off", "f -3 -2 -1 # a face"]
    (tmp_path / "box.obj").write_text("\n".join(lines))
    body = objects.load(tmp_path / "box.obj", strict=True)
    assert surface(body).volume == pytest.approx(np.prod(SIZE), rel=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("v ", "v 1 2\nv "), "a vertex has fewer than 3 numbers"),
        (("f 1/1", "f 0/1"), "index 0"),
        (("f 1/1", "f -99/1"), "index -99"),
        (("f 1/1", "f 99/1"), "refers to vertex 99"),
        (("f 1/1", "f 1/99"), "texture coordinate 99"),
        (("f 1/1 2/2", "f 1/1 x"), "cannot be read as a mesh"),
        (("f 1/1 2/2 3/3", "f 1/1 2/2"), "fewer than three corners"),
        (("vt 0.1", "vt nan"), "texture coordinates that are NaN"),
        (("vt 0.1", "vt 1e30"), "texture coordinates that are NaN or beyond"),
        (("f 1/1 2/2", "f " + "1/1 9/9 5/5 " * 1000 + "2/2"), "a concave face has 3,002 corners"),
    ],
)
def test_faults_of_an_obj_are_named(tmp_path, change, message):
    (tmp_path / "box.obj").write_text(obj().replace(*change, 1))
    library(tmp_path / "box.mtl")
    with pytest.raises(ValueError, match=rf"box\.obj: .*{message}"):
        objects.load(tmp_path / "box.obj")


def stl_text() -> str:
    facets = (
        "facet normal 0 0 0\n outer loop\n"
        + "".join("  vertex {} {} {}\n".format(*p) for p in t)
        + " endloop\nendfacet\n"
        for t in BOX.vertices[BOX.faces]
    )
    return "solid vertex facet\n" + "".join(facets) + "endsolid vertex facet\n"


def stl_bytes(head: bytes = b"", tail: bytes = b"") -> bytes:
    body = BOX.export(file_type="stl")
    return head.ljust(80)[:80] + body[80:] + tail


@pytest.mark.parametrize(
    "content",
    [
        stl_text().encode(),
        stl_text().upper().encode(),
        b"\xef\xbb\xbf" + stl_text().encode(),
        ("\n  " + stl_text()).replace("\n", "\r\n").encode(),
        stl_text().replace("\n", "\r").encode(),
        stl_text().replace("vertex facet", "Körper").encode("latin-1"),
        (stl_text() + "\n\n" * 600).encode(),
        (stl_text()[: len(stl_text()) // 2].rpartition("facet normal")[0] + "endsolid\n" + "solid b\n").encode()
        + ("facet normal" + stl_text()[: len(stl_text()) // 2].rpartition("facet normal")[2]).encode()
        + stl_text()[len(stl_text()) // 2 :].encode(),
        stl_bytes(b"solid facet of a CAD program, endsolid"),
        stl_bytes(b"solid facet", b"\0" * 37),
        stl_bytes(b"binary", b"trailing"),
    ],
)
def test_dialects_of_stl(tmp_path, content):
    (tmp_path / "box.stl").write_bytes(content)
    body = objects.load(tmp_path / "box.stl", strict=True)
    assert len(surface(body).faces) == 12
    assert surface(body).volume == pytest.approx(np.prod(SIZE), rel=1e-5)


@pytest.mark.parametrize("content", [stl_bytes(b"solid facet")[:-60], stl_text().upper().encode()[:-300], b"solid x"])
def test_a_truncated_stl_of_any_dialect(tmp_path, content):
    (tmp_path / "box.stl").write_bytes(content)
    with pytest.raises(ValueError, match=r"box\.stl: the file is (truncated|damaged)"):
        objects.load(tmp_path / "box.stl")


def test_colours_of_a_ply_by_other_names_and_its_texture(tmp_path):
    rows = ["{} {} {} 255 0 0".format(*p) for p in BOX.vertices] + ["3 {} {} {}".format(*f) for f in BOX.faces]
    head = ["ply", "format ascii 1.0", "comment größe", "element vertex 8", *(f"property float {c}" for c in "xyz")]
    end = ["element face 12", "property list uchar int vertex_indices", "end_header"]
    colors = [f"property uchar diffuse_{c}" for c in ("red", "green", "blue")]
    (tmp_path / "box.ply").write_bytes("\r\n".join([*head, *colors, *end, *rows]).encode("latin-1"))
    assert np.allclose(seen(objects.load(tmp_path / "box.ply"))[0], RED)
    head[2:4] = ["comment TextureFile my half.png", "element vertex 36"]
    rows = [f"{x} {y} {z} {u} {1 - v}" for (x, y, z), (u, v) in zip(CORNERS, UV, strict=True)]
    rows += [f"3 {i} {i + 1} {i + 2}" for i in range(0, 36, 3)]
    (tmp_path / "box.ply").write_text("\n".join([*head, "property float s", "property float t", *end, *rows]))
    with pytest.warns(UserWarning, match=r"my half\.png"):
        objects.load(tmp_path / "box.ply")
    picture(tmp_path / "my half.png")
    assert is_red_above_blue(objects.load(tmp_path / "box.ply", strict=True))


@pytest.mark.parametrize("kind", ["ushort", "int", "uint16"])
def test_integer_colours_of_a_ply_that_are_no_bytes_are_refused(tmp_path, kind):
    rows = ["{} {} {} 65535 32768 0".format(*p) for p in BOX.vertices] + ["3 {} {} {}".format(*f) for f in BOX.faces]
    head = ["ply", "format ascii 1.0", "element vertex 8", *(f"property float {c}" for c in "xyz")]
    head += [f"property {kind} {c}" for c in ("red", "green", "blue")]
    end = ["element face 12", "property list uchar int vertex_indices", "end_header"]
    (tmp_path / "box.ply").write_text("\n".join([*head, *end, *rows]))
    with pytest.raises(ValueError, match=f"colours of the type {kind}: export colours of 8 bits"):
        objects.load(tmp_path / "box.ply")


def png16(path: Path, values: np.ndarray, kind: int) -> None:
    """Write 16-bit values, which Pillow writes only for grey images: grey 0, RGB 2, grey and alpha 4, RGBA 6."""
    height, width = values.shape[:2]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values.reshape(height, -1))
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0)), (b"IDAT", zlib.compress(rows))]
    content = b"\x89PNG\r\n\x1a\n"
    for name, data in [*chunks, (b"IEND", b"")]:
        content += struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
    path.write_bytes(content)


RAMP = np.tile(np.linspace(0, 1, 32), (8, 1))


@pytest.mark.parametrize(("kind", "channels"), [(0, 1), (2, 3), (4, 2), (6, 4)])
def test_images_of_16_bits_are_scaled(tmp_path, kind, channels):
    color = np.stack([RAMP, 1 - RAMP, 0.5 * RAMP], axis=-1) if channels > 2 else np.repeat(RAMP[..., None], 3, axis=-1)
    stored = np.concatenate([color[..., :1] if channels < 3 else color, RAMP[..., None]], axis=-1)[..., :channels]
    png16(tmp_path / "ramp.png", np.rint(65535 * stored), kind)
    assert np.abs(np.asarray(read_image(tmp_path / "ramp.png")) - 255 * color).max() <= 1


@pytest.mark.parametrize(
    ("name", "mode"), [("x.tif", "I;16"), ("x.tif", "I;16B"), ("x.ppm", "I;16"), ("x.tif", "I"), ("x.tif", "F")]
)
def test_grey_images_of_other_modes_are_scaled(tmp_path, name, mode):
    values = np.rint(65535 * RAMP)
    kind = {"I;16": "<u2", "I;16B": ">u2", "I": "<i4", "F": "<f4"}[mode]
    Image.frombytes(mode, (32, 8), (RAMP if mode == "F" else values).astype(kind).tobytes()).save(tmp_path / name)
    assert np.abs(np.asarray(read_image(tmp_path / name)) - 255 * RAMP[..., None]).max() <= 1
    Image.fromarray((1e6 * RAMP).astype(np.float32)).save(tmp_path / "x.tif")
    with pytest.raises(ValueError, match=r"x\.tif: .*values are from 0 to 1e\+06"):
        read_image(tmp_path / "x.tif")


@pytest.mark.parametrize(
    ("name", "mode"), [("a.png", "P"), ("a.png", "RGBA"), ("a.gif", "P"), ("a.tif", "CMYK"), ("a.webp", "RGB")]
)
def test_images_with_palettes_and_other_channels(tmp_path, name, mode):
    pixels = np.asarray(read_image(picture(tmp_path / name, mode)))
    assert np.abs(pixels[2, 2] - 255 * RED).max() < 8
    assert np.abs(pixels[-2, 2] - 255 * BLUE).max() < 8


def test_large_images_are_reduced_and_too_large_ones_refused(tmp_path, monkeypatch):
    for name in ("wide.png", "wide.jpg"):
        Image.new("RGB", (8200, 40), (200, 10, 10)).save(tmp_path / name)
        small = read_image(tmp_path / name)
        assert small.width <= 4096
        assert np.abs(np.asarray(small, int) - [200, 10, 10]).max() < 4
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100_000)
    with pytest.raises(ValueError, match=r"wide\.png: the image has more than 200,000 pixels"):
        read_image(tmp_path / "wide.png")


def test_only_regular_files_are_opened(tmp_path):
    (tmp_path / "box.obj").write_text(obj())
    os.mkfifo(tmp_path / "box.mtl")
    with pytest.warns(UserWarning, match=r"missing files: .*box\.mtl"):
        objects.load(tmp_path / "box.obj")
    os.mkfifo(tmp_path / "half.png")
    (tmp_path / "box.mtl").unlink()
    (tmp_path / "box.mtl").write_text("newmtl skin\nmap_Kd half.png")
    with pytest.warns(UserWarning, match=r"missing files: .*half\.png"):
        objects.load(tmp_path / "box.obj")
    with pytest.warns(UserWarning, match=r"missing files: .*half\.png"):
        objects.load(gltf(tmp_path))
    with pytest.raises(FileNotFoundError):
        objects.load(tmp_path / "box.obj", texture=tmp_path / "half.png")


def test_a_deeply_nested_header_is_named(tmp_path):
    (tmp_path / "deep.gltf").write_text("[" * 100_000)
    with pytest.raises(ValueError, match=r"deep\.gltf: the file cannot be read as a mesh"):
        objects.load(tmp_path / "deep.gltf")
    assert objects.survey(objects.library(picture_folder(tmp_path)))[0].skipped[0][0] == "deep.gltf"


def picture_folder(folder: Path) -> Path:
    picture(folder / "half.png")
    gltf(folder)
    return folder


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Damage a file: flip a bit, replace a number, delete or swap lines, truncate it, or insert bytes."""
    part, lines = bytearray(data), data.split(b"\n")
    numbers = list(re.finditer(rb"-?\d+\.?\d*", data))
    place = rng.randrange(len(data))
    how = rng.choice(["flip", "number", "number", "line", "swap", "truncate", "insert"])
    if how == "number" and numbers:
        number = rng.choice(numbers)
        part[number.start() : number.end()] = rng.choice([b"nan", b"-inf", b"1e30", b"-7", b"0", b"9" * 20, b"", b"[]"])
    elif how in ("line", "swap"):
        line = lines.pop(rng.randrange(len(lines)))
        lines.insert(place % (len(lines) + 1), line if how == "swap" else b"")
        part = bytearray(b"\n".join(lines))
    elif how == "truncate":
        part = part[:place]
    elif how == "insert":
        part[place:place] = rng.randbytes(8)
    else:
        part[place] ^= 1 << rng.randrange(8)
    return bytes(part)


@pytest.mark.parametrize(
    "name", ["box.obj", "box.mtl", "text.stl", "box.stl", "box.ply", "box.off", "box.gltf", "box.glb"]
)
def test_a_mutated_file_is_read_or_named(tmp_path, name):
    library(tmp_path / "box.mtl")
    (tmp_path / "box.obj").write_text(obj())
    (tmp_path / "text.stl").write_text(stl_text())
    gltf(tmp_path)
    for suffix in ("stl", "ply", "off", "glb"):
        BOX.export(tmp_path / f"box.{suffix}")
    data, rng = (tmp_path / name).read_bytes(), random.Random(name)
    path, named = tmp_path / name.replace(".mtl", ".obj"), []
    for _ in range(15):
        (tmp_path / name).write_bytes(mutated(data, rng))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                objects.load(path).check()
            except (ValueError, OSError) as error:
                named.append(path.name in str(error))
        named += [path.name in str(warning.message) for warning in caught]
    assert all(named)


PAINT = np.where(CORNERS[:, 2:] > 0, RED, BLUE)  # red above blue


@pytest.mark.parametrize("kind", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("materials", [None, [{}], [{"pbrMetallicRoughness": {"baseColorFactor": [1, 0.5, 1, 1]}}]])
def test_colours_of_vertices_of_gltf_are_read_with_and_without_a_material(tmp_path, kind, materials):
    whole = 1 if kind == "float32" else np.iinfo(kind).max
    colors = np.concatenate([PAINT, np.ones((36, 1))], axis=1) * [0.25, 1, 0.5, 1] * whole
    data = [
        CORNERS.astype("<f4").tobytes(),
        np.round(colors).astype(kind).tobytes() if whole > 1 else colors.astype("<f4").tobytes(),
    ]
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}} | ({} if materials is None else {"material": 0})
    types = {"uint8": 5121, "uint16": 5123, "float32": 5126}
    path = gltf(
        tmp_path,
        meshes=[{"primitives": [primitive]}],
        materials=materials or [],
        textures=[],
        images=[],
        buffers=[
            {"uri": f"data:;base64,{base64.b64encode(b''.join(data)).decode()}", "byteLength": sum(map(len, data))}
        ],
        bufferViews=[
            {"buffer": 0, "byteOffset": 0, "byteLength": len(data[0])},
            {"buffer": 0, "byteOffset": len(data[0]), "byteLength": len(data[1])},
        ],
        accessors=[
            {"bufferView": 0, "componentType": 5126, "count": 36, "type": "VEC3"},
            {"bufferView": 1, "componentType": types[kind], "normalized": whole > 1, "count": 36, "type": "VEC4"},
        ],
    )
    color, corners = seen(objects.load(path, strict=True))
    factor = [1, 0.5, 1] if materials and materials[0] else [1, 1, 1]
    expected = np.where(corners[..., 2:] > 0, RED, BLUE) * [0.25, 1, 0.5] * factor  # linear, as in the file
    np.testing.assert_allclose(color, expected, atol=0.003)


def test_colours_of_vertices_count_beside_texture_coordinates_without_an_image(tmp_path):
    rows = [f"v {x} {y} {z} {r} {g} {b}" for (x, y, z), (r, g, b) in zip(CORNERS, PAINT, strict=True)]
    (tmp_path / "box.mtl").write_text("newmtl skin\nKd 0.1 0.1 0.1\n")
    (tmp_path / "box.obj").write_text("\n".join(obj().splitlines()[:2] + rows + obj().splitlines()[38:]))
    assert is_red_above_blue(objects.load(tmp_path / "box.obj", strict=True))
    head = "ply\nformat ascii 1.0\nelement vertex 36\n" + "".join(f"property float {name}\n" for name in "xyzst")
    head += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    head += "element face 12\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(map(str, [*p, *uv, *(255 * c).astype(int)])) for p, uv, c in zip(CORNERS, UV, PAINT, strict=True)]
    rows += [f"3 {i} {i + 1} {i + 2}" for i in range(0, 36, 3)]
    (tmp_path / "box.ply").write_text(head + "\n".join(rows) + "\n")
    assert is_red_above_blue(objects.load(tmp_path / "box.ply", strict=True))


def test_points_without_faces_are_named(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "points.ply").write_text(head + "end_header\n0 0 0\n")
    with pytest.raises(ValueError, match=r"points\.ply: .*it has points, but no list of faces"):
        objects.load(tmp_path / "points.ply")

"""Readers of the mesh formats. They know what a file may contain, and say what they cannot read."""

import base64
import io
import json
import re
import struct
import urllib.parse
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from sts_jax.objects.colors import PLAIN
from sts_jax.objects.files import Files, Refusal, read_image
from sts_jax.objects.polygons import cut, cut_off, cut_ply

# glTF extensions that may be required, besides the materials (KHR_materials_...), which do not change the base colour.
SUPPORTED = ("KHR_texture_transform", "EXT_texture_webp", "KHR_lights_punctual", "KHR_xmp_json_ld")
# Other extensions that change the geometry or the texels. Where such a one is not required, its fallback is read.
UNSUPPORTED = (
    "KHR_draco_mesh_compression",
    "KHR_mesh_quantization",
    "KHR_meshopt_compression",
    "EXT_meshopt_compression",
    "EXT_mesh_gpu_instancing",
    "KHR_texture_basisu",
    "EXT_texture_avif",
    "MSFT_texture_dds",
)
# Options of `map_Kd`, and how many values follow them at most. Options -s and -o are applied.
_OPTIONS = {b"-s": 3, b"-o": 3, b"-t": 3, b"-mm": 2}
_OPTIONS |= dict.fromkeys(b"-blendu -blendv -bm -boost -cc -clamp -imfchan -texres -type".split(), 1)
_WIDE = (b"\xff\xfe", b"\xfe\xff")  # byte-order marks of UTF-16
_TEXTURE = rb"(?im)^comment\s+texturefile\s+(.+?)\s*$"  # in the header of a PLY


class Look(NamedTuple):
    """A material: a colour factor, or an image with a scale and an offset of its texture coordinates."""

    color: np.ndarray | None = None  # (3,), as in the file
    image: bytes | None = None  # name of the image
    scale: tuple[float, ...] = (1.0, 1.0)
    offset: tuple[float, ...] = (0.0, 0.0)


def read(files: Files, strict: bool) -> list[trimesh.Trimesh]:
    """Read the meshes of a file. A missing image or material is a warning, or an error if `strict`."""
    path = files.path
    try:
        kind = path.suffix.lower()
        pieces = _READERS[kind](path.read_bytes(), files) if kind in _READERS else _loaded(path, None, files)
    except (Refusal, FileNotFoundError):
        raise
    except ModuleNotFoundError as error:
        raise ValueError(f"the file cannot be read ({error}): install the package {error.name}") from error
    except Exception as error:  # the many readers raise errors of many types
        text = str(error) if isinstance(error, ValueError) else f"{type(error).__name__} {error}"
        raise ValueError(
            f"the file cannot be read as a mesh ({text}): check that it is complete and has the right suffix"
        ) from error
    files.report(strict)
    return pieces


def references(path: Path, images: Path | None = None) -> dict[str, Path | None]:
    """Map the names of the files to which a mesh file refers to their paths, or to None where a file is missing."""
    files, kind = Files(path, images), path.suffix.lower()
    try:
        data = path.read_bytes()
        if kind == ".obj":
            for look in _libraries(data, files).values():
                if look.image is not None:
                    files.find(look.image)
        elif kind in (".gltf", ".glb"):
            header, _ = _header(data)
            for part in [*header.get("buffers", []), *header.get("images", [])]:
                if not part.get("uri", "data:").startswith("data:"):
                    files.find(urllib.parse.unquote(part["uri"]), part["uri"])
        elif kind == ".ply":
            for name in re.findall(_TEXTURE, data.partition(b"end_header")[0]):
                files.find(name)
    except Exception:  # `load` raises an error for the damaged file
        return {}
    return files.found


def _loaded(content: Path | bytes, kind: str | None, resolver: Any) -> list[trimesh.Trimesh]:
    """Read a file or its content with trimesh."""
    source = io.BytesIO(content) if isinstance(content, bytes) else content
    scene = trimesh.load_scene(source, file_type=kind, process=False, resolver=resolver)
    for mesh in scene.geometry.values():  # the copies of `dump` lose the attributes of a texture
        mesh.vertex_attributes.update(getattr(mesh.visual, "vertex_attributes", {}))
    return [piece for piece in scene.dump() if isinstance(piece, trimesh.Trimesh) and len(piece.faces)]


def _text(data: bytes, name: str = "the file") -> bytes:
    """Return a text without its byte-order mark, or raise an error if it is UTF-16."""
    if b"\0" in data[:1024] or data[:2] in _WIDE:
        raise Refusal(f"{name} is no text of 8-bit characters: save it as UTF-8 if it is UTF-16")
    return data.removeprefix(b"\xef\xbb\xbf")


def _lines(data: bytes, name: str = "the file") -> Iterator[bytes]:
    """Yield the lines of an OBJ or MTL text, without comment lines and with continued lines (backslash) joined.

    The names of groups and objects can end with a byte that looks like a backslash, in GBK for example.
    """
    start = b""
    for line in _text(data, name).splitlines():
        line = start + line.strip()
        start = b""
        if line.endswith(b"\\") and line[:1] not in b"#gos":
            start = line[:-1] + b" "
        elif line and line[:1] != b"#":
            yield line


def _libraries(data: bytes, files: Files) -> dict[bytes, Look]:
    """Read the materials of all libraries of an OBJ text."""
    looks: dict[bytes, Look] = {}
    for line in _lines(data):
        if line[:6].lower() != b"mtllib" or not line[6:].strip():
            continue
        whole = line[6:].strip()
        parts = re.split(rb"(?i)(?<=\.mtl)\s+", whole)  # names can contain spaces
        for name in [whole] if files.place(whole) else parts:
            path = files.find(name)
            if path is not None:
                looks |= _materials(path, files)
    return looks


def _materials(path: Path, files: Files) -> dict[bytes, Look]:
    """Read a material library (MTL)."""
    looks: dict[bytes, Look] = {}
    name = None
    for line in _lines(path.read_bytes(), str(path)):
        word, _, rest = line.replace(b"\t", b" ").partition(b" ")
        word = word.lower()
        if word == b"newmtl":
            name = rest.strip()
            looks[name] = Look()
        elif word == b"kd" and name is not None and rest.split()[:1] not in ([b"spectral"], [b"xyz"]):
            color = np.array(rest.split()[:3] * (3 if len(rest.split()) == 1 else 1), float)
            looks[name] = looks[name]._replace(color=_unit(color, 3, f"{path}: "))
        elif word == b"map_kd" and name is not None:
            looks[name], ignored = _mapped(looks[name], rest.strip())
            if ignored:
                files.problems.append(f"{path}: options of map_Kd are ignored ({ignored})")
    return looks


def _unit(color: np.ndarray, size: int, place: str = "") -> np.ndarray:
    """Return a colour unless its values are not in [0, 1], except for rounding."""
    if color.shape != (size,) or not ((color >= 0) & (color <= 1.01)).all():
        raise Refusal(f"{place}the colour of a material must be {size} numbers in [0, 1], got {color.tolist()}")
    return color


def _mapped(look: Look, rest: bytes) -> tuple[Look, str]:
    """Add the image of a line `map_Kd [-option values] image`. Return also the options that are not applied."""
    values: dict[bytes, list[float]] = {}
    while (option := rest.split()[0].lower() if rest.split() else b"") in _OPTIONS:
        rest = rest.split(None, 1)[1] if len(rest.split()) > 1 else b""
        values[option] = []
        for _ in range(_OPTIONS[option]):
            first, _, after = rest.partition(b" ")
            try:
                values[option].append(float(first))
            except ValueError:
                if _OPTIONS[option] > 1:
                    break
            rest = after.lstrip()
    scale, offset = (
        tuple([*values.pop(option, []), default, default][:2]) for option, default in ((b"-s", 1.0), (b"-o", 0.0))
    )
    ignored = b", ".join(option for option in values if option in (b"-t", b"-mm", b"-imfchan")).decode()
    return look._replace(image=rest or None, scale=scale, offset=offset), ignored


def _obj(data: bytes, files: Files) -> list[trimesh.Trimesh]:
    """Read an OBJ text. Each material becomes a mesh."""
    points: list[list[bytes]] = []
    coordinates: list[list[bytes]] = []
    groups: dict[tuple[bytes | None, bool], list[list[tuple[int, int]]]] = {}
    material = None
    for line in _lines(data):
        word, *rest = line.split(None, 1)
        if word == b"v":
            points.append(rest[0].split() if rest else [])
        elif word == b"vt":
            coordinates.append(rest[0].split() if rest else [])
        elif word == b"usemtl":
            material = rest[0] if rest else None
        elif word == b"f":
            tokens = rest[0].partition(b"#")[0].split() if rest else []
            if len(tokens) < 3:
                raise Refusal(f"a face has fewer than three corners ({_name(line)!r}): repair it")
            corners = [_corner(token, len(points), len(coordinates)) for token in tokens]
            groups.setdefault((material, min(corner[1] for corner in corners) >= 0), []).append(corners)
    if not points or not groups:
        return []
    place = _numbers(points, 3, "vertex")
    texel = _numbers(coordinates, 1, "texture coordinate")
    texel = np.concatenate([texel, np.zeros((len(texel), 1))], axis=1)[:, :2]
    painted = place[:, 3:6] if place.shape[1] >= 6 else None
    if painted is not None:
        if not (painted >= 0).all():
            raise Refusal("the colour of a vertex is NaN or negative: repair the file")
        painted = painted / 255 if painted.max() > 1 else painted
    looks = {} if files.plain else _libraries(data, files)
    pictures: dict[bytes | None, Image.Image | None] = {}
    pieces = []
    for (name, has_texels), polygons in reversed(groups.items()):
        listed = np.array([corner for polygon in polygons for corner in polygon], np.int64)
        number, coordinate = listed.max(axis=0) + 1
        if number > len(place):
            raise Refusal(f"a face refers to vertex {number}, but the file has {len(place)} vertices: is it complete?")
        if has_texels and coordinate > len(texel):
            raise Refusal(f"a face refers to texture coordinate {coordinate} of {len(texel)}: repair it")
        faces = listed[cut(place[listed[:, 0], :3], [len(polygon) for polygon in polygons])]
        faces[..., 1] = np.where(has_texels, faces[..., 1], -1)
        used, index = np.unique(faces[..., 0] * (len(texel) + 1) + faces[..., 1] + 1, return_inverse=True)
        vertex, corner = np.divmod(used, len(texel) + 1)
        look = looks.get(name or b"")
        bare = look or Look()
        uv = texel[corner - 1] * bare.scale + bare.offset if has_texels else None
        visual = None
        if look is not None or has_texels:
            if bare.image not in pictures:
                pictures[bare.image] = None if bare.image is None else files.image(bare.image)
            if bare.image is not None and not has_texels:
                files.problems.append(f"faces of the material {_name(name)} have no texture coordinates for its image")
            material = SimpleMaterial(pictures[bare.image], np.full(3, PLAIN) if bare.color is None else bare.color)
            if painted is None or pictures[bare.image] is not None:  # an image wins over colours of the vertices
                visual = trimesh.visual.TextureVisuals(uv, material)
        colors = painted[vertex] if painted is not None and visual is None else None
        pieces.append(
            trimesh.Trimesh(place[vertex, :3], index.reshape(-1, 3), vertex_colors=colors, visual=visual, process=False)
        )
        if looks and look is None and painted is None:
            files.problems.append(
                f"faces use no material (usemtl) of the material library, which has {', '.join(map(_name, looks))}"
                if name is None
                else f"the material library does not have the material {_name(name)}"
            )
    return pieces


def _name(name: bytes | None) -> str:
    return (name or b"").decode(errors="replace")


def _corner(token: bytes, num_points: int, num_coordinates: int) -> tuple[int, int]:
    """Return the indices of a corner v/vt/vn from 0. The second one is -1 without texture coordinates."""
    point, _, rest = token.partition(b"/")
    corner = rest.partition(b"/")[0]
    return _index(point, num_points), _index(corner, num_coordinates) if corner else -1


def _index(text: bytes, number: int) -> int:
    """Return an index from 0 of an index from 1, or of one that counts back from the last line."""
    index = int(text)
    if index == 0 or index < -number:
        raise Refusal(f"a face has the index {index}, but indices start at 1, or count back from -1: repair it")
    return index - 1 if index > 0 else number + index


def _numbers(rows: list[list[bytes]], least: int, what: str) -> np.ndarray:
    """Make an array of rows that have at least `least` numbers each."""
    columns = min(map(len, rows), default=least)
    if columns < least:
        short = _name(b" ".join(next(row for row in rows if len(row) == columns)))
        raise Refusal(f"a {what} has fewer than {least} numbers ({short!r}): repair the file")
    return np.array([row[:columns] for row in rows], float).reshape(-1, columns)


def _stl(data: bytes, _: Files) -> list[trimesh.Trimesh]:
    """Read an STL: text (solid ... endsolid), or a header of 80 bytes, a number and triangles of 50 bytes each."""
    if data[:2] in _WIDE:
        _text(data)  # raises an error
    number = int.from_bytes(data[80:84], "little")
    text = data.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if 84 + 50 * number != len(data) and text.startswith(b"solid") and b"\0" not in text[:1024]:
        if text.rfind(b"endsolid") <= text.rfind(b"endfacet"):
            raise Refusal("the file is truncated (its last line is not `endsolid`): replace the file")
        lines = [line.split() for line in text.splitlines()]
        rows = [line[1:] for line in lines if line[:1] == [b"vertex"]]
        if len(rows) != 3 * lines.count([b"endfacet"]) or any(len(row) != 3 for row in rows):
            raise Refusal("the file is damaged, because some facets do not have three corners: replace the file")
        corners = np.array(rows, float).reshape(-1, 3)
    elif len(data) < 84 + 50 * number or len(data) < 84:
        raise Refusal(
            f"the file is truncated or not an STL: its header announces {number:,} triangles, but the file has "
            f"{len(data):,} bytes. Replace the file"
        )
    else:  # some programs append further data
        layout = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
        corners = np.frombuffer(data, layout, number, 84)["corners"].astype(float).reshape(-1, 3)
    return [trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)] if len(corners) else []


def _ply(data: bytes, files: Files) -> list[trimesh.Trimesh]:
    """Read a PLY with trimesh, which expects a header in ASCII and the common names of colours."""
    head, end, body = data.removeprefix(b"\xef\xbb\xbf").partition(b"end_header")
    head = re.sub(rb"\bdiffuse_(red|green|blue)\b", rb"\1", re.sub(rb"\r\n?", b"\n", head))
    if re.search(rb"(?m)^format\s+ascii", head):
        body = re.sub(rb"\r\n?", b"\n", body)
    bare = re.sub(rb"(?m)^(comment|obj_info).*\n", b"", head)
    if wide := re.search(rb"(?m)^property\s+(u?short|u?int(?:16|32)?)\s+(?:red|green|blue)\b", bare):
        raise Refusal(f"the mesh has colours of the type {wide[1].decode()}: export colours of 8 bits (uchar)")
    pieces = _loaded(cut_ply(bare + end + body), "ply", files)
    names = [] if files.plain else re.findall(_TEXTURE, head)
    picture = files.image(names[0]) if names else None
    for piece in pieces:
        if picture is None:
            if (painted := piece.vertex_attributes.get("color")) is not None:  # also beside texture coordinates
                piece.visual = trimesh.visual.ColorVisuals(piece, vertex_colors=painted)
            continue
        if not isinstance(piece.visual, trimesh.visual.TextureVisuals):
            files.problems.append("the mesh has no texture coordinates for its image")
            break
        piece.visual = trimesh.visual.TextureVisuals(piece.visual.uv, PBRMaterial(baseColorTexture=picture))
    return pieces


def _off(data: bytes, files: Files) -> list[trimesh.Trimesh]:
    """Read an OFF with trimesh, which expects UTF-8."""
    return _loaded(cut_off(_text(data)), "off", files)


def _header(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the JSON header and the binary part of a glTF or GLB."""
    parts: dict[int, bytes] = {}
    if data[:4] == b"glTF":
        version, length = struct.unpack_from("<II", data, 4)
        start = 12
        while start + 8 <= min(length, len(data)):
            size, kind = struct.unpack_from("<II", data, start)
            parts.setdefault(kind, data[start + 8 : start + 8 + size])
            start += 8 + size
        if version != 2:
            raise Refusal(f"the file cannot be read as a mesh (glTF {version}): export it as glTF 2")
        if max(length, start) > len(data):
            raise Refusal(f"the file cannot be read as a mesh (only {len(data):,} of {length:,} bytes): replace it")
        data = parts.get(0x4E4F534A, b"")
    try:
        header = json.loads(data.decode("utf-8-sig", "replace"))
    except (ValueError, RecursionError) as error:
        raise Refusal(f"the file cannot be read as a mesh (its JSON is damaged: {error}): replace it") from error
    if not isinstance(header, dict):
        raise Refusal("the file cannot be read as a mesh (its JSON is no glTF header): replace it")
    return header, parts.get(0x004E4942, b"")


def _uri(files: Files, uri: str) -> bytes | None:
    """Return the content of a URI, or None if its file is missing."""
    if uri.startswith("data:"):
        kind, _, content = uri.partition(",")
        return base64.b64decode(content) if kind.endswith(";base64") else urllib.parse.unquote_to_bytes(content)
    path = files.find(urllib.parse.unquote(uri), uri)
    return None if path is None else path.read_bytes()


def _gltf(data: bytes, files: Files) -> list[trimesh.Trimesh]:
    """Read a glTF: trimesh builds the meshes from a header without images."""
    header, blob = _header(data)
    buffers = {}
    for number, part in enumerate(header.get("buffers", [])):
        content = _uri(files, part["uri"]) if "uri" in part else blob
        if content is None:
            raise FileNotFoundError(f"{files.path}: the mesh refers to the missing file {part['uri']}: add it")
        part["uri"], buffers[f"{number}"] = f"{number}", content
    _check(header, files)
    for mesh in header.get("meshes", []):
        for primitive in mesh["primitives"]:
            if "material" not in primitive and "COLOR_0" in primitive["attributes"]:  # which trimesh would round
                primitive["material"] = len(header.setdefault("materials", []))
                header["materials"].append({})
    looks = [_look(material) for material in header.get("materials", [])]
    images = {} if files.plain else _images(header, files, buffers, looks)
    for number, (color, _) in enumerate(looks):
        header["materials"][number] = {"name": f"{number}", "pbrMetallicRoughness": {"baseColorFactor": color.tolist()}}
    for mesh in header.get("meshes", []):
        for primitive in mesh["primitives"]:
            primitive.pop("extensions", None)
            if "material" in primitive:
                channel = _transform(looks[primitive["material"]][1])[0]
                attributes = primitive["attributes"]
                chosen = attributes.get(f"TEXCOORD_{channel}")
                attributes.pop("TEXCOORD_0", None)
                if chosen is not None:
                    attributes["TEXCOORD_0"] = chosen
    for key in ("images", "textures", "extensions", "extensionsUsed", "extensionsRequired"):
        header.pop(key, None)
    pieces = _loaded(json.dumps(header).encode(), "gltf", buffers)
    for piece in pieces:
        material = getattr(piece.visual, "material", None)
        if not isinstance(material, PBRMaterial):
            continue
        number = int(material.name)
        piece.metadata["factor"] = looks[number][0]  # which trimesh rounds to 8 bits
        material.baseColorTexture = images.get(number)
        if piece.visual.uv is not None:
            _, scale, angle, offset = _transform(looks[number][1])
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            uv = (piece.visual.uv * [1, -1] + [0, 1]) * scale @ turn + offset  # v of glTF points down
            piece.visual.uv = uv * [1, -1] + [0, 1]
        elif number in images:
            files.problems.append("faces of a material with an image have no texture coordinates")
    return pieces


def _check(header: dict[str, Any], files: Files) -> None:
    """Raise an error for parts of a glTF that cannot be read, and note the ones whose fallback is read."""
    required, used = header.get("extensionsRequired", []), header.get("extensionsUsed", [])
    for name in required:
        if name not in SUPPORTED and not name.startswith("KHR_materials_"):
            raise Refusal(f"the file requires the glTF extension {name}, which is not supported: export it without")
    ignored = sorted(set(used) & set(UNSUPPORTED))
    if any("skin" in node for node in header.get("nodes", [])):
        ignored.append("skins")
    if any(any(part.get("weights", [])) for part in [*header.get("meshes", []), *header.get("nodes", [])]):
        ignored.append("morph targets")
    if ignored:
        files.problems.append(f"unsupported parts of glTF are ignored ({', '.join(ignored)}): export it without them")
    accessors = header.get("accessors", [])
    for mesh in header.get("meshes", []):
        for primitive in mesh["primitives"]:
            if primitive.get("mode", 4) == 6:
                raise Refusal("the mesh has triangle fans (mode 6), which are not supported: export triangles")
            if primitive.get("mode", 4) < 4:
                continue  # points and lines have no surface
            for key in [*primitive["attributes"].values(), *([primitive["indices"]] if "indices" in primitive else [])]:
                accessor = accessors[key]
                if "bufferView" not in accessor or "sparse" in accessor:
                    names = ", ".join(primitive.get("extensions", {})) or "a sparse accessor"
                    raise Refusal(f"the mesh has compressed data ({names}), which is not supported: export it without")
            for name, key in primitive["attributes"].items():
                whole = accessors[key]["componentType"] != 5126
                if whole and name.startswith(("POSITION", "TEXCOORD")):
                    raise Refusal(f"{name} has whole numbers (KHR_mesh_quantization), not supported: export floats")


def _look(material: dict[str, Any]) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the colour factor (4,) of a glTF material and the reference to its texture, {} without one."""
    surface = material.get("pbrMetallicRoughness", {})
    gloss = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    color = np.array(surface.get("baseColorFactor", gloss.get("diffuseFactor", [1.0] * 4)), float)
    return _unit(color, 4), surface.get("baseColorTexture", gloss.get("diffuseTexture", {}))


def _transform(info: dict[str, Any]) -> tuple[int, np.ndarray, float, np.ndarray]:
    """Return the number of the texture coordinates, and their scale (2,), rotation (rad) and offset (2,)."""
    change = info.get("extensions", {}).get("KHR_texture_transform", {})
    channel = change.get("texCoord", info.get("texCoord", 0))
    scale, offset = np.array(change.get("scale", [1, 1]), float), np.array(change.get("offset", [0, 0]), float)
    return channel, scale, float(change.get("rotation", 0.0)), offset


def _images(
    header: dict[str, Any], files: Files, buffers: dict[str, bytes], looks: list[tuple[np.ndarray, dict[str, Any]]]
) -> dict[int, Image.Image]:
    """Read the images of the materials that have one."""
    read: dict[int, Image.Image | None] = {}
    result = {}
    for number, (_, info) in enumerate(looks):
        if "index" not in info:
            continue
        texture = header["textures"][info["index"]]
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
        source = texture.get("source", webp.get("source"))
        if source is None:
            names = ", ".join(texture.get("extensions", {})) or "no image"
            files.problems.append(f"a texture is ignored, because it has no PNG, JPEG or WebP image ({names})")
            continue
        if source not in read:
            read[source] = _image(header["images"][source], header, files, buffers, f"{files.path}, image {source}")
        picture = read[source]
        if picture is not None:
            result[number] = picture
    return result


def _image(
    image: dict[str, Any], header: dict[str, Any], files: Files, buffers: dict[str, bytes], name: str
) -> Image.Image | None:
    """Read an image of a glTF."""
    if "uri" in image:
        content = _uri(files, image["uri"])
        return None if content is None else read_image(content, name)
    view = header["bufferViews"][image["bufferView"]]
    start = view.get("byteOffset", 0)
    return read_image(buffers[f"{view['buffer']}"][start : start + view["byteLength"]], name)


_READERS = {".obj": _obj, ".stl": _stl, ".ply": _ply, ".off": _off, ".gltf": _gltf, ".glb": _gltf}

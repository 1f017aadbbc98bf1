"""A Matroska video file that grows by one image at a time. Players can read it at any time."""

import struct

CODECS = {"png": b"V_MS/VFW/FOURCC", "jpeg": b"V_MJPEG"}  # Matroska's name of the codec for each encoding of the images

_UNKNOWN = b"\x01" + b"\xff" * 7  # size of a segment whose length is not known yet
_TIMESTAMP_NS = 1_000_000  # unit of the times in the file (ns)


def header(width: int, height: int, encoding: str) -> bytes:
    """Return the first bytes of a Matroska video file with one video track.

    Args:
        width: Width of the images (pixels).
        height: Height of the images (pixels).
        encoding: Encoding of the images, "png" or "jpeg".
    """
    # Versions of EBML, length of the longest identifier and of the longest size field (bytes)
    ebml = _uint(0x4286, 1) + _uint(0x42F7, 1) + _uint(0x42F2, 4) + _uint(0x42F3, 8)
    ebml += _element(0x4282, b"matroska") + _uint(0x4287, 4) + _uint(0x4285, 2)
    information = _uint(0x2AD7B1, _TIMESTAMP_NS) + _element(0x4D80, b"sts_jax") + _element(0x5741, b"sts_jax")
    # Number of the track, its identifier, its kind (1: video), no lacing, codec
    track = _uint(0xD7, 1) + _uint(0x73C5, 1) + _uint(0x83, 1) + _uint(0x9C, 0) + _element(0x86, CODECS[encoding])
    if encoding == "png":  # a BITMAPINFOHEADER
        track += _element(0x63A2, struct.pack("<IiiHH4sIiiII", 40, width, height, 1, 24, b"MPNG", 0, 0, 0, 0, 0))
    track += _element(0xE0, _uint(0xB0, width) + _uint(0xBA, height))
    segment = _element(0x1549A966, information) + _element(0x1654AE6B, _element(0xAE, track))
    return _element(0x1A45DFA3, ebml) + _identifier(0x18538067) + _UNKNOWN + segment


def cluster(time_ms: int, image: bytes) -> bytes:
    """Return the bytes that append one image to a Matroska video file. The format calls these bytes a cluster.

    The returned bytes end with the encoded image.

    Args:
        time_ms: Time of the image since the start of the file (ms).
        image: Bytes of the encoded image.
    """
    block = b"\x81" + struct.pack(">hB", 0, 0x80) + image  # track 1, at the cluster's time, a key frame
    return _element(0x1F43B675, _uint(0xE7, time_ms) + _element(0xA3, block))


def _identifier(number: int) -> bytes:
    return number.to_bytes((number.bit_length() + 7) // 8, "big")


def _element(identifier: int, content: bytes) -> bytes:
    return _identifier(identifier) + b"\x01" + len(content).to_bytes(7, "big") + content


def _uint(identifier: int, value: int) -> bytes:
    return _element(identifier, value.to_bytes(max((value.bit_length() + 7) // 8, 1), "big"))

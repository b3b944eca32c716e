"""Small captures and the bytes of images that lie, made by hand: nothing of the service or of a library has to agree to write them."""

import json
import struct
import zlib
from pathlib import Path

import numpy as np

from stage.formats import exr

SIDE = 8
LIGHTS = ((0, 0, 1), (0.6, 0, 0.8), (0, 0.6, 0.8), (-0.6, 0, 0.8))


def manifest(names: list[str], side: int = SIDE, **more: object) -> dict:
    return {"schema": "relit.capture/1", "name": "small",
            "camera": {"projection": "orthographic", "resolution": [side, side], "pixel_size_m": 1e-3},
            "frames": [{"image": name, "light": {"type": "distant", "direction": light, "irradiance": [1, 1, 1]}}
                       for name, light in zip(names, LIGHTS, strict=False)], **more}


def write_capture(folder: Path, **more: object) -> Path:
    """Four frames of a grey plane, 000.exr …, and their manifest."""
    folder.mkdir(parents=True)
    names = [f"{number:03}.exr" for number in range(len(LIGHTS))]
    for name, light in zip(names, LIGHTS, strict=True):
        write_image(folder / name, np.full((SIDE, SIDE), 0.5 * light[2], np.float16))
    (folder / "capture.json").write_text(json.dumps(manifest(names, **more)))
    return folder


def write_image(path: Path, values: np.ndarray) -> None:
    exr.write(path, dict.fromkeys("RGB", values), color_space="lin_rec709_scene", metadata={})


def lying_exr(width: int, height: int, tile: int | None = None) -> bytes:
    """A header that claims so many pixels, and nothing behind it (OpenEXR file layout)."""
    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value

    channels = b"".join(name + b"\0" + struct.pack("<iiii", 1, 0, 1, 1) for name in (b"B", b"G", b"R")) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    return b"\x76\x2f\x31\x01" + struct.pack("<I", 2 | (0x200 if tile else 0)) + b"".join([
        attribute("channels", "chlist", channels), attribute("compression", "compression", b"\0"),
        attribute("dataWindow", "box2i", window), attribute("displayWindow", "box2i", window),
        attribute("lineOrder", "lineOrder", b"\0"), attribute("pixelAspectRatio", "float", struct.pack("<f", 1)),
        attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)), attribute("screenWindowWidth", "float", struct.pack("<f", 1)),
        *([attribute("tiles", "tiledesc", struct.pack("<IIB", tile, tile, 0))] if tile else [])]) + b"\0" + bytes(64)


def lying_png(width: int, height: int) -> bytes:
    """Whole chunks that claim so many pixels (PNG, 3rd edition, section 5)."""
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)) + chunk(
        b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")


def lying_tiff(width: int, height: int, channels: int = 3) -> bytes:
    """One strip that claims so many pixels (TIFF 6.0, section 2)."""
    entries = [(256, 4, width), (257, 4, height), (258, 3, 8), (259, 3, 1), (262, 3, 2), (273, 4, 8), (277, 3, channels), (278, 4, height),
               (279, 4, 100)]
    return b"II*\0" + struct.pack("<I", 108) + bytes(100) + struct.pack("<H", len(entries)) + b"".join(
        struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries) + struct.pack("<I", 0)


def lying_jxl(width: int, height: int) -> bytes:
    """A SizeHeader with both dimensions in 30 bits (ISO/IEC 18181-1), and nothing behind it."""
    bits, at = 0, 0
    for value, count in ((0, 1), (3, 2), (height - 1, 30), (0, 3), (3, 2), (width - 1, 30)):
        bits |= value << at
        at += count
    return b"\xff\x0a" + bits.to_bytes(-(-at // 8), "little") + bytes(64)


def lying_tga(width: int, height: int) -> bytes:
    """The header of a run-length encoded true-colour image with the origin at the top (Truevision TGA 2.0), and one run."""
    return struct.pack("<BBBHHBHHHHBB", 0, 0, 10, 0, 0, 0, 0, 0, width, height, 24, 0x20) + b"\xff\0\0\0"


def lying_bmp(width: int, height: int) -> bytes:
    """The headers of a 24-bit Windows bitmap, and a few pixels."""
    return b"BM" + struct.pack("<IHHIIiiHHIIiiII", 154, 0, 0, 54, 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0) + bytes(100)


def lying_npy(shape: str, kind: str = "<f4", content: bytes = b"") -> bytes:
    """A header of NumPy's format 1.0 with any text for the shape."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content

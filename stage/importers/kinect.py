"""Import of raw depth packets of the Kinect v2, as libfreenect2's DumpPacketPipeline writes them, with the P0 tables of the device.

A packet is ten images of 512×424 readings of eleven bits, which grow in steps of 1 to 64 with the reading (companding): three phases at
each of 80, 16 and 120 MHz, and one image that is not used. The rows are stored from the middle outwards and upside down, every fourth
reading together. Reading i of a frequency is P + Q cos(φ + p0 + 2πi/3), where p0 is an offset of each pixel and frequency from the P0
tables. The three readings are turned back by p0, which takes nothing away from them: three readings are mean, cosine and sine.

Sources: libfreenect2 (OpenKinect project), its depth packet processor; Järemo Lawin, Forssén and Ovrén, "Efficient multi-frequency phase
unwrapping using kernel density estimation", ECCV 2016 (frequencies and offsets).
"""

from collections.abc import Callable
from math import pi
from pathlib import Path

import numpy as np

from stage import inputs
from stage.errors import ManifestError, storage
from stage.folders import natural_order
from stage.importers.camera_options import View
from stage.importers.layout import Imported, write_capture

WIDTH, HEIGHT = 512, 424
BITS, IMAGES, USED = 11, 10, 9
IMAGE_BYTES = WIDTH * HEIGHT * BITS // 8
PACKET_BYTES = (IMAGES * IMAGE_BYTES, USED * IMAGE_BYTES)
FREQUENCIES_HZ = (80e6, 16e6, 120e6)
PHASES = 3
P0_HEADER_BYTES, P0_TABLE_BYTES = 32, 2 * WIDTH * HEIGHT
P0_BYTES = P0_HEADER_BYTES + 3 * (P0_TABLE_BYTES + 4)
"""A header, and before and behind each table a word of two bytes."""
P0_RADIANS = 0.000031 * pi
"""Radians of one unit of the P0 tables."""
SATURATED = 32767
"""The value that the device writes for a reading beyond its range."""


def import_folder(source: Path, destination: Path, *, packet: Path | None = None, p0: Path | None = None,
                  view: View | None = None) -> Imported:
    """Write a capture.json for a depth packet of a Kinect v2, and its nine images as .npy.
    `packet`: the packet; None: the only file of the size of a packet. `p0`: the response with the P0 tables; None: the only file with p0 in
    its name. `view`: the camera, as libfreenect2's IrCameraParams have it; None: orthographic."""
    packet = packet or _only(source, "depth packet", "--packet", lambda path: path.stat().st_size in PACKET_BYTES)
    p0 = p0 or _only(source, "file of P0 tables", "--p0", lambda path: "p0" in path.name.lower() and path.stat().st_size >= P0_BYTES)
    readings = decode(packet)
    tables = read_p0(p0)
    made, frames = {}, []
    for index, frequency in enumerate(FREQUENCIES_HZ):
        turned = without_offset(readings[PHASES * index:PHASES * (index + 1)], P0_RADIANS * tables[index])
        for step in range(PHASES):
            name = f"{packet.stem}_{frequency / 1e6:.0f}mhz_{step}.npy"
            made[name] = turned[step]
            frames.append({"image": name, "tof": {"type": "cw", "modulation_hz": frequency,
                                                  "reference_phase_rad": -2 * pi * step / PHASES}})
    view = view or View()
    written = write_capture({"name": source.resolve().name, "camera": view.entry((WIDTH, HEIGHT)),
                             "saturation": float(SATURATED), "frames": frames}, packet, destination, folder=source, arrays=made)
    saturated = int((np.abs(readings[:USED]) >= SATURATED).any(axis=0).sum())
    return Imported(written, (
        ("images", f"9 of {WIDTH}x{HEIGHT} pixels from {packet}: three phases at 80, 16 and 120 MHz; written as {next(iter(made))} "
                   "and so on"),
        ("offsets", f"from {p0}, {np.degrees(P0_RADIANS * tables.mean(axis=(1, 2))).round().astype(int).tolist()} degrees on average, "
                    "taken out of the images"),
        ("pixels", f"{saturated} are saturated at one frequency or more; the first and the last column hold nothing"),
        ("camera", view.describe())))


def companding() -> np.ndarray:
    """Return the signed reading of each code of eleven bits: [2048] int32, the code 1024 is SATURATED."""
    code = np.arange(1024)
    step = 1 << np.maximum(code // 128 - (code >= 128), 0)
    value = np.concatenate([[0], np.cumsum(step)[:-1]])
    table = np.concatenate([value, -value]).astype(np.int32)
    table[1024] = SATURATED
    return table


def decode(path: Path) -> np.ndarray:
    """Return the readings of a packet, upright: [9, 424, 512] int32; the first and the last column are 0."""
    content = inputs.read_bytes(path)
    if len(content) not in PACKET_BYTES:
        raise ManifestError(f"{path}: has {len(content)} bytes, a depth packet of a Kinect v2 has {IMAGES * IMAGE_BYTES}")
    words = np.frombuffer(content, "<u2").reshape(-1, HEIGHT, WIDTH * BITS // 16)[:USED].astype(np.uint32)
    padded = np.pad(words, ((0, 0), (0, 0), (0, 1)))
    column = np.arange(WIDTH)
    bit = BITS * ((column & 3) * (WIDTH // 4) + (column >> 2))
    word, shift = bit >> 4, (bit & 15).astype(np.uint32)
    codes = (padded[..., word] >> shift | padded[..., word + 1] << (16 - shift)) & 2047
    row = np.arange(HEIGHT)
    stored = np.where(row < HEIGHT // 2, row + HEIGHT // 2, HEIGHT - 1 - row)
    values = companding()[codes[:, stored]][:, ::-1]
    values[..., [0, -1]] = 0
    return values


def read_p0(path: Path) -> np.ndarray:
    """Return the P0 tables of the three frequencies: [3, 424, 512] float64, units of P0_RADIANS, upright."""
    content = inputs.read_bytes(path)
    if len(content) < P0_BYTES:
        raise ManifestError(f"{path}: has {len(content)} bytes, the response with the P0 tables of a Kinect v2 has {P0_BYTES} or more")
    words = np.frombuffer(content[P0_HEADER_BYTES:P0_BYTES], "<u2").reshape(3, -1)
    return words[:, 1:-1].reshape(3, HEIGHT, WIDTH).astype(np.float64)


def without_offset(readings: np.ndarray, offset_rad: np.ndarray) -> np.ndarray:
    """Return the readings of one frequency as they would be without the offset of each pixel.
    `readings`: [3, rows, cols] of P + Q cos(φ + offset + 2πi/3). `offset_rad`: [rows, cols]; the offset is its negative, as in
    libfreenect2. Returns [3, rows, cols] float32 of P + Q cos(φ + 2πi/3), all SATURATED where one reading is."""
    turns = np.exp(2j * np.pi * np.arange(PHASES) / PHASES)[:, None, None]
    phasor = (readings * turns.conj()).sum(axis=0) * 2 / PHASES * np.exp(1j * offset_rad)
    found = readings.mean(axis=0) + (phasor * turns).real
    return np.where((readings == SATURATED).any(axis=0), SATURATED, found).astype(np.float32)


def _only(folder: Path, what: str, option: str, fits: Callable[[Path], bool]) -> Path:
    with storage("read", folder):
        found = natural_order(path.name for path in folder.iterdir() if path.is_file() and fits(path))
    if len(found) != 1:
        raise ManifestError(f"{folder}: holds {', '.join(found)[:200] or 'no ' + what}: name the {what} with {option}")
    return folder / found[0]

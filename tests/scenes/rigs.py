"""Rigs of lamps on a sphere, and skies with suns, overcast or of coloured patches."""

import csv
import json
from pathlib import Path

import numpy as np

from stage.transforms import fibonacci_sphere
from tests.scenes.captures import write_exr
from tests.scenes.glossy import lat_long

RGB = {"red": (1.0, 0.0, 0.0), "green": (0.0, 1.0, 0.0), "blue": (0.0, 0.0, 1.0)}
SUN = np.array([0.4, 0.6, 0.69]) / np.linalg.norm([0.4, 0.6, 0.69])
NORMALS = fibonacci_sphere(300)


def write_rig(path: Path, directions, primaries=RGB, irradiance=1.0, *, name: str | None = None, protocol: str = "sacn",
              host: str | None = None, universes: int | None = None, names: str = "L{:03d}", fixed=(), **fields) -> dict:
    """Write a rig of distant lamps with these primaries, patched one after another or dealt to universes in turn; return its content."""
    width = len(primaries) * fields.get("bits", 8) // 8
    a_universe = 512 // width
    lights = []
    for index, direction in enumerate(np.asarray(directions).tolist()):
        universe, place = divmod(index, a_universe) if universes is None else divmod(index, universes)[::-1]
        lights.append({"name": names.format(index), "type": "distant", "direction": direction, **fields, "primaries": [
            {"name": primary, "irradiance": [irradiance * part for part in colour]} for primary, colour in primaries.items()],
            "address": {"protocol": protocol, "universe": 1 + universe, "host": host, "fixed": fixed, "channels": {
                primary: 1 + place * width + number * width // len(primaries) for number, primary in enumerate(primaries)}}})
    data = {"schema": "relit.rig/1", "name": name or path.stem, "color_space": "lin_rec709_scene", "lights": lights}
    path.write_text(json.dumps(data))
    return data


def sky(kind: str, rows: int = 64) -> np.ndarray:
    """Return [rows, 2 rows, 3] radiance: `sun` on a gradient, the `sun alone`, `overcast`, or coloured `patches`."""
    direction, solid = lat_long(rows)
    solid = np.broadcast_to(solid.reshape(rows, 1), direction.shape[:2])
    if kind in ("sun", "sun alone"):
        radiance = np.repeat((0.3 * np.clip(direction[..., 1], 0, 1) ** 0.5 + 0.1)[..., None], 3, axis=2) * (kind == "sun")
        place = np.unravel_index((direction @ SUN).argmax(), solid.shape)
        radiance[place] += np.array([1.0, 0.9, 0.7]) * 3 / solid[place]
        return radiance
    if kind == "overcast":
        return np.repeat(((1 + 2 * np.clip(direction[..., 1], 0, 1)) / 3)[..., None], 3, axis=2)
    random = np.random.default_rng(0)
    radiance = np.full((rows, 2 * rows, 3), 0.02)
    for _ in range(8):
        middle = random.normal(size=3)
        radiance[direction @ (middle / np.linalg.norm(middle)) > np.cos(np.radians(15))] = random.uniform(0.1, 3, 3)
    return radiance


def write_sky(path: Path, kind: str, rows: int = 64, scale: float = 1.0) -> np.ndarray:
    """Write a sky and return its radiance as the file has it, float64."""
    radiance = (scale * sky(kind, rows)).astype(np.float32)
    write_exr(path, radiance)
    return radiance.astype(np.float64)


def irradiance(radiance, normals=NORMALS):
    """Return ∫ L max(0, n·ω) dω of a map, [normals, 3]."""
    direction, solid = lat_long(len(radiance))
    energy = (radiance * solid.reshape(-1, 1, 1)).reshape(-1, 3)
    return np.maximum(normals @ direction.reshape(-1, 3).T, 0) @ energy


def lamps_irradiance(rig: dict, levels, normals=NORMALS):
    """Return Σ level · irradiance · max(0, n·l) of one frame, [normals, 3]."""
    found = np.zeros((len(normals), 3))
    for lamp in rig["lights"]:
        light = sum(levels[lamp["name"], primary["name"]] * np.array(primary["irradiance"]) for primary in lamp["primaries"])
        found += np.maximum(normals @ np.array(lamp["direction"]), 0)[:, None] * light
    return found


def read_levels(folder: Path) -> list[dict]:
    """Return the levels of cues.csv by lamp and primary, frame by frame."""
    frames: dict[str, dict] = {}
    with open(folder / "cues.csv", newline="") as file:
        for row in csv.DictReader(file):
            frames.setdefault(row["frame"], {})[row["light"], row["primary"]] = float(row["level"])
    return list(frames.values())


def sampled(radiance: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the energies of lamps [lights, 3] that are set to the pixels of an 8-bit panorama in their directions."""
    x, y, z = directions.T
    rows, columns = radiance.shape[:2]
    row, column = (np.arccos(y) / np.pi * rows).astype(int), (np.arctan2(x, -z) / (2 * np.pi) % 1 * columns).astype(int)
    return np.round(np.clip(radiance, 0, 1)[row, column] * 255) / 255 * 4 * np.pi / len(directions)


def rms(ours, truth) -> float:
    """Return the root mean square of ours − truth over that of the truth."""
    return float(np.sqrt(((ours - truth) ** 2).mean() / (truth**2).mean()))

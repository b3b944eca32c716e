"""`lambert` and `robust` on surfaces that reflect as Lambert's law says, and on others, under many lights and few, spread and frontal.

The scene is a field of dunes in closed form, with albedo printed on it, shaded with the reflectance models of Oren and Nayar (1994) and
Ward (1992), attached shadows and noise; nothing of it is used elsewhere. With a data folder, the DiLiGenT objects follow.
"""

import json
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.trials.lights import trial, write_grey
from benchmarks.trials.trial import Trial
from service.requests.solve import Method
from stage.importers import diligent

SIZE = 72
WAVES = ((0.055, 21.0, 4.0, 0.3), (0.09, -6.0, 13.0, 1.1), (0.05, 17.0, 15.0, 2.0))
"""Height, wave number along x and y, and phase of each train of dunes, across a field of width 1."""
VIEW = np.array([0.0, 0.0, 1.0])
Shade = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""From normals [pixels, 3] and the direction to a light [3] to radiance under irradiance π, of albedo 1."""


def matt(normal: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return Lambert's reflection."""
    return np.maximum(normal @ light, 0)


def chalk(normal: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return the reflection of rough matt facets, spread by 0.5 rad (Oren and Nayar, the qualitative model)."""
    toward, seen = np.clip(normal @ light, 0, 1), np.clip(normal @ VIEW, 0, 1)
    across_light, across_view = light - toward[:, None] * normal, VIEW - seen[:, None] * normal
    along = (across_light * across_view).sum(axis=1) / np.maximum(
        np.linalg.norm(across_light, axis=1) * np.linalg.norm(across_view, axis=1), 1e-9)
    angles = np.arccos(np.stack([toward, seen]))
    spread = 0.25
    rise = 0.45 * spread / (spread + 0.09) * np.maximum(along, 0) * np.sin(angles.max(axis=0)) * np.tan(angles.min(axis=0))
    return toward * (1 - 0.5 * spread / (spread + 0.33) + rise)


def metal(normal: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return the lobe of brushed metal (Ward, α = 0.3)."""
    half = (light + VIEW) / np.linalg.norm(light + VIEW)
    toward, seen, top = (np.clip(normal @ d, 1e-3, 1) for d in (light, VIEW, half))
    lobe = np.exp(-(1 / top**2 - 1) / 0.3**2) / (4 * 0.3**2 * np.sqrt(toward * seen))
    return np.where(normal @ light > 0, toward * lobe, 0)


def glaze(normal: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return matt reflection under a highlight."""
    return 0.8 * matt(normal, light) + 0.12 * metal(normal, light)


def mixture(normal: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return the light of a pixel whose halves are matt and metallic."""
    return 0.5 * matt(normal, light) + 0.5 * metal(normal, light)


@dataclass(frozen=True)
class Case:
    """One way to photograph the dunes."""

    name: str
    shade: Shade
    lights: int
    widest: float
    """Largest angle of a light from the view axis, degrees."""
    noise: float = 0.004
    """Standard deviation of the noise at full scale; it is shot noise, and a tenth of it in the dark."""
    exposure: float = 0.9
    """Brightest reading, of full scale; above 1 it is cut off."""
    dark: float = 0.3
    """Albedo of the darker squares; that of the others is 0.8."""
    glare: float = 0.0
    """Light that lies over an image, as a part of its mean."""


CASES = [
    Case("matt, 60 lights, weak noise", matt, 60, 50, noise=0.001), Case("matt, 60 lights, strong noise", matt, 60, 50, noise=0.04),
    Case("matt, 9 lights within 35°", matt, 9, 35), Case("matt, 5 lights", matt, 5, 40),
    Case("chalk, 60 lights", chalk, 60, 50), Case("chalk, 9 lights within 35°", chalk, 9, 35),
    Case("glaze, 60 lights", glaze, 60, 65), Case("glaze, 9 lights within 35°", glaze, 9, 35), Case("glaze, 3 lights", glaze, 3, 40),
    Case("glaze, 24 lights, cut off", glaze, 24, 55, exposure=2.5), Case("half metal, 40 lights", mixture, 40, 65),
    Case("metal, 60 lights", metal, 60, 65),
    Case("white and black, 24 lights", matt, 24, 60, dark=0.04),
    Case("white and black, 24 lights, glare of 3 %", matt, 24, 60, dark=0.04, glare=0.03),
]


def dunes() -> tuple[np.ndarray, np.ndarray]:
    """Return normals [pixels, 3] of the field and where its squares are bright [pixels]."""
    across = (np.arange(SIZE) + 0.5) / SIZE
    x, y = (plane.ravel() for plane in np.meshgrid(across, -across))
    slope = np.zeros((2, x.size))
    for high, along_x, along_y, phase in WAVES:
        slope += high * np.cos(along_x * x + along_y * y + phase) * np.array([[along_x], [along_y]])
    normal = np.stack([-slope[0], -slope[1], np.ones_like(x)], axis=1)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True), np.sin(31 * x) * np.sin(27 * y) > 0


def write(folder: Path, case: Case, normal: np.ndarray, bright: np.ndarray) -> None:
    """Write the capture of a case."""
    random = np.random.default_rng(17)
    i = np.arange(case.lights) + 0.5
    up = 1 - (1 - np.cos(np.radians(case.widest))) * i / case.lights
    turn = np.pi * (1 + 5**0.5) * i + 0.4
    directions = np.stack([np.sqrt(1 - up**2) * np.cos(turn), np.sqrt(1 - up**2) * np.sin(turn), up], axis=1)
    albedo = np.where(bright, 0.8, case.dark)
    images = np.stack([albedo * case.shade(normal, direction) for direction in directions])
    images += case.glare * images.mean(axis=1, keepdims=True)
    images *= case.exposure / np.percentile(images, 99.9)
    images += case.noise * np.sqrt(np.maximum(images, 0) + 0.01) * random.standard_normal(images.shape)
    frames = []
    for number, (image, direction) in enumerate(zip(images, directions, strict=True)):
        write_grey(folder / f"{number:02d}.exr", np.clip(image, 0, 1).reshape(SIZE, SIZE))
        frames.append({"image": f"{number:02d}.exr", "light": {"type": "distant", "direction": direction.tolist(),
                                                               "irradiance": [np.pi] * 3}})
    (folder / "capture.json").write_text(json.dumps({
        "schema": "relit.capture/1", "name": "dunes", "frames": frames, "saturation": 0.999,
        "camera": {"projection": "orthographic", "resolution": [SIZE, SIZE]}}))


def trials(data: Path | None) -> Iterator[Trial]:
    """Yield every case by both methods, and the DiLiGenT objects under all of their lights and under ten."""
    normal, bright = dunes()
    truth, mask = normal.reshape(SIZE, SIZE, 3), np.ones((SIZE, SIZE), dtype=bool)
    for case in CASES:
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder), case, normal, bright)
            for method in (Method.LAMBERT, Method.ROBUST):
                yield trial(case.name, Path(folder), truth, mask, in_model=case.shade is matt and not case.glare, method=method)[0]
    for name in () if data is None else ("diligent_ball", "diligent_cat"):
        assert data is not None
        known = np.load(data / name / "normal_gt.npz")["normal"]
        with tempfile.TemporaryDirectory() as folder:
            capture = Path(folder) / "capture"
            diligent.import_folder(data / name, capture)
            manifest = json.loads((capture / "capture.json").read_text())
            for step, words in ((1, "96 lights"), (10, "10 lights")):
                (capture / "capture.json").write_text(json.dumps({**manifest, "frames": manifest["frames"][::step]}))
                for method in (Method.LAMBERT, Method.ROBUST):
                    yield trial(f"{name}, {words}", capture, known, known.any(axis=-1), in_model=False, method=method)[0]

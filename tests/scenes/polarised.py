"""A dome of matt paint, glossy plastic, black plastic and a metal behind polarisers, rendered with the float64 twin of the contract's
model: diffuse light loses its polarisation, highlights keep it, and metals have nothing else."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.reference import microfacet
from tests.scenes.captures import distant, write_exr, write_image, write_manifest
from tests.scenes.glossy import PIXEL_M, VIEW, Dome, dome, sphere_directions

MATERIALS = {  # albedo, F0, roughness of the quarters of the dome
    "paint": ((0.55, 0.4, 0.25), (0.0, 0.0, 0.0), 1.0),
    "plastic": ((0.25, 0.35, 0.5), (0.05, 0.05, 0.05), 0.3),
    "black": ((0.04, 0.04, 0.04), (0.05, 0.05, 0.05), 0.4),
    "metal": ((0.0, 0.0, 0.0), (0.9, 0.7, 0.4), 0.45),
}
IRRADIANCE = 3.0
PEDESTAL = 0.05
"""What the camera adds to every value and the dark image holds, so that noise below zero is kept."""


class PolarisedScene(NamedTuple):
    """The surface, its materials and both parts of the light that it reflects."""

    surface: Dome
    material: np.ndarray  # [rows, cols] number of the material
    albedo: np.ndarray  # [rows, cols, 3]
    f0: np.ndarray  # [rows, cols, 3]
    roughness: np.ndarray  # [rows, cols]
    directions: np.ndarray  # [lights, 3]
    diffuse: np.ndarray  # [lights, rows, cols, 3]
    specular: np.ndarray  # [lights, rows, cols, 3]

    def of(self, name: str) -> np.ndarray:
        """[rows, cols] bool: where a material is."""
        return self.surface.mask & (self.material == list(MATERIALS).index(name))


def polarised_scene(size: int = 32, lights: int = 40) -> PolarisedScene:
    """A spherical cap under lights from the front half of the sphere."""
    surface = dome(size)
    rows, cols = np.indices(surface.mask.shape)
    material = 2 * (rows >= size / 2) + (cols >= size / 2)
    albedo, f0 = (np.array([entry[part] for entry in MATERIALS.values()])[material] for part in (0, 1))
    roughness = np.array([entry[2] for entry in MATERIALS.values()])[material]
    directions = sphere_directions(2 * lights)
    directions = directions[directions[:, 2] > 0.1][:lights]
    # a texture, by which pairs that are shifted are told
    texture = 0.75 + 0.5 * np.random.default_rng(1).random((size, size))
    albedo = albedo * texture[..., None]
    diffuse, specular = [], []
    for direction in directions:
        diffuse.append(IRRADIANCE * albedo * microfacet.diffuse(surface.normal, direction, VIEW)[..., None] * surface.mask[..., None])
        lobes = [microfacet.specular(surface.normal, direction, VIEW, roughness**2, f0[..., channel]) for channel in range(3)]
        shine = np.stack(lobes, axis=-1) * (f0.max(axis=-1) > 0)[..., None]
        specular.append(IRRADIANCE * shine * surface.mask[..., None])
    return PolarisedScene(surface, material, albedo, f0, roughness, directions, np.array(diffuse), np.array(specular))


def with_two_beckmann_lobes(scene: PolarisedScene) -> PolarisedScene:
    """The same dome under a coat of two lobes that no GGX lobe is (Beckmann's distribution, α 0.45 and 0.12), and without a metal."""
    albedo = np.where(scene.of("metal")[..., None], 0.15, scene.albedo)
    diffuse, specular = [], []
    for direction in scene.directions:
        lit = microfacet.diffuse(scene.surface.normal, direction, VIEW)[..., None] * scene.surface.mask[..., None]
        diffuse.append(IRRADIANCE * albedo * lit)
        coat = sum(microfacet.specular(scene.surface.normal, direction, VIEW, alpha, f0, microfacet.BECKMANN)
                   for alpha, f0 in ((0.45, 0.08), (0.12, 0.03)))
        specular.append(IRRADIANCE * np.repeat((coat * scene.surface.mask)[..., None], 3, axis=-1))
    return scene._replace(albedo=albedo, diffuse=np.array(diffuse), specular=np.array(specular))


def write_polarised(folder: Path, scene: PolarisedScene, *, leak: float = 0.0, declared: float | None = None, noise: float = 0.0,
                    exposures: tuple[float, ...] = (), seed: int = 0, **changes: object) -> Path:
    """Write a cross and a parallel image of every light, with noise of σ² = noise² (L² + 0.01 L_white L) that may fall below zero."""
    random = np.random.default_rng(seed)
    frames = []

    def add(name: str, image: np.ndarray, light: dict[str, object], exposure: float | None) -> None:
        write_exr(folder / name, _noisy(image, noise, random) * (exposure or 1.0) + PEDESTAL)
        frames.append({"image": name, "light": light} | ({} if exposure is None else {"exposure_s": exposure}))

    for index, direction in enumerate(scene.directions):
        light = distant(direction, IRRADIANCE)
        half, shine = scene.diffuse[index] / 2, scene.specular[index]
        for step, exposure in enumerate(exposures or (None,)):
            add(f"{index:03d}_{step}_cross.exr", half + leak * shine, light | {"polarization": "cross"}, exposure)
            add(f"{index:03d}_{step}_parallel.exr", half + (1 - leak) * shine, light | {"polarization": "parallel"}, exposure)
    return _finish(folder, scene, frames, {"polarizer_leak": declared, **changes})


def write_plain(folder: Path, scene: PolarisedScene, *, noise: float = 0.0, seed: int = 0) -> Path:
    """Write the images of a camera without polariser, which gather the light of both images of a pair."""
    random, frames = np.random.default_rng(seed), []
    for index, direction in enumerate(scene.directions):
        write_exr(folder / f"{index:03d}.exr", _noisy(scene.diffuse[index] + scene.specular[index], noise, random) + PEDESTAL)
        frames.append({"image": f"{index:03d}.exr", "light": distant(direction, IRRADIANCE)})
    return _finish(folder, scene, frames, {})


def _noisy(image: np.ndarray, noise: float, random: np.random.Generator) -> np.ndarray:
    white = IRRADIANCE / np.pi
    return image + noise * np.sqrt(image**2 + 0.01 * white * image + 1e-4 * white**2) * random.normal(size=image.shape)


def _finish(folder: Path, scene: PolarisedScene, frames: list[dict[str, object]], changes: dict[str, object]) -> Path:
    size = len(scene.material)
    write_image(folder / "mask.png", (scene.surface.mask * 255).astype(np.uint8))
    write_exr(folder / "dark.exr", np.full((size, size, 3), PEDESTAL))
    manifest = {"schema": "relit.capture/1", "name": "pol", "dark": "dark.exr", "mask": "mask.png", "frames": frames,
                "camera": {"projection": "orthographic", "resolution": [size, size], "pixel_size_m": PIXEL_M}, **changes}
    write_manifest(folder, {key: value for key, value in manifest.items() if value is not None})
    return folder

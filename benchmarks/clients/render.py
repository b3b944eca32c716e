"""Renders an asset in another program, with the capturing camera and one light."""

import json
import subprocess
import tempfile
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.clients import installed, three, usd_arrays
from stage import exr
from stage.camera import Camera

HERE = Path(__file__).parent
TIME_LIMIT_S = 900
"""A render of these small pictures takes seconds; a program that hangs is stopped."""
BOUNCES = 8
"""Longest path, in segments after the camera's: that of the path-traced captures."""


class Client(StrEnum):
    """A program that opens assets."""

    BLENDER = "blender"
    THREE = "three"
    MITSUBA = "mitsuba"


class Environment(NamedTuple):
    """Light from everywhere."""

    latlong: np.ndarray
    """[H, 2 H, 3] scene-linear Rec.709 radiance in the camera frame: +y in the top row, +z at the centre, +x a quarter from the left."""


class Sun(NamedTuple):
    """One distant light."""

    direction: tuple[float, float, float]
    """Unit vector from the surface to the light, camera frame."""
    irradiance: tuple[float, float, float]


def render(client: Client, asset: Path, camera: Camera, light: Environment | Sun, *, samples: int = 64) -> np.ndarray:
    """Return the picture of an asset as the program imports it, [rows, cols, 4] float32: linear RGB premultiplied by alpha, and alpha.

    Args:
        client: the program.
        asset: .usdz, .usda, .usdc; or .glb.
        camera: of the capture; its image is the picture.
        light: the only light.
        samples: paths of each pixel; three.js takes 4 by 4 samples of a pixel whatever their number.

    Raises:
        MissingClientError: the program is not installed.
        RuntimeError: the program fails; the text ends with what it said.
    """
    if client is Client.MITSUBA:
        return trace(usd_arrays.read(asset), camera, light, samples=samples)
    job: dict[str, Any] = {"asset": str(asset.resolve()), "camera": camera.model_dump(), "samples": samples}
    if isinstance(light, Sun):
        job["sun"] = light._asdict()
    if client is Client.THREE:
        return three.render(job, light.latlong if isinstance(light, Environment) else None)
    with tempfile.TemporaryDirectory() as folder:
        if isinstance(light, Environment):
            job["environment"] = str(Path(folder) / "environment.exr")
            exr.write(job["environment"], dict(zip("RGB", np.moveaxis(light.latlong.astype(np.float32), -1, 0), strict=True)),
                      color_space="lin_rec709_scene", metadata={})
        return _run(installed.python_with("bpy", "RELIT_TEST_BLENDER_PYTHON"), "inside_blender.py", job, Path(folder))


def trace(arrays: dict[str, np.ndarray], camera: Camera, light: Environment | Sun, *, samples: int) -> np.ndarray:
    """Return the picture of meshes and materials that Mitsuba traces, as `render` does.

    Args:
        arrays: as usd_arrays.read returns them.
        camera: of the capture.
        light: the only light.
        samples: paths of each pixel.

    Raises:
        MissingClientError: Mitsuba is not installed.
        RuntimeError: Mitsuba fails.
    """
    job: dict[str, Any] = {"camera": camera.model_dump(), "samples": samples}
    with tempfile.TemporaryDirectory() as folder:
        job["arrays"] = str(Path(folder) / "arrays.npz")
        np.savez(job["arrays"], **arrays)
        if isinstance(light, Sun):
            job["sun"] = light._asdict()
        else:
            job["environment"] = str(Path(folder) / "environment.npy")
            np.save(job["environment"], light.latlong.astype(np.float32))
        return _run(installed.python_with("mitsuba", "RELIT_TEST_MITSUBA_PYTHON"), "inside_mitsuba.py", job, Path(folder))


def _run(python: Path, script: str, job: dict[str, Any], folder: Path) -> np.ndarray:
    """Run a script of this package in another Python and return the picture that it writes."""
    job = {**job, "bounces": BOUNCES, "out": str(folder / "picture.exr")}
    (folder / "job.json").write_text(json.dumps(job))
    done = subprocess.run([python, "-P", HERE / script, folder / "job.json"], capture_output=True, text=True, timeout=TIME_LIMIT_S)
    if done.returncode != 0:
        raise RuntimeError(f"{script} failed: {(done.stdout + done.stderr)[-3000:]}")
    channels, _ = exr.read(job["out"])
    return np.stack([channels[name] for name in "RGBA"], axis=-1).astype(np.float32)

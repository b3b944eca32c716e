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
    asset = asset.resolve()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        job: dict[str, Any] = {"asset": str(asset), "camera": camera.model_dump(), "samples": samples, "bounces": BOUNCES,
                               "out": str(work / "picture.exr")}
        if isinstance(light, Sun):
            job["sun"] = {"direction": light.direction, "irradiance": light.irradiance}
        else:
            job["environment"] = str(work / "environment.exr")
            latlong = np.moveaxis(light.latlong.astype(np.float32), -1, 0)
            exr.write(work / "environment.exr", dict(zip("RGB", latlong, strict=True)), color_space="lin_rec709_scene", metadata={})
        if client is Client.THREE:
            return three.render(job, light.latlong if isinstance(light, Environment) else None)
        if client is Client.BLENDER:
            python = installed.python_with("bpy", "RELIT_BLENDER_PYTHON")
        else:
            python = installed.python_with("mitsuba", "RELIT_MITSUBA_PYTHON")
            if isinstance(light, Environment):
                np.save(work / "environment.npy", light.latlong.astype(np.float32))
                job["environment"] = str(work / "environment.npy")
            job["arrays"] = str(work / "arrays.npz")
            np.savez(job["arrays"], **usd_arrays.read(asset))
        (work / "job.json").write_text(json.dumps(job))
        _run([str(python), "-P", str(HERE / f"inside_{client}.py"), str(work / "job.json")])
        channels, _ = exr.read(job["out"])
    return np.stack([channels[name] for name in "RGBA"], axis=-1).astype(np.float32)


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIME_LIMIT_S)
    if done.returncode != 0:
        raise RuntimeError(f"{Path(command[2]).name} failed: {(done.stdout + done.stderr)[-3000:]}")

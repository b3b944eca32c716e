"""Renders assets in other programs, with the capturing camera and one light."""

import json
import subprocess
import tempfile
import threading
from contextlib import ExitStack, suppress
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.clients import installed, three, usd_arrays
from stage.capture.camera import Camera
from stage.formats import exr

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


class Programs:
    """Programs that are started when they are first needed, and then open one asset after another; to be used in a `with` statement."""

    def __init__(self) -> None:
        self._open = ExitStack()
        self._scripts: dict[str, _Script] = {}
        self._browser: three.Browser | None = None

    def __enter__(self) -> "Programs":
        return self

    def __exit__(self, *raised: object) -> None:
        self._open.close()

    def render(self, client: Client, asset: Path, camera: Camera, light: Environment | Sun, *, samples: int = 64) -> np.ndarray:
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
            return self.trace(usd_arrays.read(asset), camera, light, samples=samples)
        job: dict[str, Any] = {"asset": str(asset.resolve()), "camera": camera.model_dump(), "samples": samples}
        if isinstance(light, Sun):
            job["sun"] = light._asdict()
        if client is Client.THREE:
            if self._browser is None:
                self._browser = three.Browser()
                self._open.callback(self._browser.close)
            return self._browser.render(job, light.latlong if isinstance(light, Environment) else None)
        with tempfile.TemporaryDirectory() as folder:
            if isinstance(light, Environment):
                job["environment"] = str(Path(folder) / "environment.exr")
                exr.write(job["environment"], dict(zip("RGB", np.moveaxis(light.latlong.astype(np.float32), -1, 0), strict=True)),
                          color_space="lin_rec709_scene", metadata={})
            return self._script("bpy", "RELIT_TEST_BLENDER_PYTHON", "inside_blender.py").run(job, Path(folder))

    def trace(self, arrays: dict[str, np.ndarray], camera: Camera, light: Environment | Sun, *, samples: int) -> np.ndarray:
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
            return self._script("mitsuba", "RELIT_TEST_MITSUBA_PYTHON", "inside_mitsuba.py").run(job, Path(folder))

    def _script(self, module: str, variable: str, name: str) -> "_Script":
        if name not in self._scripts:
            self._scripts[name] = _Script(installed.python_with(module, variable), name)
            self._open.callback(self._scripts[name].close)
        return self._scripts[name]


def render(client: Client, asset: Path, camera: Camera, light: Environment | Sun, *, samples: int = 64) -> np.ndarray:
    """Return the picture of one asset, by a program that is started for it: as `Programs.render`."""
    with Programs() as programs:
        return programs.render(client, asset, camera, light, samples=samples)


class _Script:
    """A script of this package that runs in another Python, for one job after another."""

    def __init__(self, python: Path, name: str) -> None:
        self._name = name
        self._process = subprocess.Popen([python, "-P", HERE / "one_after_another.py", HERE / name], stdin=subprocess.PIPE,
                                         stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def run(self, job: dict[str, Any], folder: Path) -> np.ndarray:
        """Return the picture that the script writes of a job."""
        assert self._process.stdin is not None and self._process.stdout is not None
        job = {**job, "bounces": BOUNCES, "out": str(folder / "picture.exr")}
        (folder / "job.json").write_text(json.dumps(job))
        limit = threading.Timer(TIME_LIMIT_S, self._process.kill)
        limit.start()
        said = []
        try:
            with suppress(BrokenPipeError):  # it has ended; below it says why
                print(folder / "job.json", file=self._process.stdin, flush=True)
            for line in self._process.stdout:
                if line == "job: DONE\n":
                    channels, _ = exr.read(job["out"])
                    return np.stack([channels[name] for name in "RGBA"], axis=-1).astype(np.float32)
                if line == "job: FAILED\n":
                    break
                said.append(line)
        finally:
            limit.cancel()
        raise RuntimeError(f"{self._name} failed: {''.join(said)[-3000:]}")

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.communicate()

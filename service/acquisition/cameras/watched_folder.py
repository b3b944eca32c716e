"""A camera whose pictures another program writes into a folder, as tethering programs do."""

import subprocess
import time
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from service.acquisition.cameras.camera import Camera, NoPictureError, Picture, Setup
from service.errors import RequestError
from stage.errors import ImageError, storage
from stage.formats import images

POLL_S = 0.01
"""The time between two looks at the folder."""


class WatchedFolder(Camera):
    """Takes new files of a folder for pictures, in the order in which they come."""

    def __init__(self, folder: Path, pattern: str, setup: Setup) -> None:
        if not folder.is_dir():
            raise RequestError(f"--camera watch:{folder}: there is no such folder: give the one into which the tethering program writes")
        if folder.resolve() == setup.spool.parent.resolve():
            raise RequestError(f"--camera watch:{folder}: is the folder of --out, whose files would be taken for pictures: give another")
        self._folder, self._pattern, self._setup = folder, pattern, setup
        self._taken: dict[str, str] = {}  # the name of the file of each picture by the same without its suffix
        self._known = {path.name for path in self._files()} if setup.known is None else set(setup.known)

    def present(self) -> list[str]:
        """Return the names of the files that are known."""
        return sorted(self._known)

    def take(self, exposure_s: float | None) -> Picture:
        """Release the camera, where a program does it, and wait for the next file."""
        if exposure_s is not None and not any("{exposure_s}" in part for part in self._setup.trigger):
            raise RequestError("exposures_s: a watched folder without {exposure_s} in --trigger cannot set an exposure time")
        self._release(exposure_s)
        until = time.monotonic() + self._setup.timeout_s + (exposure_s or 0.0)
        sizes: dict[str, int] = {}
        while time.monotonic() < until:
            for path in self._new():
                size = path.stat().st_size
                if size > 0 and sizes.get(path.name) == size and (pixels := _whole(path)) is not None:
                    self._known.add(path.name)
                    self._taken[path.stem] = path.name
                    return Picture(path, pixels)
                sizes[path.name] = size
            time.sleep(POLL_S)
        if sizes:
            raise NoPictureError(f"{self._folder / next(iter(sizes))} was begun and is no whole image")
        raise NoPictureError(f"no file came into {self._folder} within {self._setup.timeout_s:g} s")

    def look(self) -> np.ndarray:
        """Refuse: a folder has pictures that were taken alone."""
        raise RequestError(f"--camera watch:{self._folder}: a watched folder has no live view")

    def unasked(self) -> list[Path]:
        """Return the files that came without being asked for."""
        found = self._new()
        self._known.update(path.name for path in found)
        return found

    def _release(self, exposure_s: float | None) -> None:
        if not self._setup.trigger:
            return
        command = [part.replace("{exposure_s}", "" if exposure_s is None else f"{exposure_s:g}") for part in self._setup.trigger]
        try:
            subprocess.run(command, check=True, timeout=self._setup.timeout_s + (exposure_s or 0.0), capture_output=True, text=True)
        except FileNotFoundError as error:
            raise RequestError(f"--trigger {command[0]}: there is no such program") from error
        except subprocess.TimeoutExpired as error:
            raise RequestError(f"--trigger {' '.join(command)}: did not end within {error.timeout:g} s") from error
        except (subprocess.CalledProcessError, OSError) as error:
            code = f"exit code {error.returncode}" if isinstance(error, subprocess.CalledProcessError) else error.strerror
            said = " ".join(str(getattr(error, "stderr", "") or code).split())[:200]
            raise RequestError(f"--trigger {' '.join(command)}: failed: {said}") from error

    def _files(self) -> list[Path]:
        """Return the images of the folder, those first that were changed first; hidden ones are left out."""
        with storage("read", self._folder):
            found = []
            for path in self._folder.iterdir():
                if not path.name.startswith(".") and fnmatch(path.name, self._pattern) and path.suffix.lower() in images.SUFFIXES:
                    try:
                        found.append((path.stat().st_mtime_ns, path))
                    except FileNotFoundError:  # a temporary name, which has just got its own
                        continue
            return [path for _, path in sorted(found)]

    def _new(self) -> list[Path]:
        """Return the files that are not known. Raises RequestError if one is a second file of a picture, as raw beside JPEG is, which would
        be taken for the next picture."""
        found = [path for path in self._files() if path.name not in self._known]
        for path in found:
            if (other := self._taken.get(path.stem)) is not None:
                raise RequestError(f"--camera watch:{self._folder}: {other} and {path.name} are two files of one picture: let the camera "
                                   f"write one, or watch one kind, as in watch:{self._folder}/*{path.suffix}, with another --out")
        return found


def _whole(path: Path) -> np.ndarray | None:
    """Return the pixels of a file, or None if it is not a whole image yet."""
    try:
        return images.read_pixels(path)
    except ImageError:
        return None


def open_camera(detail: str, setup: Setup) -> WatchedFolder:
    """Return the camera of FOLDER, or of the files in it that match, FOLDER/*.jpg."""
    if not detail:
        raise RequestError("--camera watch: give the folder, as in watch:/mnt/tether")
    path = Path(detail)
    return WatchedFolder(path.parent, path.name, setup) if any(sign in path.name for sign in "*?[") else WatchedFolder(path, "*", setup)

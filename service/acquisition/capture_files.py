"""The files of a capture that is being taken: pictures, and a capture.json that names those that there are."""

import hashlib
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from service.acquisition.plans.shots import FLAT, Shot
from service.errors import RequestError
from stage.capture.manifest import FILE_NAME, SCHEMA, Manifest, write_manifest
from stage.colour.colour_spaces import ColorSpaceName
from stage.errors import storage
from stage.files import remove_unfinished, replacing
from stage.importers.camera_options import View
from stage.importers.layout import assumed_encoding, color_space_of, image_resolution
from stage.rig.rig import Rig

REJECTED = "rejected"
"""The folder of pictures that were taken again."""


class CaptureFiles:
    """The folder of a capture, and those of its calibration sequences in it."""

    def __init__(self, folder: Path, rig: Rig, shots: Sequence[Shot], color_space: ColorSpaceName | None, saturation: float | None
                 ) -> None:
        """Take the folder of the journal over, without the half-written files of a run that was killed."""
        self._folder, self._rig, self._shots, self._color_space, self._saturation = folder, rig, shots, color_space, saturation
        for name in {REJECTED, "", *(shot.folder for shot in shots)}:
            remove_unfinished(folder / name)

    def path_of(self, shot: Shot, suffix: str) -> Path:
        """Return the path of the picture of a shot."""
        return self._folder / shot.folder / f"{shot.name}{suffix.lower()}"

    def keep(self, shot: Shot, picture: Path) -> dict[str, Any]:
        """Copy the file of a picture into the capture, whole or not at all, and return what the journal says of it."""
        path = self.path_of(shot, picture.suffix)
        digest = hashlib.sha256()
        with storage("read", picture), open(picture, "rb") as source, replacing(path) as temporary, open(temporary, "wb") as target:
            while part := source.read(1 << 20):
                digest.update(part)
                target.write(part)
        return {"file": path.relative_to(self._folder).as_posix(), "source": picture.name, "sha256": digest.hexdigest()}

    def reject(self, shot: Shot, picture: Path, attempt: int) -> dict[str, Any]:
        """Keep the file of a picture that is taken again among the rejected ones, and return what the journal says of it."""
        path = self._folder / REJECTED / f"{shot.key.replace('/', '_')}.{attempt}{picture.suffix.lower()}"
        with storage("read", picture), replacing(path) as temporary:
            shutil.copyfile(picture, temporary)
        return {"file": path.relative_to(self._folder).as_posix(), "source": picture.name}

    def withdraw(self, shot: Shot, line: Mapping[str, Any], attempt: int) -> dict[str, Any]:
        """Move the picture that a shot has to the rejected ones, and return what the journal says of it."""
        path = self._folder / line["file"]
        found = self.reject(shot, path, attempt)
        path.unlink()
        return {**found, "source": line["source"], "was_taken": True}

    def write_manifest(self, folder: str, taken: Mapping[str, Mapping[str, Any]], *, mask: str | None = None,
                       assumed: tuple[str, ...] = ()) -> None:
        """Write the capture.json of a folder with the pictures that there are; without any frame there is none.

        Args:
            taken: the lines of the journal by the key of the shot.
            mask: the image of the mask in the folder.
            assumed: more sentences for the entry `assumed`.

        Raises:
            RequestError: the camera of the rig has another resolution than the pictures.
        """
        frames: list[dict[str, Any]] = []
        names: list[str] = []
        flat = None
        for shot in self._shots:
            line = taken.get(shot.key)
            if shot.folder != folder or line is None:
                continue
            name = Path(line["file"]).name
            if shot.name == FLAT:
                flat = name
                continue
            if shot.grey is not None:
                continue
            names.append(name)
            frames.append({"image": name, "light": shot.light, "pattern": shot.pattern, "exposure_s": shot.exposure_s})
        if not frames:
            return
        place = self._folder / folder
        first = place / names[0]
        resolution = image_resolution(first)
        camera = self._rig.camera
        if camera is not None and camera.resolution != resolution:
            (width, height), (columns, rows) = camera.resolution, resolution
            raise RequestError(f"camera.resolution of the rig {self._rig.name} is {width}x{height}, the picture {first.name} has "
                               f"{columns}x{rows}: set the camera to the size for which it was calibrated")
        space = self._color_space or color_space_of(first)
        manifest = Manifest.model_validate({
            "schema": SCHEMA, "name": folder or self._folder.resolve().name, "color_space": space,
            "camera": camera or View().entry(resolution), "flat": flat, "saturation": self._saturation, "mask": mask,
            "assumed": (*assumed, *assumed_encoding(space, self._color_space)), "irradiance_scale": "relative", "frames": tuple(frames)})
        write_manifest(manifest, place / FILE_NAME)

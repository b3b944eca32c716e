"""The output files of frames: their paths, which files they may replace, and which of them an equal request has made already."""

import hashlib
import json
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from service import __version__
from service.errors import RequestError
from service.relight.environments import Environments
from service.relight.opened_capture import OpenedCapture
from service.relight.schedule import ScheduledFrame
from service.reporting.provenance import choices
from service.requests.light.frame_range import numbered
from service.requests.light.picture_options import FrameMatte, Layer
from service.requests.relight import RelightRequest
from stage.colour.configuration import current
from stage.colour.location import BUILT_IN, location
from stage.errors import StageError
from stage.files import require_writable
from stage.formats import exr, exr_scan
from stage.stack import fingerprint

ARITHMETIC = 3
"""Version of the arithmetic, part of every request hash. It is raised when the same request gives other pixels, so that older frames are
made again."""
REQUEST_ATTRIBUTE = "relit:request"
"""Attribute of a frame's file: the hash of everything that the frame's pixels depend on."""
RESOLVED = {
    "frames": "the schedule, which gives each frame its turn of the environment",
    "spin_degrees": "the rotation of each frame's environment",
    "exposure": "the stops of each frame, with those of the light keys",
    "frames_per_second": "the rate of the frames, that of the light keys where the request has none",
    "aov": "the layers in any order",
    "align": "the key of the stack",
    "align_to": "the key of the stack",
}
"""Choices of a request that the hash of a frame contains in another form, and that form. Every other choice is in it as it is."""


def frame_path(pattern: str, number: int, *, option: str = "--out", ending: str = ".exr") -> Path:
    """Return the file that a frame is written to: of the pattern of an option, whose name has one run of # and a certain ending."""
    folder, name = os.path.split(pattern)
    if len(re.findall(r"#+", name)) != 1 or "#" in folder:
        raise RequestError(f"{option} {pattern}: the file name needs one run of # for the frame number, such as frame.####{ending}")
    if not name.lower().endswith(ending):
        raise RequestError(f"{option} {pattern}: frames are {'OpenEXR' if ending == '.exr' else 'PNG here'}: end the name in {ending}")
    return Path(folder) / numbered(name, number)


def display_path(pattern: str, number: int) -> Path:
    """Return the file of a frame as a display shows it."""
    return frame_path(pattern, number, option="--display", ending=".png")


def check_outputs(outputs: Sequence[tuple[str, Path]], inputs: Iterable[Path]) -> None:
    """Refuse, before any work is done, to write over an input, two results into one file, or into a folder that cannot be written to.

    Args:
        outputs: (option as it was given, file) of every file that will be written.
    """
    written: dict[Path, tuple[str, Path]] = {}
    for option, path in outputs:
        if (earlier := written.setdefault(path.resolve(), (option, path))) != (option, path):
            raise RequestError(f"{option}: {path} is what {earlier[0]} writes too: choose another name")
    for read in inputs:  # which may be many, of a long sequence
        if (found := written.get(read.resolve())) is not None:
            raise RequestError(f"{found[0]}: {found[1]} is an input: choose another folder or name")
    folders: dict[Path, Path] = {}
    for _, path in outputs:
        folders.setdefault(path.parent, path)
    for path in folders.values():
        require_writable(path)


def frame_hashes(opened: OpenedCapture, request: RelightRequest, frames: Sequence[ScheduledFrame], environments: Environments | None,
                 rate: float) -> list[str]:
    """Return a hash for each frame of everything that its pixels and its camera and time attributes depend on; the request has the weights
    that are used."""
    mask = opened.capture.manifest.mask if request.matte is not FrameMatte.NONE or Layer.MASK in request.aov else None
    scene = _hash(
        stack=opened.ingest.key, direction=_digits(opened.lights.direction), irradiance=_digits(opened.lights.irradiance),
        layers=sorted(request.aov), camera=opened.capture.camera.model_dump_json(), rate=rate,
        maps=None if opened.maps is None else fingerprint.digest(opened.maps),
        mask=fingerprint.digest(opened.capture.file(mask)) if mask is not None else None,
        **({"ocio": current().label} if location() != BUILT_IN else {}),
        **{name: value for name, value in choices(request).items() if name not in RESOLVED})
    return [_hash(
        scene=scene, stops=frame.exposure_stops, captured=frame.captured,
        sky=None if frame.environment is None or environments is None else
        [environments.content(frame.environment.path), frame.environment.exposure_stops, _digits(frame.environment.rotation)],
        discs=[[_digits(disc.direction), _digits(disc.irradiance), disc.angle_degrees, disc.color_space] for disc in frame.discs],
    ) for frame in frames]


def is_complete(path: Path, request_hash: str) -> bool:
    """Return whether the file is a frame that was made by a request of this hash, with every byte as it was written."""
    if not path.is_file():
        return False
    try:
        return bool(exr.read_header(path).metadata.get(REQUEST_ATTRIBUTE) == request_hash) and exr_scan.is_intact(path)
    except StageError:  # not an EXR, truncated or unreadable: the frame is made again
        return False


def _hash(**parts: Any) -> str:
    """Return a hash of named parts and the program's version. Files on disk carry it, so renaming a part makes every existing frame be made
    again."""
    text = json.dumps({"arithmetic": ARITHMETIC, "version": __version__, **parts}, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _digits(values: np.ndarray) -> list[float]:
    """Return the values with nine digits, which the last bit of another processor's arithmetic cannot change."""
    return [float(f"{value:.9g}") + 0.0 for value in np.ravel(values)]

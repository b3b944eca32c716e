"""The options of importers about camera, axes and images, and the entries of the manifest that follow from them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stage.errors import ManifestError
from stage.formats.camera_raw import path_is_raw
from stage.importers.layout import image_names
from stage.importers.light_rig import read_camera_matrix
from stage.model import name_fault

MASK_WORDS, AMBIENT_WORDS = frozenset({"mask"}), frozenset({"ambient"})
"""Words in the name of an image by which it is the mask, or an image of ambient light alone."""


@dataclass(frozen=True, kw_only=True)
class View:
    """The camera, as far as it is known; without a focal length it is orthographic."""

    focal_px: tuple[float, ...] | None = None
    """fx and fy in pixels, or one for both."""
    principal_px: tuple[float, float] | None = None
    """The image coordinates of the principal point; the centre of the first pixel is 0.5, 0.5."""
    distortion: tuple[float, ...] | None = None
    """OpenCV's k1 k2 p1 p2 and, if any, k3."""
    pixel_size_m: float | None = None
    surface_z_m: float | None = None

    def entry(self, resolution: tuple[int, int]) -> dict[str, Any]:
        """Return the entry `camera` of the manifest."""
        entry: dict[str, Any] = {"projection": "orthographic" if self.focal_px is None else "perspective", "resolution": list(resolution)}
        if self.focal_px is not None:
            entry["focal_px"] = [self.focal_px[0], self.focal_px[-1]]
        if self.distortion is not None:
            k1, k2, p1, p2, k3 = (*self.distortion, 0.0)[:5]
            entry["distortion"] = {"model": "brown_conrady", "k": [k1, k2, k3], "p": [p1, p2]}
        for name in ("principal_px", "pixel_size_m", "surface_z_m"):
            if (value := getattr(self, name)) is not None:
                entry[name] = value
        return entry

    def describe(self) -> str:
        """Return the camera in a few words."""
        if self.focal_px is None:
            size = f", {1000 * self.pixel_size_m:g} mm a pixel" if self.pixel_size_m is not None else ", of unknown scale"
            return f"orthographic{size}: give --focal-px for a perspective camera"
        centre = "the centre of the image" if self.principal_px is None else "{:g}, {:g}".format(*self.principal_px)
        return f"perspective, focal length {' x '.join(f'{value:g}' for value in self.focal_px)} px, principal point {centre}"


def view_of_file(view: View, camera: Path | None, resolution: tuple[int, int]) -> tuple[View, str]:
    """Return the camera of a file or of the options, and words for it."""
    if camera is None:
        return view, view.describe()
    if view.focal_px is not None or view.principal_px is not None or view.distortion is not None:
        raise ManifestError(f"{camera}: --camera is given, and --focal-px, --principal-px or --distortion too: give one of both")
    found = read_camera_matrix(camera, resolution)
    distortion = None if found.distortion is None else (*found.distortion.k[:2], *found.distortion.p, found.distortion.k[2])
    view = replace(view, focal_px=found.focal_px, principal_px=found.principal_px, distortion=distortion)
    return view, f"{view.describe()}, from {camera}, where the centre of the first pixel is {found.convention}"


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Names that choose the frames, the mask and the ambient image of a folder."""

    images: str | None = None
    """The names of the frames, as the shell matches them; None: every image that is neither mask nor ambient light."""
    mask: str | None = None
    """The name of the mask; None: the one image with the word mask in its name."""
    ambient: str | None = None
    """The name of the image of ambient light alone; None: the one image with the word ambient in its name."""


class Selected(NamedTuple):
    """The images of a folder by what they are."""

    frames: tuple[str, ...]
    """Names of the frames in natural order: 2 before 10."""
    mask: str | None
    ambient: str | None

    def facts(self) -> list[tuple[str, str]]:
        """Return what was understood, as `Imported.facts` has it."""
        found = [("mask", self.mask or "none: every pixel is taken")]
        return found if self.ambient is None else [*found, ("ambient", f"{self.ambient} is subtracted from the others")]


def select(folder: Path, selection: Selection) -> Selected:
    """Return the images of a folder by what they are."""
    names = image_names(folder)
    mask = only_image(folder, names, selection.mask, MASK_WORDS, "mask")
    ambient = only_image(folder, names, selection.ambient, AMBIENT_WORDS, "ambient")
    wanted = [name for name in names if name not in (mask, ambient)
              and (not words_of(name) & (MASK_WORDS | AMBIENT_WORDS) if selection.images is None else fnmatch(name, selection.images))]
    for name in wanted:
        if (fault := name_fault(name)) is not None:
            raise ManifestError(f"{folder}: the name {ascii(name)[1:-1]} {fault}")
    if selection.images is None:
        refuse_twins(folder, wanted)
    if not wanted:
        raise ManifestError(f"{folder}: holds no image" + (f" that {selection.images} names" if selection.images else "")
                            + (": give --images" if names else ""))
    return Selected(tuple(wanted), mask, ambient)


def mask_beside(folder: Path, frames: Sequence[str]) -> str | None:
    """Return the mask of a folder whose frames a file names: mask.png, or else the only other image with the word mask in its name."""
    found = [name for name in image_names(folder) if words_of(name) & MASK_WORDS and name not in frames]
    return "mask.png" if "mask.png" in found else found[0] if len(found) == 1 else None


def refuse_twins(folder: Path, names: Sequence[str]) -> None:
    """Refuse images that are one photograph, as cameras and programs write it twice: camera raw and JPEG under one name, or several TIFF
    and JPEG, of which one pair may be an image that was looked at."""
    first: dict[str, str] = {}
    twins = [(before, name) for name in names
             if Path(before := first.setdefault(Path(name).stem.lower(), name)).suffix.lower() != Path(name).suffix.lower()]
    twins.sort(key=lambda pair: not any(map(path_is_raw, pair)))
    if len(twins) > 1 or any(map(path_is_raw, twins[0] if twins else ())):
        one, other = twins[0]
        raise ManifestError(f"{folder}: {one} and {other} are one photograph: choose which are used, --images '*{Path(one).suffix}' "
                            f"or --images '*{Path(other).suffix}'")


def words_of(name: str) -> frozenset[str]:
    """Return the words of a file's name in small letters, without its suffix: those of `cat.mask_raw.png` are cat, mask and raw."""
    text = "".join(letter if letter.isalpha() else " " for letter in Path(name).stem)
    return frozenset(text.lower().split())


def only_image(folder: Path, names: list[str], given: str | None, words: frozenset[str], what: str) -> str | None:
    """Return the image that was named, or else the only one with one of the words in its name, or None."""
    if given is not None:
        if given not in names:
            raise ManifestError(f"{folder}: --{what} {given}: there is no such image in the folder")
        return given
    found = [name for name in names if words_of(name) & words]
    if len(found) > 1:
        raise ManifestError(f"{folder}: {found[0]} and {found[1]} both look like the {what}: name it with --{what}")
    return found[0] if found else None


WAYS: dict[str, tuple[int, int, int]] = {"right": (1, 0, 0), "left": (-1, 0, 0), "up": (0, 1, 0), "down": (0, -1, 0),
                                         "towards": (0, 0, 1), "away": (0, 0, -1)}
"""The direction of an axis as seen by the camera → its unit vector in the camera frame; `away` is where the camera looks."""

Axes = tuple[str, str, str]
"""The directions of x, y and z of a table, each a member of WAYS."""


def camera_from_table(axes: Axes) -> np.ndarray:
    """Return the matrix that takes vectors of a table to the camera frame: [3, 3] float64 for column vectors; it mirrors when the axes are
    left-handed."""
    matrix = np.array([WAYS[way] for way in axes], dtype=np.float64).T
    if np.linalg.matrix_rank(matrix) < 3:
        raise ManifestError(f"--axes {','.join(axes)}: two of them lie on one line: give one of right, left, one of up, down and one of "
                         "towards, away")
    return matrix


def describe(axes: Axes) -> str:
    """Return the axes as words: `x right, y down, z away from the camera (right-handed)`."""
    words = {"towards": "towards the camera", "away": "away from the camera"}
    hand = "right" if np.linalg.det(camera_from_table(axes)) > 0 else "left"
    return ", ".join(f"{name} {words.get(way, way)}" for name, way in zip("xyz", axes, strict=True)) + f" ({hand}-handed)"

"""Import of stacks of projected patterns: Gray codes and phase shifts in the order that options say, and the codecs of SLStudio."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from stage.capture.camera import Distortion
from stage.colour.colour_spaces import ColorSpaceName
from stage.errors import ManifestError
from stage.importers.camera_options import MASK_WORDS, only_image
from stage.importers.layout import Imported, image_names, image_resolution, write_capture
from stage.importers.opencv_file import CAMERA_SIZE, camera_from_projector, check_size, lens, pick, read_matrices, told_size
from stage.importers.pattern_order import Entry, GrayStack, PhaseStack, describe, gray_entries
from stage.importers.video import VideoFrames

CAMERA_MATRIX = ("cam_K", "cam_int", "camera_matrix", "cameraMatrix1", "M1", "K1", "mtx1", "Kc", "left_camera_matrix", "K_left")
CAMERA_LENS = ("cam_kc", "cam_dist", "distortion_coefficients", "distCoeffs1", "D1", "dist1", "kc", "left_distortion", "D_left")
PROJECTOR_MATRIX = ("proj_K", "proj_int", "projector_matrix", "cameraMatrix2", "M2", "K2", "mtx2", "Kp", "right_camera_matrix", "K_right")
PROJECTOR_LENS = ("proj_kc", "proj_dist", "projector_distortion", "distCoeffs2", "D2", "dist2", "kp", "right_distortion", "D_right")
ROTATION, TRANSLATION = ("R", "rotation", "roatation", "Rp"), ("T", "translation", "t", "Tp")
"""The names under which calibration files hold these matrices and vectors, in order of preference; one common tool misspells, and those
with a small p or c at the end are SLStudio's."""
PROJECTOR_SIZE = ("screenResX", "screenResY")
"""The names of the projector's size in SLStudio's files."""
PIXEL_CENTRE = 0.5
"""The image coordinate of the centre of the first pixel, which is 0 in OpenCV."""

LEAST_BASELINE_M = 1e-4
"""The least distance of two devices, below which their lenses would be one."""


def camera_and_projector(path: Path, resolution: tuple[int, int], projector: tuple[int, int], unit_m: float, *,
                         second: str = "projector", extrinsics: Path | None = None) -> dict[str, Any]:
    """Return the camera and the projector of the manifest from an OpenCV calibration file.
    `second`: what stands in the place of the projector, for messages. `extrinsics`: file of R and T; None: the same."""
    found, posed = read_matrices(path), extrinsics or path
    pose_found = found if extrinsics is None else read_matrices(extrinsics)
    rotation = pick(pose_found, ROTATION, posed, "rotation R", shape=(3, 3))
    translation = pick(pose_found, TRANSLATION, posed, "translation T", shape=(3,)) * unit_m
    baseline_m = math.hypot(*translation)
    if baseline_m < LEAST_BASELINE_M:
        raise ManifestError(f"{posed}: T: the {second} stands {baseline_m:.2g} m from the camera: without a baseline there is no depth: "
                            "check T, and the unit of its numbers")
    pose = camera_from_projector(rotation, translation)
    entries = {}
    second_sizes = (PROJECTOR_SIZE,) if second == "projector" else ()  # a file of two cameras says the size of the first
    for entry, what, matrix, coefficients, sides, size in (
            ("camera", "camera", CAMERA_MATRIX, CAMERA_LENS, CAMERA_SIZE, resolution),
            ("projector", second, PROJECTOR_MATRIX, PROJECTOR_LENS, second_sizes, projector)):
        k = pick(found, matrix, path, f"matrix of the {what}", shape=(3, 3))
        check_size(path, what, found, sides, size)
        known = any(name in found for name in coefficients)
        glass = lens(pick(found, coefficients, path, "distortion"), path, what) if known else Distortion(model="brown_conrady")
        entries[entry] = {"resolution": list(size), "focal_px": [k[0, 0], k[1, 1]],
                          "principal_px": [k[0, 2] + PIXEL_CENTRE, k[1, 2] + PIXEL_CENTRE], "distortion": glass.model_dump()}
    return {"camera": {"projection": "perspective", **entries["camera"]},
            "projector": {**entries["projector"], "camera_from_projector": pose.tolist()}}


def projector_size(path: Path) -> tuple[int, int] | None:
    """Return the width and height of the projector in a calibration file; None where it does not say them."""
    return told_size(read_matrices(path), PROJECTOR_SIZE)


LINEAR: ColorSpaceName = "lin_rec709_scene"


@dataclass(frozen=True, kw_only=True)
class PatternImages:
    """Names that choose the frames of patterns in a folder, and the rig that took them."""

    projector: tuple[int, int]
    images: str | None = None
    """The names of the frames, as the shell matches them; None: every image but mask, white and black."""
    mask: str | None = None
    white: str | None = None
    black: str | None = None
    """The images of the mask and of even light; None: the one with that word in its name, if there is one."""
    calibration: Path | None = None
    """OpenCV file of camera and projector; None leaves them to `relit calibrate procam`."""
    unit_m: float = 1.0
    """The metres in one unit of the translation in `calibration`."""
    color_space: ColorSpaceName = LINEAR
    exposures_s: tuple[float, ...] | None = None
    """The exposure times at which every pattern was taken; None: one."""
    video: VideoFrames | None = None
    """The video that the images were unpacked from; None: they are photographs."""
    patterns_first: bool = False
    """True if all patterns were taken at one exposure before the next; else each pattern at all exposures."""

    def exposed(self, entries: Sequence[Entry]) -> list[tuple[Entry, float | None]]:
        """Return each image's pattern and exposure time, in the order of the images."""
        if self.exposures_s is None:
            return [(entry, None) for entry in entries]
        if self.patterns_first:
            return [(entry, time) for time in self.exposures_s for entry in entries]
        return [(entry, time) for entry in entries for time in self.exposures_s]


def import_gray(source: Path, destination: Path, *, pictures: PatternImages, gray: GrayStack) -> Imported:
    """Write a capture.json for a Gray code."""
    return _write(source, destination, pictures, gray.entries(pictures.projector), ())


def import_phase(source: Path, destination: Path, *, pictures: PatternImages, phase: PhaseStack, gray_images: str | None = None,
                 gray_stripe_px: float | None = None, gray: GrayStack | None = None, from_centre: bool = False) -> Imported:
    """Write a capture.json for phase shifts, with a Gray code that numbers their periods or without.

    Args:
        gray_images: the names of the images of a Gray code, as the shell matches them; None: there is none.
        gray_stripe_px: the width of its finest stripe in projector pixels.
        gray: how it was taken; its sequence and bits follow from the axes and the images.
        from_centre: whether the waves have column 0 at the centre of the first pixel. The coordinates of the capture are then 0.5 smaller
            than elsewhere, and the principal point of the projector with them.
    """
    extra: list[tuple[str, Entry]] = []
    if gray_images is not None:
        names = [name for name in image_names(source) if fnmatch(name, gray_images)]
        each, rest = divmod(len(names), len(phase.axes) * (1 if gray is None or gray.inverses == "none" else 2))
        if rest or not each:
            raise ManifestError(f"{source}: --gray-images {gray_images} names {len(names)} images, which is not equally many for each axis"
                                + (" and inverse" if gray is None or gray.inverses != "none" else ""))
        least = min((*phase.periods_px, *(phase.row_periods_px or ()))) if len(phase.periods_px) == 1 else math.inf
        if gray_stripe_px is not None and gray_stripe_px > least:
            raise ManifestError(f"--gray-stripe {gray_stripe_px:g}: stripes wider than the period of {least:g} px do not number its waves: "
                                "give the width of the finest stripe of the Gray code in projector pixels")
        entries: list[Entry] = []
        for axis in phase.axes:
            inverses, fine_first = ("none", False) if gray is None else (gray.inverses, gray.fine_first)
            of_axis = gray_entries(axis, 2**each, None, inverses=inverses, fine_first=fine_first)
            entries += [{**entry, "stripe_px": gray_stripe_px} for entry in of_axis]
        extra = list(zip(names, entries, strict=True))
    return _write(source, destination, pictures, phase.entries(), extra, shifted=from_centre)


def import_scanner(source: Path, destination: Path, *, calibration: Path, codec: str, axes: tuple[str, ...], unit_m: float,
                   projector: tuple[int, int] | None = None, images: str | None = None) -> Imported:
    """Write a capture.json for the images of a scanning program, with the calibration that it wrote.
    `codec`: one of CODECS. `unit_m`: the metres in one unit of the translation. `projector`: the width and height of the projector; None:
    as the calibration says."""
    size = projector or projector_size(calibration)
    if size is None:
        raise ManifestError(f"{calibration}: does not say how many pixels the projector has: give --projector")
    pictures = PatternImages(projector=size, images=images, calibration=calibration, unit_m=unit_m)
    return _write(source, destination, pictures, CODECS[codec](size, axes), (), shifted=codec in HALF_PIXEL)


def _slstudio_gray(projector: tuple[int, int], axes: tuple[str, ...]) -> list[Entry]:
    """SLStudio's CodecGrayCode: white, black, the coarsest ten bits of the columns, the coarsest six of the rows; no inverses."""
    parts = tuple(f"{axis}s" for axis in axes)
    bits = {"column": min(10, (projector[0] - 1).bit_length()), "row": min(6, (projector[1] - 1).bit_length())}
    return GrayStack(sequence=("white", "black", *parts), inverses="none", column_bits=bits["column"],
                     row_bits=bits["row"]).entries(projector)


def _slstudio_phase(projector: tuple[int, int], axes: tuple[str, ...], parts: tuple[int, ...], steps: int) -> list[Entry]:
    """Phases whose periods are the projector divided by whole numbers, those of an axis together."""
    entries: list[Entry] = []
    for axis in axes:
        size = projector[0] if axis == "column" else projector[1]
        entries += PhaseStack(axes=(axis,), periods_px=tuple(size / part for part in parts), steps=steps).entries()
    return entries


def _columns_alone(axes: tuple[str, ...]) -> None:
    """Refuse rows of codecs that project columns alone."""
    if axes != ("column",):
        raise ManifestError("--axis: SLStudio's micro and modulated patterns code columns alone")


SLSTUDIO_MICRO = (75.02, 70.0, 71.32, 72.47, 73.72, 76.23, 77.35, 78.4, 79.22, 80.0)
"""Periods of SLStudio's CodecPhaseShiftMicro in projector pixels, whatever the projector: three shifts of the first, one of each other."""


def _slstudio_micro(projector: tuple[int, int], axes: tuple[str, ...]) -> list[Entry]:
    """SLStudio's CodecPhaseShiftMicro: the first wave moves back from step to step, and every second of the others is inverted."""
    _columns_alone(axes)
    first, *others = SLSTUDIO_MICRO
    return [*PhaseStack(axes=axes, periods_px=(first,), steps=3, advancing=False).entries(),
            *({"code": "phase", "axis": "column", "period_px": period, "step": 0 if number % 2 else 2, "steps": 4}
              for number, period in enumerate(others))]


def _slstudio_modulated(projector: tuple[int, int], axes: tuple[str, ...]) -> list[Entry]:
    """SLStudio's CodecPhaseShiftModulated: three shifts of eight waves, each at three of sixteen waves across, then three of one wave."""
    _columns_alone(axes)
    width, height = projector
    return [*({"code": "modulated", "axis": "column", "period_px": width / 8, "step": step, "steps": 3, "carrier_period_px": height / 16,
               "carrier_step": carrier, "carrier_steps": 3} for step in range(3) for carrier in range(3)),
            *PhaseStack(axes=axes, periods_px=(float(width),), steps=3).entries()]


def _opencv_gray(projector: tuple[int, int], axes: tuple[str, ...]) -> list[Entry]:
    """OpenCV's GrayCodePattern, and the programs after it: pairs of the columns, pairs of the rows, white, black."""
    return GrayStack(sequence=(*(f"{axis}s" for axis in axes), "white", "black")).entries(projector)


CODECS: dict[str, Callable[[tuple[int, int], tuple[str, ...]], list[Entry]]] = {
    "opencv-gray": _opencv_gray,
    "slstudio-gray": _slstudio_gray,
    "slstudio-phase-2x3": lambda projector, axes: _slstudio_phase(projector, axes, (16, 1), 3),
    "slstudio-phase-3": lambda projector, axes: _slstudio_phase(projector, axes, (1,), 3),
    "slstudio-phase-4": lambda projector, axes: _slstudio_phase(projector, axes, (1,), 4),
    "slstudio-micro": _slstudio_micro,
    "slstudio-modulated": _slstudio_modulated,
}
"""The orders of scanning programs: of the projector's size and the axes, the patterns in the order of the images."""
HALF_PIXEL = ("slstudio-phase-2x3", "slstudio-phase-3", "slstudio-phase-4", "slstudio-micro", "slstudio-modulated")
"""Codecs whose waves have their phase 0 at the centre of the first pixel: their coordinates are 0.5 smaller than those of the manifest, as
those of their calibration are, whose principal point then stays as it is."""


def _write(source: Path, destination: Path, pictures: PatternImages, entries: list[Entry], extra: Sequence[tuple[str, Entry]], *,
           shifted: bool = False) -> Imported:
    """Write the capture of the images that the options name and of those of `extra`, which are paired with their patterns already."""
    names = image_names(source)
    mask = only_image(source, names, pictures.mask, MASK_WORDS, "mask")
    even: dict[str, str] = {}
    for code, given in (("white", pictures.white), ("black", pictures.black)):
        if not any(entry["code"] == code for entry in entries):
            name = only_image(source, names, given, frozenset({code}), code)
            even |= {} if name is None else {code: name}
        elif given is not None:
            raise ManifestError(f"--{code} {given}: {code} is in --sequence already: give one of both")
    taken = {mask, *even.values(), *(name for name, _ in extra)}
    frames = [name for name in names if name not in taken and (pictures.images is None or fnmatch(name, pictures.images))]
    exposed, times = pictures.exposed(entries), pictures.exposures_s
    if len(frames) != len(exposed):
        shown = f" ({frames[0]} to {frames[-1]})" if frames else ""
        at = "" if times is None else f" at {len(times)} exposures"
        raise ManifestError(f"{source}: has {len(frames)} images{shown} where these options have {len(entries)} patterns{at}: "
                            f"{describe(entries)}")
    beside = [*(name for name, _ in extra), *even.values()]
    if times is not None and beside:
        raise ManifestError(f"{source}: {beside[0]} was taken at one exposure, and --exposures-s says that every pattern was taken at "
                            f"{len(times)}: put white, black and the Gray code into the sequence")
    resolution = image_resolution(source / frames[0])
    data: dict[str, Any] = {"name": source.resolve().name, "color_space": pictures.color_space, "mask": mask,
                            "camera": {"projection": "orthographic", "resolution": list(resolution)},
                            "projector": {"resolution": list(pictures.projector)},
                            "assumed": [] if pictures.video is None else list(pictures.video.assumed)}
    if pictures.calibration is not None:
        data |= camera_and_projector(pictures.calibration, resolution, pictures.projector, pictures.unit_m)
        if shifted:
            data["projector"]["principal_px"] = [value - 0.5 for value in data["projector"]["principal_px"]]
    pairs = [*extra, *((name, {"code": code}) for code, name in even.items())]
    data["frames"] = [{"image": name, "pattern": pattern, **({} if time is None else {"exposure_s": time})}
                      for name, (pattern, time) in zip(frames, exposed, strict=True)]
    data["frames"] += [{"image": name, "pattern": pattern} for name, pattern in pairs]
    written = write_capture(data, pictures.calibration or source, destination, folder=source)
    facts = [("frames", f"{len(frames)} images in their order, {frames[0]} to {frames[-1]}"), ("patterns", describe(entries))]
    if pictures.video is not None:
        facts.insert(0, ("video", pictures.video.sentence))
    if times is not None:
        order = "all patterns at one of them before the next" if pictures.patterns_first else "each pattern at all of them"
        facts.append(("exposed", f"{', '.join(f'{time:g}' for time in times)} s, {order}"))
    if extra:
        facts.append(("Gray", f"{len(extra)} images in their order, {extra[0][0]} to {extra[-1][0]}: {describe([e for _, e in extra])}"))
    facts += [(code, name) for code, name in even.items()]
    facts += [("colour", f"{pictures.color_space}: --color-space says another"), ("mask", mask or "none: every pixel is taken"),
              *([("columns", "counted from the centre of the first one, as the waves are")] if shifted else []),
              ("rig", f"from {pictures.calibration}, in units of {pictures.unit_m:g} m" if pictures.calibration else
                      "not calibrated: relit calibrate procam measures it, or give --calibration")]
    return Imported(written, tuple(facts))

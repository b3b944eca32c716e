"""The manifest of a capture, capture.json with schema relit.capture/1, which is checked before any pixel is read."""

import posixpath
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from stage.capture.camera import Camera, OtherCamera, StereoImages
from stage.capture.light import Laser, Light, TimeOfFlight
from stage.capture.projector import AnyProjector, Projector
from stage.colour.colour_spaces import ColorSpaceName
from stage.files import write_text
from stage.model import FirstFault, Positive, Strict, Text, Vector
from stage.patterns.codes import Pattern
from stage.records import faults_of_each, read_record, record_text

SCHEMA = "relit.capture/1"
FILE_NAME = "capture.json"

LIT_BY = ("light", "pattern", "laser", "tof", "stereo")
"""The fields of a frame that say what lit it; every frame has exactly one."""
FileName = Text
"""The name of a file of the capture, relative to its folder."""

OFF_PART, SAME_PART = 0.2, 0.1
"""Parts of half a side by which the principal point of a calibration at another size lies off the middle, at least, and by which such a
part differs between the sides, at most."""

ColorMatrix = tuple[Vector, Vector, Vector]


def _invertible(rows: ColorMatrix) -> ColorMatrix:
    (a, b, c), (d, e, f), (g, h, i) = rows
    if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) == 0:
        raise ValueError("maps different colours to the same one: its determinant is 0")
    return rows


class Frame(Strict):
    """One image of a capture and what lit it: exactly one of a light, a pattern, a laser, a time-of-flight source, and texture that other
    cameras see too."""

    image: FileName
    """The image, a file of the folder that no other frame has; for `tof` it may be a NumPy array, .npy."""
    exposure_s: Positive | None = None
    """The exposure time, by which the readings are divided; give it for every frame or for none. None: all exposures are equal."""
    light: Light | None = None
    """The light, of one of the types below."""
    pattern: Pattern | None = None
    """The projected pattern, of one of the codes below."""
    laser: Laser | None = None
    """The laser ray or plane."""
    tof: TimeOfFlight | None = None
    """The time-of-flight source."""
    stereo: StereoImages | None = None
    """The images of other cameras at the same moment, under projected texture without a code."""
    color_matrix: Annotated[ColorMatrix, AfterValidator(_invertible)] | None = None
    """The matrix of this frame's light or polariser, in place of that of the capture. None: `color_matrix` of the capture."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        given = [name for name in LIT_BY if getattr(self, name) is not None]
        if len(given) != 1:
            what = " and ".join(given) or "nothing that lit it"
            raise ValueError(f"has {what}: give exactly one of {', '.join(LIT_BY)}")
        return self


class Manifest(Strict):
    """The content of capture.json."""

    schema_: Literal["relit.capture/1"] = Field(alias="schema")
    """The kind and version of the file."""
    name: Text
    """The name of the capture and of its asset."""
    color_space: ColorSpaceName = "lin_rec709_scene"
    """The colour space of the images: scene-linear, or display-encoded as `srgb_texture` for the 8-bit images of most cameras."""
    camera: Camera
    """The camera, which took all images from one place."""
    projector: AnyProjector | None = None
    """The projector of pattern frames; None: there is none, or nobody has measured anything of it."""
    other_cameras: tuple[OtherCamera, ...] = ()
    """Cameras beside the camera, which took the `stereo` images of frames; none for captures of one camera."""
    mask: FileName | None = None
    """An image whose first channel is above one half on the object; None: every pixel is object."""
    dark: FileName | None = None
    """A dark image at the exposure of the frames, which is subtracted; None: none."""
    flat: FileName | None = None
    """An image of an evenly lit white card, by which images are divided; None: none."""
    saturation: Positive | None = None
    """The recorded value from which readings are not used; integers count as fractions of full scale. None: the largest integer of
    frames of lights, phases and ramps alone."""
    color_matrix: Annotated[ColorMatrix, AfterValidator(_invertible)] | None = None
    """The matrix, by rows, from the linear colours of the images to those of `color_space`: white balance, and the colours of the sensor
    of a camera raw file, as `relit calibrate white-balance` measures it. None: the colours are used as they are."""
    exposure_from: Literal["exif"] | None = None
    """`exif` where the exposure time of every frame is the one that EXIF in its file says. None: `exposure_s` of the frames."""
    irradiance_scale: Literal["absolute", "relative"] = "absolute"
    """`relative` where the irradiance (and intensity and radiance) of all lights lacks one common factor, and albedo with it."""
    polarizer_leak: Annotated[float, Field(ge=0, lt=0.5)] | None = None
    """The part of a highlight's light that `cross` frames still show, over what `cross` and `parallel` frames show of it together. None: 0,
    ideal polarisers."""
    assumed: Annotated[tuple[Text, ...], FirstFault] = ()
    """Assumptions of the import that the files do not confirm, as sentences, which `relit info` and the reports repeat. Take a
    sentence out once it is checked."""
    frames: Annotated[tuple[Frame, ...], Field(min_length=1), FirstFault]
    """The images, in the order in which they were taken if the subject moves."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        fault = next(_between_frames([frame.image for frame in self.frames], [frame.exposure_s is not None for frame in self.frames]), None)
        if fault is None:
            fault = next(self._stereo_faults(), None)
        if fault is not None:
            raise ValueError(fault)
        if self.exposure_from is not None and self.frames[0].exposure_s is not None:
            raise ValueError("exposure_from: is given beside frames[0].exposure_s: give one of them")
        return self

    def with_colors(self, matrix: ColorMatrix | None, own: Mapping[int, ColorMatrix] | None = None) -> Self:
        """Return the manifest with a matrix, and with those of frames, by their index, that have one of their own."""
        frames = tuple(frame.model_copy(update={"color_matrix": (own or {}).get(index)}) for index, frame in enumerate(self.frames))
        return self.model_copy(update={"color_matrix": matrix, "frames": frames})

    def _stereo_faults(self) -> Iterator[str]:
        """Yield what does not agree between the frames under texture and the other cameras."""
        names = [camera.name for camera in self.other_cameras]
        for index, name in enumerate(names):
            if name in names[:index]:
                yield f"other_cameras[{index}].name: {name} is already the name of other_cameras[{names.index(name)}]"
        taken = {posixpath.normpath(frame.image): f"frames[{index}]" for index, frame in enumerate(self.frames)}
        for index, frame in enumerate(self.frames):
            if frame.stereo is None:
                continue
            if len(frame.stereo.images) != len(self.other_cameras):
                yield (f"frames[{index}].stereo.images: has {len(frame.stereo.images)} images, other_cameras has {len(self.other_cameras)} "
                       "cameras: give the image of each, in their order")
            for image in frame.stereo.images:
                if taken.setdefault(posixpath.normpath(image), f"frames[{index}].stereo") != f"frames[{index}].stereo" or \
                        frame.stereo.images.count(image) > 1:
                    yield f"frames[{index}].stereo.images: {image} is already the image of {taken[posixpath.normpath(image)]}"


def other_sizes(manifest: Manifest) -> Iterator[str]:
    """Yield a sentence for each device whose calibration looks like one at another size of images: its principal point lies off the middle
    by the same part of both sides, which that of a part of an image or of a shifted lens hardly ever does."""
    devices: list[tuple[str, Camera | Projector | OtherCamera]] = [("camera", manifest.camera)]
    devices += [("projector", manifest.projector)] if isinstance(manifest.projector, Projector) else []
    devices += [(f"other_cameras[{index}]", other) for index, other in enumerate(manifest.other_cameras)]
    for field, device in devices:
        if device.focal_px is None or device.principal_px is None:
            continue
        across, down = (2 * place / side for place, side in zip(device.principal_px, device.resolution, strict=True))
        part, (width, height) = (across + down) / 2, device.resolution
        if part > 0 and abs(part - 1) > OFF_PART and abs(across - down) < SAME_PART * part:
            yield (f"{field}.principal_px: the calibration is of images of {width}x{height} px, though its principal point would be in the "
                   f"middle of {part * width:.0f}x{part * height:.0f}: if it was made at that size, multiply focal_px and principal_px by "
                   f"{1 / part:.3g}")


def read_manifest(path: str | Path) -> Manifest:
    """Read and check a capture.json."""
    return read_record(path, Manifest, _frame_faults)


def write_manifest(manifest: Manifest, path: str | Path) -> None:
    """Write a capture.json whole or not at all."""
    write_text(path, manifest_text(manifest))


def manifest_text(manifest: Manifest) -> str:
    """Return the content of a capture.json, with `color_space` always and other keys when they differ from their default."""
    return record_text(manifest, "frames", color_space=manifest.color_space)


def _frame_faults(data: dict[str, Any]) -> Iterator[str]:
    """Yield the faults of every frame of a capture.json whose content is wrong, as sentences without the file."""
    frames = data.get("frames")
    if not isinstance(frames, list):
        return
    yield from faults_of_each(data, "frames", Frame)
    given = [frame if isinstance(frame, dict) else {} for frame in frames]
    yield from _between_frames([frame.get("image") for frame in given], [frame.get("exposure_s") is not None for frame in given])


def _between_frames(names: Sequence[Any], timed: Sequence[bool]) -> Iterator[str]:
    """Yield the faults that frames have together: an image of two frames, and an exposure that some lack."""
    first: dict[str, int] = {}
    for index, image in enumerate(names):
        if not isinstance(image, str):
            continue
        name = posixpath.normpath(image)
        if name in first:
            yield f"frames[{index}].image: {image} is already the image of frames[{first[name]}]"
        else:
            first[name] = index
    if any(timed) and not all(timed):
        yield f"frames[{timed.index(False)}].exposure_s: is missing: give it for every frame or for none"

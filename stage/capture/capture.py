"""A capture folder: its manifest, and the checks of the files that the manifest names."""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from stage.capture.camera import Camera
from stage.capture.light import DistantLight, EnvironmentLight, ExtendedLight, FullLight, GradientLight, Light, OffLight, PointLight
from stage.capture.manifest import FILE_NAME, LIT_BY, Frame, Manifest, other_sizes, read_manifest
from stage.colour import radiance as radiances
from stage.colour.colour_spaces import NAMES, is_linear
from stage.errors import MOST_FAULTS, ImageError, ManifestError, ResultError, StageError, listed, storage
from stage.folders import advice
from stage.formats import images
from stage.formats.camera_raw import path_is_raw
from stage.formats.exif import Exposure, check_agreement, exposure_times, multiplied_otherwise, unused_exposures
from stage.formats.images import ImageHeader
from stage.pixels import AS_RECORDED, Crop, PixelChoices

SOURCES = (DistantLight, PointLight, ExtendedLight, GradientLight)
"""The types of light whose frames are measurements, from which surfaces are solved and images are relit."""

SQUARE = 0.01
"""The largest difference of a ratio of pixels' sides from that of the camera: anamorphic lenses squeeze by 1.25 and more."""

HEADER_THREADS = 8
"""The number of threads that read file headers while a capture is opened."""

LightKind = TypeVar("LightKind", DistantLight, PointLight, ExtendedLight, GradientLight, EnvironmentLight, OffLight, FullLight)


def source_places(lights: Sequence[Light | None]) -> list[int]:
    """Return the places, in the frames of a capture, of those whose light is a measurement, as `Capture.sources` has them."""
    kinds = (*SOURCES, FullLight) if any(isinstance(light, GradientLight) for light in lights) else SOURCES
    return [index for index, light in enumerate(lights) if isinstance(light, kinds)]


def check_same_pixels(path: Path, camera: Camera, capture: "Capture") -> None:
    """Check that results have the pixels of a capture."""
    if camera.resolution != capture.camera.resolution:
        theirs, ours = ("x".join(map(str, each.resolution)) for each in (camera, capture.camera))
        raise ResultError(f"{path}: is {theirs}, the capture {ours}: these are not its maps (--crop gives the part of the images that was "
                          "solved)")
    if capture.whole is not None and camera.principal_point != capture.camera.principal_point:
        raise ResultError(f"{path}: is of another part of the images than --crop {capture.pixels.crop}")


@dataclass(frozen=True)
class Capture:
    """A folder of images that one camera took from one position, with its manifest."""

    folder: Path
    manifest: Manifest
    pixels: PixelChoices = AS_RECORDED
    """How the pixels of the images are read."""
    whole: "Capture | None" = None
    """The capture with its whole images, of which this one is a part; None: it is no part."""
    clipped: dict[str, int] = field(default_factory=dict, compare=False)
    """The number of pixels in which a value was set to 0, by the names of the images that were read so far."""

    doubts: tuple[str, ...] = ()
    """A sentence for each thing that the files say and the manifest does not heed, and for each that an import assumed."""

    @classmethod
    def open(cls, path: str | Path, pixels: PixelChoices = AS_RECORDED) -> "Capture":
        """Open a capture, and check its manifest and the header of every file.
        `path`: the folder, or the capture.json in it. `pixels`: how the pixels of the images are read; with a crop, the camera and all
        images are those of the part. Raises ManifestError if the manifest is wrong, or the crop leads out of the images; the message names
        the field. Raises ImageError if a file has the wrong size or is no image; the message names the file."""
        given = Path(path)
        folder = given.parent if given.name == FILE_NAME else given
        with storage("read", folder):
            if not folder.is_dir():
                raise ManifestError(f"{folder}: there is no such folder")
            if not (folder / FILE_NAME).exists():
                steps = sorted(folder.glob(f"*/{FILE_NAME}"))
                advised = advice(folder, "see `relit import` for data laid out another way" if not steps else
                                 f"its folders do, such as {steps[0].parent}: name one; `relit solve`, `relit depth` and `relit relight` "
                                 "take all of them as a sequence")
                raise ManifestError(f"{folder}: holds no {FILE_NAME}: {advised}")
        capture = cls(folder, read_manifest(folder / FILE_NAME), pixels)
        headers = capture._check_files()
        capture = capture._exposed(headers)
        capture = replace(capture, doubts=(*capture.doubts, *capture._other_spaces(headers), *capture._other_encodings(headers),
                                           *capture._other_pixels(headers), *capture._other_depths(headers),
                                           *capture._without_colours(headers), *other_sizes(capture.manifest), *capture.manifest.assumed))
        return capture if pixels.crop is None else capture._part(pixels.crop)

    @property
    def camera(self) -> Camera:
        """The camera of the manifest."""
        return self.manifest.camera

    @property
    def image_resolution(self) -> tuple[int, int]:
        """The width and height of the image files, of which the camera may see a part."""
        return (self.whole or self).camera.resolution

    @property
    def name(self) -> str:
        """The name of the capture."""
        return self.manifest.name

    def file(self, name: str) -> Path:
        """Return the path of a file that the manifest names, which always lies inside the folder.
        Raises ManifestError if the name leads out of the folder."""
        if Path(name).is_absolute() or ".." in Path(name).parts or "\0" in name:
            raise ManifestError(f"{self.folder / FILE_NAME}: {name} leads out of the capture's folder")
        return self.folder / name

    def at_distance(self, surface_z_m: float) -> "Capture":
        """Return the capture with the place of its surface, the mean camera-frame z in metres."""
        camera = self.manifest.camera.model_copy(update={"surface_z_m": surface_z_m})
        return replace(self, manifest=self.manifest.model_copy(update={"camera": camera}),
                       whole=None if self.whole is None else self.whole.at_distance(surface_z_m))

    def with_brighter_lights(self, factor: float) -> "Capture":
        """Return the capture with the irradiance, intensity or radiance of every light times a factor, for maps whose albedo is smaller by
        it; gradients and environments, which have a radiance of their own, stay."""
        if factor == 1:
            return self

        def times(values: tuple[float, ...]) -> tuple[float, ...]:
            return tuple(factor * value for value in values)

        def brighter(frame: Frame) -> Frame:
            light = frame.light
            if isinstance(light, DistantLight):
                return frame.model_copy(update={"light": light.model_copy(update={"irradiance": times(light.irradiance)})})
            if isinstance(light, PointLight):
                return frame.model_copy(update={"light": light.model_copy(update={"intensity": times(light.intensity)})})
            if isinstance(light, ExtendedLight):
                return frame.model_copy(update={"light": light.model_copy(update={"radiance": tuple(map(times, light.radiance))})})
            return frame

        return replace(self, manifest=self.manifest.model_copy(update={"frames": tuple(map(brighter, self.manifest.frames))}),
                       whole=None if self.whole is None else self.whole.with_brighter_lights(factor))

    def lit_by(self, *kinds: type[LightKind]) -> list[tuple[Frame, LightKind]]:
        """Return the frames whose light is of one of these types, each with its light, in manifest order."""
        return [(frame, frame.light) for frame in self.manifest.frames if isinstance(frame.light, kinds)]

    def sources(self) -> list[Frame]:
        """Return the frames whose light is a measurement: neither ambient light, nor a tracking frame, nor an environment.

        In a capture with gradient frames a `full` frame is a measurement too, because gradient frames are compared with it.
        """
        frames = self.manifest.frames
        return [frames[index] for index in source_places([frame.light for frame in frames])]

    def none_is_lit(self, by: str) -> str:
        """Return the sentence for a capture without a frame that is lit `by` what is asked for; it names the command for other frames."""
        kinds = [kind for kind in LIT_BY if kind != "light" and any(getattr(frame, kind) is not None for frame in self.manifest.frames)]
        other = f": frames with {' and '.join(kinds)} are for relit depth" if kinds else ""
        return f"{self.folder / FILE_NAME}: frames: none is lit by {by}{other}"

    @property
    def is_polarised(self) -> bool:
        """Return whether distant or point lights have cross- and parallel-polarised frames."""
        return any(isinstance(frame.light, DistantLight | PointLight) and frame.light.polarization != "none"
                   for frame in self.manifest.frames)

    def recorded(self, name: str, *, keep_half: bool = False) -> np.ndarray:
        """Read the recorded values of an image that holds radiance, in the part of it that the capture is about.
        `keep_half`: True to leave half values as the file has them, too. Returns [rows, cols, 3] uint8 or uint16 as the file has them, or
        float32; values below 0 are noise. Raises ImageError if a value is NaN, infinite, or negative beyond the noise of the image and not
        to be clipped."""
        return self.part_of(self.recorded_whole(name, keep_half=keep_half))

    def recorded_whole(self, name: str, *, keep_half: bool = False) -> np.ndarray:
        """Read the recorded values of a whole image that holds radiance, of any size, as those of other cameras have: [rows, cols, 3] as
        `recorded`."""
        path = self.file(name)
        pixels = images.read_recorded(path)
        if pixels.dtype.kind == "u":
            return pixels
        if self.pixels.clip_negative:
            radiances.check_finite(path, pixels)
            pixels, count = radiances.clip_negative(pixels)
            if count:
                self.clipped[name] = count
        else:
            radiances.check_radiance(path, pixels, remedy=radiances.CLIP_NEGATIVE, stray=radiances.RAW_STRAY if path_is_raw(path) else 0.0)
        return pixels if keep_half and pixels.dtype == np.float16 else pixels.astype(np.float32, copy=False)

    def part_of(self, image: np.ndarray) -> np.ndarray:
        """Return the part of a whole image, [rows, cols, ...], that the capture is about."""
        return image if self.pixels.crop is None else np.ascontiguousarray(self.pixels.crop.of(image))

    def mask(self) -> np.ndarray:
        """Read the mask of the object: [rows, cols] bool, True on the object; all True when the manifest names no mask."""
        if self.manifest.mask is None:
            return np.ones((self.camera.height, self.camera.width), dtype=bool)
        return images.read_mask(self.file(self.manifest.mask), self.image_resolution, self.pixels.crop)

    def mask_values(self) -> np.ndarray:
        """Read the mask of the object with its partial values: [rows, cols] float32, 0…1, how much of each pixel is the object; all 1 when
        the manifest names no mask."""
        if self.manifest.mask is None:
            return np.ones((self.camera.height, self.camera.width), dtype=np.float32)
        return self.part_of(images.read_mask_values(self.file(self.manifest.mask), self.image_resolution))

    def files(self) -> Iterator[tuple[str, str]]:
        """Yield the manifest field and the name of every file that the manifest names."""
        for key in ("mask", "dark", "flat"):
            name = getattr(self.manifest, key)
            if name is not None:
                yield key, name
        for index, frame in enumerate(self.manifest.frames):
            yield f"frames[{index}].image", frame.image
            if isinstance(frame.light, EnvironmentLight):
                yield f"frames[{index}].light.image", frame.light.image
            for number, name in enumerate(() if frame.stereo is None else frame.stereo.images):
                yield f"frames[{index}].stereo.images[{number}]", name

    def _part(self, crop: Crop) -> "Capture":
        """Return the part of the capture inside a rectangle of its images."""
        width, height = self.camera.resolution
        if not crop.is_within((width, height)):
            raise ManifestError(f"--crop {crop}: leads out of the images of {self.folder}, which are {width}x{height}: "
                                "give the first column, the first row, the width and the height")
        return replace(self, manifest=self.manifest.model_copy(update={"camera": self.camera.cropped(crop)}),
                       whole=replace(self, pixels=self.pixels._replace(crop=None)))

    def _exposed(self, headers: Mapping[str, ImageHeader]) -> "Capture":
        """Return the capture with the exposure times that its files hold, where the manifest asks for them."""
        exposures = {frame.image: headers[frame.image].exposure if frame.image in headers else Exposure() for frame in self.manifest.frames}
        if self.manifest.exposure_from is not None:
            times = exposure_times(str(self.folder / FILE_NAME), exposures)
            frames = tuple(frame.model_copy(update={"exposure_s": times[frame.image]}) for frame in self.manifest.frames)
            return replace(self, manifest=self.manifest.model_copy(update={"frames": frames, "exposure_from": None}))
        timed = any(frame.exposure_s is not None for frame in self.manifest.frames)
        multipliers = {frame.image: headers[frame.image].multiplied for frame in self.manifest.frames if frame.image in headers}
        return self if timed else replace(self, doubts=(*unused_exposures(exposures), *multiplied_otherwise(multipliers)))

    def _other_spaces(self, headers: Mapping[str, ImageHeader]) -> list[str]:
        """Return a sentence where images declare another colour space than the manifest has, of which they are linear."""
        space = self.manifest.color_space
        known = space in NAMES and is_linear(space)
        others = sorted(name for name, header in headers.items() if header.space in NAMES and header.space != space) if known else []
        default = "" if "color_space" in self.manifest.model_fields_set else " by default"
        return [f"color_space: {space} is declared{default}, and {headers[others[0]].space} by {len(others)} of the {len(headers)} images, "
                f"{others[0]} the first of them: they are read as {space}; declare the space that they have"] if others else []

    def _other_encodings(self, headers: Mapping[str, ImageHeader]) -> list[str]:
        """Return a sentence where Radiance headers say what the colour space of the manifest does not."""
        space = self.manifest.color_space
        others = sorted(name for name, header in headers.items() if header.encoding) if space == "lin_rec709_scene" else []
        return [f"{others[0]}: its header says {headers[others[0]].encoding}, and so do those of {len(others)} of {len(headers)} images: "
                f"it is not heeded, and values are read as {space}; declare the color_space that they have"] if others else []

    def _other_pixels(self, headers: Mapping[str, ImageHeader]) -> list[str]:
        """Return a sentence where images declare pixels of another shape than the camera has."""
        focal_x, focal_y = self.camera.focal_px or (1.0, 1.0)
        others = sorted(name for name, header in headers.items() if abs(header.pixel_aspect * focal_x / focal_y - 1) > SQUARE)
        return [f"pixelAspectRatio: is {headers[others[0]].pixel_aspect:.4g} in {len(others)} of the {len(headers)} images, {others[0]} "
                f"the first of them, and {focal_y / focal_x:.4g} of the camera (focal_px): images are read by the camera; scale them to "
                "square pixels, or declare focal_px"] if others else []

    def _other_depths(self, headers: Mapping[str, ImageHeader]) -> list[str]:
        """Return a sentence where images of eight bits, which mostly are sRGB, lie among others, which mostly are linear."""
        few = sorted(name for name, header in headers.items() if header.eight_bits)
        return [f"frames[].image: {len(few)} of the {len(headers)} images, {few[0]} the first of them, have 8 bits and the others more, as "
                f"where previews lie beside their originals: all are read as {self.manifest.color_space}; give images of one kind"
                ] if 0 < len(few) < len(headers) else []

    def _without_colours(self, headers: Mapping[str, ImageHeader]) -> list[str]:
        """Return a sentence where some images are grey and others have colours."""
        grey = sorted(name for name, header in headers.items() if header.channels == 1)
        return [f"frames[].image: {len(grey)} of the {len(headers)} images, {grey[0]} the first of them, are grey and the others have "
                "colours, whose weights in grey nobody knows: give images of one kind"] if 0 < len(grey) < len(headers) else []

    def _check_files(self) -> dict[str, ImageHeader]:
        """Check the header of every file, and return those of frames by the names of their images."""
        frames = {f"frames[{index}].image" for index in range(len(self.manifest.frames))}
        headers: dict[str, ImageHeader] = {}
        others = {f"frames[{index}].stereo.images[{number}]": (camera.resolution, f"other_cameras[{number}].resolution")
                  for index, frame in enumerate(self.manifest.frames) if frame.stereo is not None
                  for number, camera in enumerate(self.manifest.other_cameras)}
        arrays = {f"frames[{index}].image" for index, frame in enumerate(self.manifest.frames) if frame.tof is not None}

        def fault(item: tuple[str, str]) -> StageError | None:
            field, name = item
            try:
                path = self.file(name)
                with storage("read", path):
                    if not path.exists():
                        return ManifestError(f"{self.folder / FILE_NAME}: {field}: {name} is not in the folder")
                if field in arrays and path.suffix.lower() == ".npy":
                    return None  # time-of-flight arrays: checked by their own reader
                if field.endswith(".light.image"):
                    images.read_header(path)  # an environment has a size of its own
                else:
                    resolution, declared = others.get(field, (self.camera.resolution, "camera.resolution"))
                    header = images.check_resolution(path, resolution, declared=declared)
                    if field != "mask" and path_is_raw(path) and not is_linear(self.manifest.color_space):
                        return ManifestError(f"{self.folder / FILE_NAME}: color_space: {self.manifest.color_space} is encoded for "
                                             f"displays, and {name} is camera raw, which is linear: give lin_rec709_scene")
                    if field in frames:
                        headers[name] = header
            except StageError as error:
                return error
            return None

        with ThreadPoolExecutor(HEADER_THREADS) as pool:
            errors = [error for error in pool.map(fault, self.files()) if error is not None]
        if len(errors) == 1:
            raise errors[0]
        if errors:
            kind = ImageError if all(isinstance(error, ImageError) for error in errors) else ManifestError
            raise kind(*listed(map(str, errors), f"{self.folder}: has {len(errors) - MOST_FAULTS} faults more"))
        check_agreement(str(self.folder / FILE_NAME), {frame.image: headers[frame.image].orientation for frame in self.manifest.frames
                                                       if frame.image in headers})
        return headers

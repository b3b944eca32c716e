"""Inspection of a capture for relit info: its facts, and every fault of it; every frame is decoded and checked."""

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels.photometric.model.samples import evenly
from service.light_estimation.dark_lights import dark_lights, dark_sentence
from service.light_estimation.declared_lights import explanation_sentence, facing_sentence
from service.light_estimation.explanations import MIN_LIGHTS, PIXELS, Sample, better_explanation, fit_manifest, grey_readings
from service.light_estimation.lambertian import Fit, Suspect, suspects
from service.light_estimation.light_axes import Grid, axes_sentence
from service.reporting.progress import Progress, Timings
from service.requests.captures import InfoRequest
from stage.capture.capture import Capture
from stage.capture.gradients import gradient_frames, has_gradients
from stage.capture.light import DistantLight, PointLight
from stage.capture.lighting import MEASURED_BY, check_solvable, has_placeholders, lights_from_centre
from stage.capture.manifest import FILE_NAME, Frame
from stage.capture.point_lights import PlacedLights, distance_is_missing, place_lights
from stage.capture.projector import Projector
from stage.colour.colour_spaces import Review, linear_space
from stage.colour.configuration import current
from stage.colour.radiance import clipping_sentences
from stage.errors import StageError, StorageError
from stage.formats import images
from stage.formats.exif import TURNS, UPRIGHT
from stage.stack.correction import Correction, any_from, saturation_limit
from stage.stack.peaks import Peaks
from stage.stack.readings import said_by_readings
from stage.tof.raw_frames import check_frames, read_frame
from stage.transforms import fibonacci_sphere

MOST_NAMED = 6
"""The most lights that a sentence names."""


class Findings(NamedTuple):
    """Contradictions between the images and the manifest."""

    sentences: list[str]
    suspects: dict[str, float]
    """The misfit of each light that disagrees with the others, by its image, worst first."""


FAR_UNKNOWN = "camera.surface_z_m is missing: relit solve estimates how far the surface is"
"""The remark about near lights whose distance to the surface nobody has measured."""
READINGS = 3
"""The least count of lights that a normal must face to be measured."""
NORMALS = 2000
"""The directions on the visible hemisphere at which lights are counted: shares are then good to a tenth of a per cent."""


class Inspection(NamedTuple):
    """Facts of a capture by name, and sentences about its faults; a capture without faults can be solved."""

    facts: list[tuple[str, str]]
    faults: list[str]
    findings: list[str]
    """Sentences about what explains the images better than the manifest; nothing is changed by them."""


class _FrameLevel(NamedTuple):
    lowest: float
    peak: float
    saturated: int
    fault: str | None
    picked: np.ndarray | None = None  # [n, 3] float32, values at some pixels
    unread: int = 0
    """Readings of a time-of-flight frame that are not finite."""


def inspect(request: InfoRequest, progress: Progress | None = None) -> Inspection:
    """Decode and check every frame of a capture."""
    request.require_picture(picture=request.picture)
    timings = Timings(progress)
    timings.stage("open", 1)
    capture = Capture.open(request.capture, request.pixels)
    frames = capture.manifest.frames
    timings.stage("frames", len(frames))
    levels = []
    looked = pixels_to_look_at(capture)
    positions = None if looked is None else looked.chosen
    peaks = Peaks(capture)
    with ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="relit-inspect") as pool:
        for level in pool.map(lambda frame: _level(capture, frame, positions, peaks), frames):
            levels.append(level)
            timings.advance(len(levels))
    faults = [level.fault for level in levels if level.fault is not None]
    faults += standing_faults(capture, readable=not faults)
    facts = list(_facts(capture))
    read = [level for level in levels if level.fault is None]
    if read:
        lowest, peak = min(level.lowest for level in read), max(level.peak for level in read)
        of_both_signs = lowest < 0 and any(frame.tof is not None for frame in frames)
        facts.append(("recorded", f"{lowest:.4g} to {peak:.4g}: correlation images have both signs") if of_both_signs else
                     ("brightest", f"{peak:.4g} recorded"))
    if unread := sum(level.unread for level in read):
        facts.append(("not finite", f"{unread} readings, which count as saturated"))
    if capture.manifest.saturation is not None:
        count = sum(level.saturated for level in levels)
        facts.append(("saturated", f"{count} readings at or above {capture.manifest.saturation:g}"))
    facts += [("clipped", sentence) for sentence in clipping_sentences(capture.clipped)]
    with suppress(StageError):
        mask = capture.mask()
        facts.append(("mask", f"{int(mask.sum())} of {mask.size} pixels"))
    if capture.lit_by(PointLight):
        with suppress(StageError):
            facts.append(("near lights", FAR_UNKNOWN if distance_is_missing(capture) else _near_lights(place_lights(capture))))
    found = Findings([], {})
    if looked is not None and not faults:
        found = findings(capture, looked, {frame.image: level.picked for frame, level in zip(frames, levels, strict=True)
                                           if level.picked is not None})
    looks = [*capture.doubts, *found.sentences]
    looks += [] if faults else said_by_readings(capture, peaks)
    if request.picture is not None:
        peak = max((level.peak for level in read), default=1.0)
        facts.append(("picture", _picture(request.picture, capture, peak, found.suspects, request.review, timings)))
    timings.close()
    return Inspection(facts, faults, looks)


def _picture(path: Path, capture: Capture, peak: float, suspects: Mapping[str, float], review: Review, timings: Timings) -> str:
    """Write the picture of a capture, and return its path, or why there is none."""
    from service.captures.capture_picture import write_picture
    from service.relight.outputs import check_outputs

    check_outputs([(f"--picture {path}", path)], (capture.folder / FILE_NAME, *(capture.file(name) for _, name in capture.files())))
    timings.stage("picture", len(capture.manifest.frames))
    try:
        write_picture(path, capture, peak, suspects, review, timings.advance)
    except StorageError:
        raise
    except StageError as error:  # of the mask, or the dark, flat or ambient frames
        timings.advance(len(capture.manifest.frames))
        return f"none: {error}"
    return str(path)


def standing_faults(capture: Capture, *, readable: bool = True) -> list[str]:
    """Return what is wrong with a capture beside its frames: lights that determine no normal, the mask, the dark and flat frames.

    If not all frames are readable, dark and flat frames are not looked at, because they are read with the ambient frames.
    """
    faults = []
    try:
        if any(frame.tof is not None for frame in capture.manifest.frames):
            check_frames(capture)
        if capture.sources() and not has_placeholders(capture):
            if has_gradients(capture):
                gradient_frames(capture)
            elif not distance_is_missing(capture):  # else a solve says what it finds
                check_solvable(capture)
    except StageError as error:
        faults.append(str(error))
    try:
        capture.mask()
    except StageError as error:
        faults.append(str(error))
    if readable and not faults:
        try:
            Correction.of(capture)
        except StageError as error:
            faults.append(str(error))
    return faults


def _facts(capture: Capture) -> Iterator[tuple[str, str]]:
    manifest, camera = capture.manifest, capture.camera
    yield "name", capture.name
    yield "folder", str(capture.folder)
    measured = isinstance(manifest.projector, Projector) or any(frame.laser or frame.tof or frame.stereo for frame in manifest.frames)
    unit = "depths in metres" if measured else "no scale"
    scale = f"{camera.pixel_size_m:g} m a pixel" if camera.pixel_size_m else "metric" if camera.metric else unit
    yield "camera", f"{camera.projection}, {camera.width}x{camera.height}, {scale}"
    working = linear_space(manifest.color_space)
    yield "colour", manifest.color_space + ("" if working == manifest.color_space else f", worked on in {working}")
    yield "colours of", f"{current().label}, cache id {current().cache_id}"
    with suppress(StageError):
        orientation = images.read_header(capture.file(manifest.frames[0].image)).orientation
        if orientation != UPRIGHT:
            yield "orientation", f"{TURNS[orientation].words}, as EXIF orientation {orientation} of every frame says"
    yield "frames", ", ".join(f"{count} {kind}" for kind, count in Counter(map(_kind, manifest.frames)).items())
    given = [name for name in ("dark", "flat", "mask", "saturation", "projector") if getattr(manifest, name) is not None]
    if manifest.frames[0].exposure_s is not None:
        given.append("exposure_s")
    yield "given", ", ".join(given) or "nothing beside the frames"
    if manifest.projector is not None:
        calibration = "calibrated" if isinstance(manifest.projector, Projector) else "not calibrated: see relit calibrate procam"
        yield "projector", "{}x{}, {}".format(*manifest.projector.resolution, calibration)
    directions = np.array([light.direction for _, light in capture.lit_by(DistantLight)])
    if has_placeholders(capture):
        yield "lights", f"{len(directions)} placeholders: {MEASURED_BY}"
    elif len(directions):
        behind = int((directions[:, 2] < 0).sum())
        widest = np.degrees(np.arccos(np.clip(directions[:, 2].min(), -1, 1)))
        yield "lights", f"{len(directions)} distant, up to {widest:.0f} degrees from the view axis, {behind} behind the object"
        yield "irradiance", manifest.irradiance_scale
    with suppress(StageError):
        if not has_placeholders(capture) and (front := front_lights(lights_from_centre(capture).direction)) is not None:
            yield "not seen", front.sentence()


def _near_lights(lights: PlacedLights) -> str:
    near = lights.place[:, 3] == 1
    distance = np.linalg.norm(lights.place[near, :3] - lights.centre, axis=1)
    return f"{int(near.sum())}, {distance.min():.3g} to {distance.max():.3g} m from the object's centre"


def _kind(frame: Frame) -> str:
    if frame.light is not None:
        return f"{frame.light.type} light"
    if frame.pattern is not None:
        return f"{frame.pattern.code} pattern"
    if frame.stereo is not None:
        return "texture seen by several cameras"
    return f"{frame.laser.type} laser" if frame.laser is not None else "time of flight"


def _level(capture: Capture, frame: Frame, positions: np.ndarray | None, peaks: Peaks) -> _FrameLevel:
    """Return the lowest and the brightest value and the saturated readings of one frame, or its fault."""
    try:
        if frame.tof is not None:
            return _level_of_times(capture, frame)
        recorded = capture.recorded(frame.image, keep_half=True)
    except StageError as error:
        return _FrameLevel(0.0, 0.0, 0, str(error))
    peaks.note(frame.image, recorded)
    limit = capture.manifest.saturation
    saturated = 0 if limit is None else int(any_from(limit, recorded).sum())
    some = recorded[np.unravel_index(np.zeros(0, int) if positions is None else positions, recorded.shape[:2])]
    lowest, peak, picked = (images.fractions(recorded.dtype)[values] if recorded.dtype.kind == "u" else values.astype(np.float32)
                            for values in (recorded.min(), recorded.max(), some))
    return _FrameLevel(float(lowest), float(peak), saturated, None, None if positions is None else picked)


def _level_of_times(capture: Capture, frame: Frame) -> _FrameLevel:
    """Return the same of a time-of-flight frame, some of whose readings need not be finite."""
    pixels, limit = read_frame(capture, frame), capture.manifest.saturation
    finite = np.isfinite(pixels)
    if not finite.any():
        return _FrameLevel(0.0, 0.0, 0, f"{capture.file(frame.image)}: no reading is finite")
    return _FrameLevel(float(pixels.min(where=finite, initial=np.inf)), float(pixels.max(where=finite, initial=-np.inf)),
                       0 if limit is None else int((pixels >= limit).sum()), None, None, int(finite.size - finite.sum()))


class FrontLights(NamedTuple):
    """The directions that lights reach which all stand in front of the object: no slopes, sides and back.

    A surface shows the highlight of a light when its normal lies half way between the light and the view. Lights within an angle of the
    view axis show highlights on normals within half of it.
    """

    widest_deg: float
    """The largest angle of a light from the view axis."""
    highlight_deg: float
    """The largest angle from the view axis of a normal that shows the highlight of a light."""
    elsewhere: float
    """The share of all directions, of those around the object, that are farther from the view axis than every light."""
    dark: float
    """The share of the normals that a camera can see which face fewer than three lights."""

    def sentence(self) -> str:
        """Return what the capture cannot show, for a person who looks at it."""
        text = (f"all lights are within {self.widest_deg:.0f} degrees of the view axis: surfaces turned more than {self.highlight_deg:.0f} "
                "degrees from the camera show no highlight, so that roughness and specular say little there; in relit frames the nearest "
                f"lights stand in for light from elsewhere, {100 * self.elsewhere:.0f} % of all directions")
        if self.dark >= 0.005:
            text += f"; {100 * self.dark:.0f} % of the directions that a visible surface may have face fewer than {READINGS} lights"
        return text


def front_lights(directions: np.ndarray) -> FrontLights | None:
    """Return what lights of these directions reach that all stand in front of the object, or None where one stands beside or behind it."""
    lowest = float(directions[:, 2].min()) if len(directions) else 0.0
    if lowest <= 0:
        return None
    widest = float(np.degrees(np.arccos(min(lowest, 1.0))))
    facing = (fibonacci_sphere(2 * NORMALS)[:NORMALS] @ directions.T > 0).sum(axis=1)
    return FrontLights(widest, widest / 2, (1 + lowest) / 2, float((facing < READINGS).mean()))


# Compare some pixels of each frame with the manifest, and report contradictions: encoding, brightness, order, single lights.

def pixels_to_look_at(capture: Capture) -> Grid | None:
    """Return some pixels of the object; None where the lights of the capture contradict nothing.

    Lambert's law contradicts a manifest of distant lights only, and only where there are more of them than unknowns.
    """
    lit = capture.lit_by(DistantLight)
    if len(lit) < MIN_LIGHTS or len(lit) < len(capture.sources()) or has_placeholders(capture) or capture.is_polarised:
        return None
    with suppress(StageError):
        if (mask := capture.mask()).any() and (grid := Grid.of(mask)).inside.any():
            return grid
    return None


def findings(capture: Capture, looked: Grid, recorded: Mapping[str, np.ndarray]) -> Findings:
    """Return what explains the images much better than the manifest, else the lights that disagree with the others.
    `recorded`: [n, 3] float32 of each frame at these pixels, by the name of its image: fractions of full scale, or floating-point
    values."""
    lit = capture.lit_by(DistantLight)
    correction = Correction.of(capture).at(looked.chosen)
    radiance = np.stack([correction.corrected(recorded[frame.image][:, None], frame)[:, 0] for frame, _ in lit]).astype(np.float64)
    limits = [saturation_limit(capture.manifest, capture.file(frame.image)) for frame, _ in lit]
    usable = np.stack([(recorded[frame.image] < np.float32(most)).all(axis=-1) for (frame, _), most in zip(lit, limits, strict=True)])
    some = evenly(len(looked.chosen), PIXELS)
    sample = Sample(radiance[:, some], usable[:, some], np.array([light.direction for _, light in lit]),
                    np.array([light.irradiance for _, light in lit]), np.array([frame.exposure_s or 1.0 for frame, _ in lit]),
                    capture.manifest.color_space, tuple(frame.image for frame, _ in lit))
    fit = fit_manifest(sample)
    if (away := facing_sentence(fit)) is not None:
        return Findings([away], {})
    readings = grey_readings(radiance, sample.irradiance)
    dark = dark_lights(readings[:, some], sample.directions)
    if dark.any():
        images = [frame.image for frame, _ in lit]
        return Findings([dark_sentence(images, dark, "take them again, or out of the frames; a solve leaves them out")], {})
    if (found := better_explanation(sample, fit)) is not None:
        return Findings([explanation_sentence(found, sample)], {})
    if (axes := axes_sentence(capture.camera, looked, readings, usable, sample.directions)) is not None:
        return Findings([axes], {})
    off = _suspects(sample, fit)
    named = {lit[each.light][0].image: each.misfit for each in off}
    if not named:
        return Findings([], {})
    listed = ", ".join(f"{image} (by {100 * misfit:.0f} %)" for image, misfit in list(named.items())[:MOST_NAMED])
    more = f" and {len(named) - MOST_NAMED} more" if len(named) > MOST_NAMED else ""
    return Findings([f"frames[].light: readings disagree with those under the other lights in {listed}{more}: check the direction and "
                     "irradiance of these lights"], named)


def _suspects(sample: Sample, fit: Fit) -> list[Suspect]:
    """Return the lights that disagree with the others on the pixels that fit best, half of those with readings to spare."""
    if not fit.spare.any():
        return []
    left = np.sqrt((fit.residual**2).sum(axis=0) / np.maximum(fit.lit.sum(axis=0), 1))
    sure = fit.spare & (left <= np.median(left[fit.spare]))
    return suspects(grey_readings(sample.radiance, sample.irradiance)[:, sure], sample.directions, fit.normal[:, sure])

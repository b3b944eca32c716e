"""Import files that are laid out another way as a capture: from the request of a layout to its capture.json.

Uploaded files that are no capture get a proposal first: what they seem to be, and what is left to be chosen. These functions read
untrusted files: `service.captures.check_process` calls them in a process of its own.
"""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from service.reporting.progress import Progress, Timings
from service.requests.base.base import Role
from service.requests.base.import_choices import ImportChoices
from service.requests.imports.base import ImageOptions, ImportRequest, LensOptions
from service.requests.imports.layouts import LAYOUTS, options_of_layout, request_of, taken_apart, unsettled
from service.requests.imports.lights import DiligentImport, LpImport, NearLightsImport, OlatImport, PhotosImport, RelightlabImport, Sense
from service.requests.imports.patterns import (
    ExposureOrder,
    GrayImport,
    LaserImport,
    OpencvGrayImport,
    PhaseImport,
    PhaseShift,
    ScannerImport,
    StereoImport,
    WaveOrigin,
)
from service.requests.imports.tof import ArrayOptions, HistogramImport, KinectImport, Signal, TofImport
from service.requests.patterns import PatternAxis
from stage.capture.capture import Capture
from stage.capture.manifest import read_manifest, write_manifest
from stage.errors import ManifestError, StageError
from stage.importers import diligent, kinect, laser, lp, olat, patterns, relightlab, stereo, tof
from stage.importers.camera_options import Selection, View
from stage.importers.guess import guess
from stage.importers.layout import Imported
from stage.importers.pattern_order import GrayStack, PhaseStack
from stage.importers.patterns import PatternImages
from stage.importers.raw_arrays import ArrayFiles
from stage.importers.video import FrameRange, is_video, unpack
from stage.stack.correction import Correction
from stage.stack.peaks import MOST_FRAMES
from stage.stack.readings import said_by_readings


def import_files(request: ImportRequest, progress: Progress | None = None, *, assumed: tuple[str, ...] = ()) -> Imported:
    """Write the capture.json of a request, and return where it is and how the files were understood.
    `assumed`: what was taken for granted by who chose the layout, which the manifest then records. Raises ManifestError if the files do not
    hold what the layout has, or do not fit the options."""
    timings = Timings(progress)
    timings.stage("import", 1)
    imported = _imported(request)
    manifest = read_manifest(imported.path)
    doubts, seen, faults = manifest.assumed, list[str](), list[tuple[str, str]]()
    timings.stage("readings", MOST_FRAMES)
    try:
        capture = Capture.open(imported.path)
        doubts = capture.doubts
        Correction.of(capture)  # raises where dark, flat or ambient frames cannot be
        seen = said_by_readings(capture, advance=timings.advance)
    except StageError as error:  # of an image, which the import need not have looked at
        faults = [("fault", str(error))]
    timings.advance(MOST_FRAMES)
    said = [("assumed" if doubt in manifest.assumed else "finding", doubt) for doubt in (*doubts, *seen) if doubt not in assumed]
    more = tuple(sentence for sentence in (*assumed, *seen) if sentence not in manifest.assumed)
    if more:
        write_manifest(manifest.model_copy(update={"assumed": (*manifest.assumed, *more)}), imported.path)
    return imported._replace(facts=(*imported.facts, *said, *faults))


def _imported(request: ImportRequest) -> Imported:
    """Write the capture.json of a request by the importer of its layout."""
    match request:
        case DiligentImport():
            return Imported(diligent.import_folder(request.source, request.folder), ())
        case LpImport():
            return Imported(lp.import_folder(request.source, request.folder, view=_view(request), color_space=request.color_space,
                                             white=request.scale), ())
        case RelightlabImport():
            return relightlab.import_folder(request.source, request.destination, color_space=request.color_space)
        case OlatImport():
            return olat.import_folder(
                request.source, request.folder, axes=request.axes, to_light=request.sense is Sense.TO_LIGHT, lights=request.lights,
                variable=request.variable, run=request.lights_in, strengths=request.strengths, selection=_selection(request),
                view=_view(request), color_space=request.color_space, white=request.scale)
        case PhotosImport():
            return olat.import_photos(request.source, request.folder, selection=_selection(request), view=_view(request),
                                      color_space=request.color_space)
        case NearLightsImport():
            return olat.import_near_lights(
                request.source, request.folder, axes=request.axes, unit_m=request.unit_m, lights=request.lights, camera=request.camera,
                selection=_selection(request), view=_view(request), color_space=request.color_space)
        case OpencvGrayImport():
            return patterns.import_gray(request.source, request.folder, gray=GrayStack(), pictures=PatternImages(
                projector=request.projector, calibration=request.calibration, unit_m=request.unit_m))
        case GrayImport():
            gray = GrayStack(sequence=request.sequence, inverses=request.inverses, fine_first=request.fine_first,
                             column_bits=request.column_bits, row_bits=request.row_bits)
            source, pictures = _pattern_images(request)
            return patterns.import_gray(source, request.folder, pictures=pictures, gray=gray)
        case PhaseImport():
            phase = PhaseStack(axes=_axes(request.axis), periods_px=request.periods, row_periods_px=request.row_periods,
                               steps=request.steps, order=request.order, advancing=request.shift is PhaseShift.MINUS,
                               offset_deg=request.offset_deg)
            gray = GrayStack(inverses=request.gray_inverses, fine_first=request.gray_fine_first)
            source, pictures = _pattern_images(request)
            return patterns.import_phase(source, request.folder, pictures=pictures, phase=phase, gray_images=request.gray_images,
                                         gray_stripe_px=request.gray_stripe, gray=gray, from_centre=request.origin is WaveOrigin.CENTRE)
        case ScannerImport():
            return patterns.import_scanner(
                request.source, request.folder, calibration=request.calibration, codec=request.codec, axes=_axes(request.axis),
                unit_m=request.unit_m, projector=request.projector, images=request.images)
        case LaserImport():
            return laser.import_folder(
                request.source, request.folder, view=_view(request), camera=request.camera, planes=request.planes, form=request.form,
                axes=request.axes, unit_m=request.unit_m, selection=_selection(request), color_space=request.color_space)
        case TofImport():
            return tof.import_correlations(
                request.source, request.folder, frequencies_hz=request.frequencies_hz, phases_deg=request.phases_deg,
                minus=request.signal is Signal.MINUS, order=request.order, arrays=_arrays(request), planes=request.planes,
                source_m=request.source_m, view=_view(request))
        case HistogramImport():
            return tof.import_histograms(
                request.source, request.folder, bin_s=request.bin_s, start_s=request.start_s, count_scale=request.count_scale,
                pulses=request.pulses, first_photon_only=request.first_photon_only, bins=request.bins, arrays=_arrays(request),
                source_m=request.source_m, view=_view(request))
        case KinectImport():
            return kinect.import_folder(request.source, request.folder, packet=request.packet, p0=request.p0, view=_view(request))
        case StereoImport():
            return stereo.import_pair(request.source, request.right, request.destination, calibration=request.calibration,
                                      extrinsics=request.extrinsics, unit_m=request.unit_m, color_space=request.color_space)
    raise TypeError(f"no importer takes a {type(request).__name__}")


def _arrays(request: ArrayOptions) -> ArrayFiles:
    return ArrayFiles(files=request.arrays, variables=request.variable, dtype=request.dtype, size=request.size)


def _axes(axis: PatternAxis) -> tuple[str, ...]:
    return ("column", "row") if axis is PatternAxis.BOTH else (axis.value,)


def _pattern_images(request: GrayImport | PhaseImport) -> tuple[Path, PatternImages]:
    """Return the folder of images, and which of them are frames; those of a video are unpacked first."""
    source, video, space = request.source, None, request.color_space
    if is_video(request.source):
        if request.destination is None:
            raise ManifestError(f"{request.source}: is a video: give a folder for its frames behind it")
        video = unpack(request.source, request.destination, FrameRange.parse(request.video_frames or "0"))
        source = video.folder
        if "color_space" not in request.model_fields_set:
            space = "srgb_texture"  # videos are encoded for displays
    elif request.video_frames is not None:
        raise ManifestError(f"--video-frames {request.video_frames}: {request.source} is no video")
    return source, PatternImages(
        projector=request.projector, images=request.images, mask=request.mask, white=request.white, black=request.black,
        calibration=request.calibration, unit_m=request.unit_m, color_space=space, video=video, exposures_s=request.exposures_s,
        patterns_first=request.exposure_order is ExposureOrder.PATTERN)


def _view(request: LensOptions) -> View:
    return View(**{field.name: getattr(request, field.name) for field in fields(View) if hasattr(request, field.name)})


def _selection(request: ImageOptions) -> Selection:
    return Selection(images=request.images, mask=request.mask, ambient=request.ambient)


def propose(folder: Path) -> dict[str, Any]:
    """Return how the files of a folder can be imported, as JSON.
    Returns `summary` and `because`, sentences; `layout`, `file` and `options` as ImportChoices has them; `missing`, the names of options
    that a person has to choose; `assumed`, sentences; `sure`, whether the files say all that the import needs; `lights`, how far the first
    solve is to trust the lights of the import. Raises ManifestError if the files are of no layout that can be imported; the sentence says
    what was looked for."""
    found = guess(folder)
    if found.arguments[0] not in LAYOUTS:
        raise ManifestError(f"{folder}: looks like {found.layout}, which relit import {found.arguments[0]} takes, and the service does not")
    typed = taken_apart(found.arguments)
    _require_no_video(typed.layout, typed.source)
    missing = unsettled(typed.layout, typed.options)
    known = options_of_layout(typed.layout)
    asked = [str(typed.options[name]) for name in missing if name in typed.options]  # such as FOCAL, which the form asks for
    assumed = [sentence for sentence in found.assumed if not any(word in sentence for word in asked)]
    options = {name: str(Path(value).relative_to(folder)) if known[name].role is Role.INPUT else value
               for name, value in typed.options.items() if name not in missing}
    return {"summary": found.summary, "because": found.reason, "layout": typed.layout,
            "file": None if typed.source == folder else str(typed.source.relative_to(folder)), "options": options, "missing": missing,
            "assumed": assumed, "sure": found.sure and not missing, "lights": "unknown" if found.has_unknown_lights else "declared"}


def import_chosen(folder: Path, choices: ImportChoices, assumed: tuple[str, ...], name: str) -> None:
    """Write the capture.json of a folder as it was chosen.
    `assumed`: the sentences of the proposal that are still true. `name`: that the capture is to have."""
    _require_no_video(choices.layout, folder / (choices.file or ""))
    known = options_of_layout(choices.layout)
    options = {key: folder / value if key in known and known[key].role is Role.INPUT and isinstance(value, str) else value
               for key, value in choices.options.items()}
    path = import_files(request_of(choices.layout, folder / (choices.file or ""), folder, options), assumed=assumed).path
    write_manifest(read_manifest(path).model_copy(update={"name": name}), path)


def _require_no_video(layout: str, source: Path) -> None:
    """Refuse a video, whose decoder sets no bounds to what a file asks of it."""
    if is_video(source):
        raise ManifestError(f"{source}: is a video: unpack it with relit import {layout if layout == 'phase' else 'gray'} on your machine, "
                            "and upload the folder that it writes")


def still_assumed(proposal: Mapping[str, Any], choices: ImportChoices) -> tuple[str, ...]:
    """Return the assumptions of a proposal that hold for what was chosen: none where another import was, or another value than proposed,
    and not those about an option that was chosen beside it."""
    options = choices.options
    if choices.layout != proposal["layout"]:
        return ()
    chosen, as_proposed = (request_of(choices.layout, Path(), None, values) for values in (options, {**options, **proposal["options"]}))
    if chosen != as_proposed:
        return ()
    known = options_of_layout(choices.layout)
    flags = [known[name].flag for name in options if name in known and name not in proposal["options"]]
    return tuple(sentence for sentence in proposal["assumed"] if not any(flag in sentence for flag in flags))

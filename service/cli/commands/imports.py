"""relit import LAYOUT: make a capture of files that are laid out another way, and say how they were understood."""

import io
from contextlib import nullcontext, redirect_stdout
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.groups import make_group
from service.cli.remote import KeyOption
from service.cli.request_commands import local_command
from service.requests.imports.base import ImageOptions, ImportRequest, LensOptions
from service.requests.imports.interleaved import InterleavedImport
from service.requests.imports.lights import DiligentImport, LpImport, NearLightsImport, OlatImport, PhotosImport, RelightlabImport, Sense
from service.requests.imports.patterns import (
    ExposureOrder,
    GrayImport,
    LaserImport,
    OpencvGrayImport,
    PatternImageOptions,
    PhaseImport,
    PhaseShift,
    RigOptions,
    ScannerImport,
    WaveOrigin,
)
from service.requests.imports.scans import ScansImport
from service.requests.imports.tof import ArrayOptions, HistogramImport, KinectImport, Signal, TofImport
from service.requests.patterns import PatternAxis

if TYPE_CHECKING:
    from stage.importers.camera_options import Selection, View
    from stage.importers.folder import Guess
    from stage.importers.layout import Imported
    from stage.importers.patterns import PatternImages
    from stage.importers.raw_arrays import ArrayFiles


FolderArgument = Annotated[Path, typer.Argument(metavar="SRC", help="Folder of the data.", show_default=False)]
DestinationArgument = Annotated[Path | None, typer.Argument(metavar="DST", show_default=False, help=(
    "Folder for the capture, which gets links to the files; without it capture.json is written beside them."))]

ToOption = Annotated[str | None, typer.Option(
    "--to", metavar="URL", show_default=False, help=(
        "Send the capture to this service, as relit serve prints its address; DST may be left out."))]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    layouts = make_group("import", help="Write a capture.json for files that are laid out another way; docs/importing.md shows each.")
    for function in (_diligent, _lp, _relightlab, _olat, _photos, _near_lights, _opencv_gray, _gray, _phase, _scanner, _tof, _histogram,
                     _kinect, _laser, _scans, _interleaved):
        local_command(layouts, function.__name__[1:].replace("_", "-"), function)
    layouts.command("guess")(_guess)

    @layouts.command("auto")
    def auto(folder: FolderArgument, destination: DestinationArgument = None, to: ToOption = None, key: KeyOption = None) -> None:
        """Import a folder as guess proposes, where the files say all that the command needs; else name the commands to choose from."""
        if to is None:
            _auto(folder, destination, layouts)
            return
        with TemporaryDirectory(prefix="relit-import-") as work:  # of links, so that the files of captures alone are sent
            _upload(_auto(folder, destination or Path(work) / folder.resolve().name, layouts, kept=destination is not None), to, key)

    app.add_typer(layouts)


def _guess(folder: FolderArgument) -> None:
    """Look at a folder: what it seems to be, why, how sure that is, and the command that imports it."""
    from stage.importers.guess import guess_each

    for found in guess_each(folder):
        _print_guess(found)
        print(f"run      {found.command}")
        print(f"then     {found.then}")


def _auto(folder: Path, destination: Path | None, layouts: typer.Typer, *, kept: bool = True) -> list[Path]:
    """Run the import of a folder, or of each folder in it, record in its capture.json what the guess assumed, and return the captures.

    Args:
        kept: whether they stay; nothing is said of places that do not.
    """
    from stage.capture.manifest import FILE_NAME, read_manifest, write_manifest
    from stage.errors import ManifestError
    from stage.importers.guess import guess_each

    guesses = guess_each(folder)
    unsure = [found for found in guesses if not found.sure]
    if unsure:
        assumed = "; ".join(unsure[0].assumed)
        raise ManifestError(f"{folder}: looks like {unsure[0].layout}, and the files do not say all that its import needs ({assumed}): "
                            + "; ".join(found.command for found in unsure))
    command, made = typer.main.get_command(layouts), []
    for found in guesses:
        target = destination if destination is None or len(guesses) == 1 else destination / found.source.name
        layout, source, *options = found.arguments
        _print_guess(found)
        with nullcontext() if kept else redirect_stdout(io.StringIO()):
            command.main([layout, source, *([] if target is None else [str(target)]), *options], standalone_mode=False)
        path = (target or found.source) / FILE_NAME
        manifest = read_manifest(path)
        more = tuple(sentence for sentence in found.assumed if sentence not in manifest.assumed)
        write_manifest(manifest.model_copy(update={"assumed": (*manifest.assumed, *more)}), path)
        if kept:
            print(f"then     {found.then if target is None else found.then.replace(str(found.source), str(target), 1)}")
        made.append(path.parent)
    return made


def _upload(captures: list[Path], server: str, key: str | None) -> None:
    """Send captures to a service, which checks them."""
    from service.cli.progress import ProgressBar
    from service.cli.remote import connected

    with connected(server, key) as client:
        for folder in captures:
            with ProgressBar() as bar:
                print(f"sent     {client.captures.upload(folder, progress=bar).id}")


def _print_guess(found: "Guess") -> None:
    print(f"looks    like {found.layout}")
    print(f"because  {found.reason}")
    for sentence in found.assumed:
        print(f"assumed  {sentence}")
    print(f"sure     {'yes' if found.sure else 'no: the assumptions, or words in capitals, are yours to check'}")


def _diligent(request: DiligentImport) -> None:
    from stage.importers import diligent

    _print_path(diligent.import_folder(request.source, request.folder))


def _scans(request: ScansImport) -> None:
    from service.scans.importing import import_scans

    _print(import_scans(request), "set")


def _interleaved(request: InterleavedImport) -> None:
    from service.acquisition.performance import import_interleaved

    _print(import_interleaved(request), "sequence")


def _lp(request: LpImport) -> None:
    from stage.importers import lp

    _print_path(lp.import_folder(request.source, request.folder, view=_view(request), color_space=request.color_space))


def _opencv_gray(request: OpencvGrayImport) -> None:
    from stage.importers.patterns import import_opencv_gray

    _print_path(import_opencv_gray(request.source, request.folder, projector=request.projector, calibration=request.calibration,
                                   unit_m=request.unit_m))


def _olat(request: OlatImport) -> None:
    from stage.importers import olat

    _print(olat.import_folder(
        request.source, request.folder, axes=request.axes, to_light=request.sense is Sense.TO_LIGHT, lights=request.lights,
        variable=request.variable, run=request.lights_in, strengths=request.strengths, selection=_selection(request), view=_view(request),
        color_space=request.color_space))


def _photos(request: PhotosImport) -> None:
    from stage.importers.olat import import_photos

    _print(import_photos(request.source, request.folder, selection=_selection(request), view=_view(request),
                         color_space=request.color_space))


def _near_lights(request: NearLightsImport) -> None:
    from stage.importers.olat import import_near_lights

    _print(import_near_lights(
        request.source, request.folder, axes=request.axes, unit_m=request.unit_m, lights=request.lights, camera=request.camera,
        selection=_selection(request), view=_view(request), color_space=request.color_space))


def _relightlab(request: RelightlabImport) -> None:
    from stage.importers import relightlab

    _print(relightlab.import_folder(request.source, request.destination, color_space=request.color_space))


def _gray(request: GrayImport) -> None:
    from stage.importers.pattern_order import GrayStack
    from stage.importers.patterns import import_gray

    gray = GrayStack(sequence=request.sequence, inverses=request.inverses, fine_first=request.fine_first, column_bits=request.column_bits,
                     row_bits=request.row_bits)
    pictures = _pattern_images(request, request, request)
    _print(import_gray(request.source if pictures.video is None else pictures.video.folder, request.folder, pictures=pictures, gray=gray))


def _phase(request: PhaseImport) -> None:
    from stage.importers.pattern_order import GrayStack, PhaseStack
    from stage.importers.patterns import import_phase

    phase = PhaseStack(axes=_axes(request.axis), periods_px=request.periods, row_periods_px=request.row_periods, steps=request.steps,
                       order=request.order, advancing=request.shift is PhaseShift.MINUS, offset_deg=request.offset_deg)
    gray = GrayStack(inverses=request.gray_inverses, fine_first=request.gray_fine_first)
    pictures = _pattern_images(request, request, request)
    _print(import_phase(request.source if pictures.video is None else pictures.video.folder, request.folder, pictures=pictures, phase=phase,
                        gray_images=request.gray_images, gray_stripe_px=request.gray_stripe, gray=gray,
                        from_centre=request.origin is WaveOrigin.CENTRE))


def _scanner(request: ScannerImport) -> None:
    from stage.importers.patterns import import_scanner

    _print(import_scanner(request.source, request.folder, calibration=request.calibration, codec=request.codec, axes=_axes(request.axis),
                          unit_m=request.unit_m, projector=request.projector, images=request.images))


def _laser(request: LaserImport) -> None:
    from stage.importers import laser

    _print(laser.import_folder(request.source, request.folder, view=_view(request), camera=request.camera, planes=request.planes,
                               form=request.form, axes=request.axes, unit_m=request.unit_m, selection=_selection(request),
                               color_space=request.color_space))


def _tof(request: TofImport) -> None:
    from stage.importers.tof import import_correlations

    _print(import_correlations(
        request.source, request.folder, frequencies_hz=request.frequencies_hz, phases_deg=request.phases_deg,
        minus=request.signal is Signal.MINUS, order=request.order, arrays=_arrays(request), planes=request.planes,
        source_m=request.source_m, view=_view(request)))


def _histogram(request: HistogramImport) -> None:
    from stage.importers.tof import import_histograms

    _print(import_histograms(
        request.source, request.folder, bin_s=request.bin_s, start_s=request.start_s, count_scale=request.count_scale,
        pulses=request.pulses, first_photon_only=request.first_photon_only, bins=request.bins, arrays=_arrays(request),
        source_m=request.source_m, view=_view(request)))


def _kinect(request: KinectImport) -> None:
    from stage.importers import kinect

    _print(kinect.import_folder(request.source, request.folder, packet=request.packet, p0=request.p0, view=_view(request)))


def _arrays(request: ArrayOptions) -> "ArrayFiles":
    from stage.importers.raw_arrays import ArrayFiles

    return ArrayFiles(files=request.arrays, variables=request.variable, dtype=request.dtype, size=request.size)


def _axes(axis: PatternAxis) -> tuple[str, ...]:
    return ("column", "row") if axis is PatternAxis.BOTH else (axis.value,)


def _pattern_images(images: PatternImageOptions, rig: RigOptions, given: ImportRequest) -> "PatternImages":
    """Return which images are frames; those of a video are unpacked first."""
    from stage.errors import ManifestError
    from stage.importers.patterns import PatternImages
    from stage.importers.video import FrameRange, is_video, unpack

    video, space = None, images.color_space
    if is_video(given.source):
        if given.destination is None:
            raise ManifestError(f"{given.source}: is a video: give a folder for its frames behind it")
        video = unpack(given.source, given.destination, FrameRange.parse(images.video_frames or "0"))
        if "color_space" not in images.model_fields_set:
            space = "srgb_texture"  # videos are encoded for displays
    elif images.video_frames is not None:
        raise ManifestError(f"--video-frames {images.video_frames}: {given.source} is no video")
    return PatternImages(projector=rig.projector, images=images.images, mask=images.mask, white=images.white, black=images.black,
                         calibration=rig.calibration, unit_m=rig.unit_m, color_space=space, video=video, exposures_s=images.exposures_s,
                         patterns_first=images.exposure_order is ExposureOrder.PATTERN)


def _view(request: LensOptions) -> "View":
    from stage.importers.camera_options import View

    return View(**{field.name: getattr(request, field.name) for field in fields(View) if hasattr(request, field.name)})


def _selection(request: ImageOptions) -> "Selection":
    from stage.importers.camera_options import Selection

    return Selection(images=request.images, mask=request.mask, ambient=request.ambient)


def _print_path(path: Path) -> None:
    print(f"capture  {path}")


def _print(imported: "Imported", made: str = "capture") -> None:
    """Print where the capture, or what else was made, is, and how the files were understood."""
    print(f"{made:<8} {imported.path}")
    for name, sentence in imported.facts:
        print(f"{name:<8} {sentence}")

"""Guesses the layout of a folder and the command that imports it; what the files do not say stands in the command in capitals.

Names and tables are looked at first, then the images themselves (stage.importers.content).
"""

import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from stage.capture.manifest import FILE_NAME
from stage.errors import ManifestError, StageError, storage
from stage.folders import advice, natural_order
from stage.importers import guess_images, kinect
from stage.importers.camera_options import AMBIENT_WORDS, MASK_WORDS, refuse_twins, words_of
from stage.importers.content import Pictures
from stage.importers.depth_frames import frame_layout, read_intrinsics
from stage.importers.folder import Folder, Guess, arrays_of, encoding, group_of, lit, made, tried
from stage.importers.laser import NAMES as PLANES
from stage.importers.laser import OFF_WORDS, read_planes
from stage.importers.layout import image_names, read_json, read_lines
from stage.importers.light_rig import CAMERA_MATRIX, read_rig
from stage.importers.light_table import SUFFIXES as TABLES
from stage.importers.light_table import read_light_table
from stage.importers.lp import read_lights
from stage.importers.raw_arrays import ArrayFiles
from stage.importers.video import is_video
from stage.results.depth_maps import DEPTH_FILE
from stage.tof.raw_frames import read_array

REPORT = "report.json"
"""The file that every result folder of relit has."""
POINT_FILES = (".ply", ".xyz", ".asc", ".pts", ".ptx", ".pcd", ".las", ".laz", ".e57")
"""The endings of files of points."""

LOOKED_FOR = ("photographs with a table, a list or a rig of lights; four or more photographs of one size; Gray codes, phase steps or "
              "stripes of a laser; arrays of a time-of-flight camera or of photon counts")
"""The layouts, in words."""

NUMBER = re.compile(r"(?<![^\s;,])[-+]?\d*[.]?\d+(?:[eE][-+]?\d+)?(?![^\s;,])")
"""A number in a line of a table."""
PLANE_WORDS, LASER_WORDS = frozenset({"plane", "planes", "laser", "lasers"}), frozenset({"laser", "stripe", "line"})
"""Words in the names of files that hold planes, and of images of a stripe."""


def guess(source: Path) -> Guess:
    """Return what the files of a folder seem to be."""
    with storage("read", source):
        names = tuple(natural_order(path.name for path in source.iterdir() if path.is_file() and not path.name.startswith(".")))
    if FILE_NAME in names:
        raise ManifestError(f"{source}: is a capture already: relit info {shlex.quote(str(source))} looks at it")
    if REPORT in names and (held := advice(source, "")):
        raise ManifestError(f"{source}: is a result of relit, which needs no import: {held}")
    pictures = tuple(name for name in image_names(source) if not words_of(name) & (MASK_WORDS | AMBIENT_WORDS))
    for named in (_diligent, _relightlab, _lp):  # files that name their images
        if (found := named(Folder(source, names, pictures))) is not None:
            return found
    refuse_twins(source, pictures)
    shown = Pictures(source, pictures)
    folder = Folder(source, names, shown.names)
    ways: tuple[Callable[[Folder], Guess | None], ...] = (
        _kinect, _scans, _laser, _near_lights, partial(_table, shown=shown),
        partial(guess_images.scanner, shown=shown), partial(guess_images.gray, shown=shown), partial(guess_images.phase, shown=shown),
        _correlations, _histograms, _video, partial(guess_images.photos, shown=shown))
    for look in ways:
        if (found := look(folder)) is not None:
            passed = tuple(_passed_over(folder)) if found.has_unknown_lights else ()
            return found._replace(assumed=(*found.assumed, *passed), sure=found.sure and not passed)
    suffixes = Counter(Path(name).suffix.lower() for name in names)
    held = ", ".join(f"{count} {suffix or 'without suffix'}" for suffix, count in suffixes.items())
    raise ManifestError(f"{source}: holds {held or 'no files'}, which is no layout that relit import knows (looked for: {LOOKED_FOR}): "
                        "docs/importing.md shows them")


def guess_each(source: Path) -> tuple[Guess, ...]:
    """Return what the files of a folder seem to be, or those of each folder in it where the folder itself has no images and arrays."""
    with storage("read", source):
        children = natural_order(path.name for path in source.iterdir() if path.is_dir() and not path.name.startswith("."))
    try:
        return (guess(source),)
    except ManifestError:
        inside = [name for name in children if image_names(source / name)]
        if image_names(source) or not inside:
            raise
    return tuple(guess(source / name) for name in inside)


def _diligent(folder: Folder) -> Guess | None:
    wanted = {"filenames.txt", "light_directions.txt", "light_intensities.txt"}
    if not wanted <= set(folder.names):
        return None
    return made("an object of the DiLiGenT benchmark", "it has filenames.txt, light_directions.txt and light_intensities.txt",
                 ["diligent", folder.path], folder.path, solve=True, sure=True,
                 summary=lit(len(read_lines(folder.path / "filenames.txt")), "from {} directions", Path("light_directions.txt")))


def _relightlab(folder: Folder) -> Guess | None:
    files = [name for suffix in (".relight", ".dome") for name in folder.names if name.lower().endswith(suffix)]
    if not files:
        return None
    return made("a project or a dome of RelightLab", f"it has {files[0]}", ["relightlab", folder.path / files[0]],
                 folder.path, solve=True, sure=True)


def _lp(folder: Folder) -> Guess | None:
    files = [name for name in folder.names if name.lower().endswith(".lp")]
    below = [path for path in folder.path.glob("*/*") if path.suffix.lower() == ".lp"]
    if not files and (len(below) != 1 or folder.pictures):
        return None
    path = folder.path / files[0] if files else below[0]
    assumed = [f"{files[0]} is the list of the lights, and not {files[1]}"] if len(files) > 1 else []
    count = 0
    try:
        found = read_lights(path)
        if not files and found.folder == path.parent:
            return None  # that folder is the capture
        count = len(found.images)
    except StageError as error:
        table = tried(partial(read_light_table, path))
        if table is not None and table.names is None:
            return None  # a table of lights in the order of the images
        assumed.append(str(error))
    return made("images of RTI with a light list", f"it has {path.relative_to(folder.path)}", ["lp", path if files else folder.path],
                folder.path, solve=True, sure=len(files) < 2 and count > 0, assumed=tuple(assumed),
                summary=lit(count, "from {} directions", path))


def _kinect(folder: Folder) -> Guess | None:
    packets = [name for name in folder.names if (folder.path / name).stat().st_size == max(kinect.PACKET_BYTES)]
    tables = [name for name in folder.names if "p0" in name.lower() and (folder.path / name).stat().st_size >= kinect.P0_BYTES]
    if not packets or not tables:
        return None
    more = ["--packet", folder.path / packets[0]] if len(packets) > 1 else []
    return made("depth packets of a Kinect v2",
                 f"{packets[0]} has the size of a packet of libfreenect2, and {tables[0]} that of P0 tables",
                 ["kinect", folder.path, *more, "--focal-px", "365.456", "--principal-px", "254.878,205.395"], folder.path,
                 solve=False, sure=True,
                 assumed=("the intrinsics are those of a usual device: getIrCameraParams of yours says better ones",))


def depth_results(source: Path) -> list[str]:
    """Return the names of the folders in a folder that are results of relit depth."""
    with storage("read", source):
        return natural_order(path.name for path in source.iterdir() if (path / DEPTH_FILE).is_file())


def _scans(folder: Folder) -> Guess | None:
    if (layout := frame_layout(folder.path)) is not None:
        words: tuple[object, ...] = ("scans", folder.path, "SCAN_SET")
        assumed = [f"a unit of depth is {layout.unit_m:g} m: else --depth-unit-m"]
        if read_intrinsics(folder.path) is None:
            words += ("--intrinsics", "FX,FY,CX,CY")
            assumed.append("FX,FY,CX,CY is the depth camera in pixels, of the first Kinect about 525,525,319.5,239.5")
        return made("frames of a depth camera", f"it has {layout.value}", [*words], folder.path, solve=False,
                    assumed=tuple(assumed))._replace(then="relit register SCAN_SET --out registered")
    if not folder.pictures and len(results := depth_results(folder.path)) > 1:
        return made("results of relit depth", f"it has {len(results)} folders with a {DEPTH_FILE}", ["scans", folder.path], folder.path,
                    solve=False)._replace(then=f"relit register {shlex.quote(str(folder.path))} --out registered")
    clouds = [name for name in folder.names if name.lower().endswith(POINT_FILES)]
    if not clouds or folder.pictures:
        return None
    converted = ["SCAN_SET"] if not all(name.lower().endswith(".ply") for name in clouds) else []
    found = made("scans of one object", f"it has {len(clouds)} files of points, as {clouds[0]}", ["scans", folder.path, *converted],
                 folder.path, solve=False, assumed=("coordinates are in metres: else --unit mm",))
    if converted:
        return found._replace(then="relit register SCAN_SET --out registered")
    return found._replace(then=shlex.join(["relit", "register", str(folder.path), "--out", f"{folder.path.resolve().name}-registered"]))


def _laser(folder: Folder) -> Guess | None:
    lit = folder._replace(pictures=tuple(name for name in folder.pictures if not words_of(name) & OFF_WORDS))
    if not lit.pictures:
        return None
    matrices = next((path for path in folder.with_suffix(".yml", ".yaml", ".xml", ".json", ".mat")
                     if set(CAMERA_MATRIX) & set(arrays_of(path))), None)
    camera = ["--focal-px", "FOCAL"] if matrices is None else ["--camera", matrices]
    unknown = () if matrices is not None else ("FOCAL is the focal length of the camera in pixels",)
    for path in folder.with_suffix(".csv", ".txt", ".npy", ".mat", ".yml", ".yaml", ".xml", ".json"):
        if not (words_of(path.name) & PLANE_WORDS or set(PLANES) & set(arrays_of(path))):
            continue
        table = tried(partial(read_planes, path))
        chosen = None if table is None else [] if table.names is not None else group_of(lit, len(table.values))
        if table is None or chosen is None:
            continue
        form = ["--form", "zero"] if table.values.shape[1] == 4 else []
        return made("images of a laser's stripe with its planes",
                    f"{path.name} holds {len(table.values)} planes, as many as there are images",
                     ["laser", folder.path, *camera, "--planes", path, *form, "--axes", "right,down,away", "--unit-m", "0.001", *chosen],
                     folder.path, solve=False, assumed=(
                         *unknown, "planes are in OpenCV's axes and in millimetres: the files do not say it",
                         *(("coefficients are those of a x + b y + c z + d = 0: else --form equals",) if form else ()), *encoding(lit)))
    if sum(bool(words_of(name) & LASER_WORDS) for name in lit.pictures) * 2 <= len(lit.pictures):
        return None
    found = made("images of a laser's stripe", f"its images are named as {lit.pictures[0]}", ["laser", folder.path, *camera], folder.path,
                  solve=False, assumed=(*unknown, "nothing says where the planes of the laser are", *encoding(lit)))
    return found._replace(then=f"relit calibrate laser-planes POSE POSE --board 9x6 --square-m METRES --apply-to {folder.path}")


def _near_lights(folder: Folder) -> Guess | None:
    for path in folder.with_suffix(".mat", ".json"):
        if path.suffix.lower() == ".mat" and not {"s", "phi"} <= {name.rpartition(".")[2].lower() for name in arrays_of(path)}:
            continue
        if path.suffix.lower() == ".json" and path.parent.absolute() != folder.path.absolute():
            continue
        rig = tried(partial(read_rig, path))
        if rig is None or (path.suffix.lower() == ".json" and rig.anisotropy is None):
            continue
        chosen = group_of(folder, len(rig.positions))
        if chosen is None:
            continue
        camera = next((other for other in folder.with_suffix(".mat", ".yml", ".yaml", ".xml") if other != path
                       and set(CAMERA_MATRIX) & set(arrays_of(other))), None)
        words = ["near-lights", folder.path, "--lights", path, *(["--camera", camera] if camera else []), "--axes", "right,down,away",
                 "--unit-m", "0.001", *chosen]
        return made("images under LEDs, as near_ps has them", f"{path.name} holds as many positions of lights as there are images", words,
                     folder.path, solve=True, sure=True, summary=lit(len(rig.positions), "by {} near lights", path),
                     assumed=("axes and millimetres are those of near_ps",
                                          "nothing says how far the object is: relit solve estimates it; --surface-z-m gives it",
                                          *encoding(folder)))
    return None


def _table(folder: Folder, shown: Pictures) -> Guess | None:
    if not folder.pictures:
        return None
    for path in folder.with_suffix(*TABLES):
        if path.parent.absolute() != folder.path.absolute() and path.suffix.lower() != ".txt":
            continue
        table = tried(partial(read_light_table, path))
        if table is None or len(table.vectors) < 3:
            continue
        missing = _not_there(folder, table.names or ())
        if missing and len(missing) > len(table.names or ()) - 3:  # the table of other images, as of a basis that was made elsewhere
            continue
        chosen = [] if table.names is not None else group_of(folder, len(table.vectors))
        if chosen is None:
            continue
        told = " with names of images" if table.names else ", as many as there are images"
        reason = f"{path.name} holds {len(table.vectors)} lights{told}"
        ahead = table.vectors[:, 2].mean() > 0
        across, up = guess_images.followed(shown, table.vectors) if table.names is None and not chosen else (0.0, 0.0)
        mirrored = min(across, up) < -guess_images.FOLLOWED and max(across, up) > guess_images.FOLLOWED  # else an object may be hollow
        axes = (f"{'left' if mirrored and across < 0 else 'right'},{'down' if mirrored and up < 0 else 'up'},"
                f"{'towards' if ahead else 'away'}")
        return made("images under one far light each with a table of the lights", reason,
                     ["olat", folder.path, "--lights", path, "--axes", axes, "--vectors", "to-light", *chosen],
                     folder.path, solve=True, sure=not missing and (mirrored or min(across, up) > -guess_images.FOLLOWED),
                     summary=lit(len(table.vectors), "from {} directions", path), assumed=(
                         "the bright side of the object tells where x and y point, and vectors point to the light" if mirrored else
                         "x is right and y is up as seen by the camera, and vectors point to the light: the table does not say it",
                         f"z points {'towards the camera' if ahead else 'away from it'}, because then the lights are on its side",
                         *([f"{len(missing)} images of {path.name} are not there, {missing[0]} the first"] if missing else ()),
                         *encoding(folder)))
    return None


def _passed_over(folder: Folder) -> Iterator[str]:
    """Yield why tables of lights, or ones with a line for each image, are not those of the images."""
    count = len(folder.pictures)
    for path in folder.with_suffix(*TABLES):
        if path.parent.absolute() != folder.path.absolute():
            continue
        try:
            table = read_light_table(path)
        except StageError as error:
            if count in _lengths(path):
                yield f"{path.name} is no table of lights that can be read: {str(error).removeprefix(f'{path}: ')}"
        else:
            if table.names is None and len(table.vectors) > 2 and len(table.vectors) != count:
                yield f"{path.name} holds {len(table.vectors)} lights, and there are {count} images: which belong together, nothing says"


def _lengths(path: Path) -> set[int]:
    """Return how many lights a table may hold that is not read as one."""
    match path.suffix.lower():
        case ".mat":
            return {side for array in arrays_of(path).values() for side in array.shape}
        case ".npy":
            return set() if (array := tried(partial(read_array, path))) is None else set(array.shape)
        case ".json":
            data = tried(partial(read_json, path))
            return {len(part) for part in (data, *(data.values() if isinstance(data, dict) else ())) if isinstance(part, list | dict)}
    return {sum(len(NUMBER.findall(line)) > 1 for _, line in read_lines(path))}


def _not_there(folder: Folder, names: Sequence[str]) -> list[str]:
    """Return the images that a table names and no file of the folder is, whatever its suffix."""
    there = {Path(name).stem.lower() for name in folder.names}
    return [name for name in names if Path(name.replace("\\", "/")).stem.lower() not in there and not (folder.path / name).exists()]


def _correlations(folder: Folder) -> Guess | None:
    planes = [name for name in folder.names if name.lower().endswith(".npy") and _shape(folder.path / name, 2)]
    spelled = Counter(re.sub(r"\d+", "*", name) for name in planes)
    group = next((spelling for spelling, number in spelled.items() if number >= 3 and spelling.count("*") == 1), None)
    if group is None:
        return None
    chosen = natural_order(name for name in planes if re.sub(r"\d+", "*", name) == group)
    numbers = [int(re.findall(r"\d+", name)[0]) for name in chosen]
    told = max(numbers) >= 90 and max(numbers) < 360
    phases = ",".join(map(str, numbers)) if told else ",".join(f"{360 * step / len(chosen):g}" for step in range(len(chosen)))
    return made("correlation images of a time-of-flight camera", f"{len(chosen)} arrays of one image each, {chosen[0]} to {chosen[-1]}",
                 ["tof", folder.path, "--arrays", group, "--frequencies-hz", "HZ", "--phases-deg", phases, "--signal", "minus"],
                 folder.path, solve=False, summary=f"{len(chosen)} correlation images of a time-of-flight camera", assumed=(
                     "HZ is the modulation frequency", "the images are P + Q cos(φ − δ): if ranges run backwards, --signal plus",
                     *(() if told else ("one frequency at even phases: their order is not in the names",))))


def _histograms(folder: Folder) -> Guess | None:
    for name in folder.names:
        path = folder.path / name
        if path.suffix.lower() not in (".npy", ".npz", ".mat"):
            continue
        arrays = tried(partial(ArrayFiles().read, path))
        if arrays is not None and len(arrays) == 1 and arrays[0].ndim == 3 and arrays[0].dtype.kind in "fiu" and arrays[0].min() >= 0:
            rows, cols, bins = arrays[0].shape
            return made("photon histograms", f"{name} holds {rows} x {cols} x {bins} counts",
                         ["histogram", folder.path, "--arrays", name, "--bin-s", "SECONDS"], folder.path, solve=False,
                         assumed=("SECONDS is the width of a bin", f"the last of the three, {bins}, counts the bins: else --bins first"))
    return None


def _video(folder: Folder) -> Guess | None:
    videos = [name for name in folder.names if is_video(Path(name))]
    if len(videos) != 1 or folder.pictures:
        return None
    path = folder.path / videos[0]
    frames = path.with_name(f"{path.stem}-frames")
    return made("a video, perhaps of projected patterns", f"it has {videos[0]} and no images", [
        "gray", path, frames, "--projector", "WIDTHxHEIGHT", "--video-frames", "FIRST-LAST:STEP"], frames, solve=False, assumed=(
            "WIDTHxHEIGHT is the projector in pixels, FIRST-LAST:STEP are the frames with one pattern each, counted from 0",
            "a Gray code of columns and rows with inverses, then white and black: else --sequence, --inverses, or relit import phase"))


def _shape(path: Path, dimensions: int) -> bool:
    """Return whether a .npy file holds real numbers in so many dimensions."""
    found = tried(partial(read_array, path))
    return found is not None and found.ndim == dimensions and found.dtype.kind in "fiu" and min(found.shape) > 1

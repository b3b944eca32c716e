"""Guesses the layout of a folder from what its images show: stripes and waves of patterns, an object under lights, and what is neither."""

import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from stage.errors import ManifestError, storage
from stage.importers.camera_options import words_of
from stage.importers.content import SMOOTH, Pictures
from stage.importers.folder import UNKNOWN_LIGHTS, Folder, Guess, arrays_of, encoding, made, spelling
from stage.importers.pattern_order import GrayStack
from stage.importers.patterns import PROJECTOR_MATRIX, projector_size

PROJECTORS = ((1280, 800), (1920, 1080), (1024, 768), (1280, 720), (854, 480), (912, 1140), (800, 600), (1920, 1200), (640, 480),
              (3840, 2160))
"""Sizes of projectors, the more frequent first."""
STEADY = 0.05
"""Largest difference of the sums of images over their median at which they count as an image and its inverse, or as steps of a wave."""
ONE_PERIOD, MANY_PERIODS = 1.3, 4
"""Most periods that an image shows of a wave over the whole projector, and least ratio of the periods of both waves of SLStudio's 2x3."""
CENTRED = 0.06
"""Farthest that principal points of projectors lie from the middle of their columns, as a part of these: lenses are shifted upwards."""
METRES = 5.0
"""Distances of a camera from its projector that are longer are in millimetres."""
FOLLOWED = 0.5
"""Least correlation of the place of light on an object with the direction of the light."""
MOST_STEPS = 16
SURE_PHOTOS = 8
"""Images from which relit solve --lights unknown finds the lights."""
LEFT_WORDS, RIGHT_WORDS = frozenset({"left", "l", "cam0", "im0"}), frozenset({"right", "r", "cam1", "im1"})
FITTED = re.compile(r"plane_\d+\.(?:jpg|jpeg|png)|.*\.(?:ptm|rti|hsh)", re.IGNORECASE)
"""Names of files with fitted coefficients: those of Relight and of RTIBuilder's fitters."""
FEWEST_PHOTOS = 4
"""Images of one size that may be frames of one capture; fewer are likelier pictures of something."""


def followed(shown: Pictures, vectors: np.ndarray) -> tuple[float, float]:
    """Return how the bright side of the object moves with x and with y of the lights, as correlations; 0 where it cannot be told."""
    centres = shown.bright_sides()
    if len(centres) != len(vectors) or not (np.ptp(centres, axis=0) > 0).all() or not (np.ptp(vectors[:, :2], axis=0) > 0).all():
        return 0.0, 0.0
    across, up = (float(np.corrcoef(centres[:, axis], vectors[:, axis])[0, 1]) for axis in (0, 1))
    return across, up


def scanner(folder: Folder, shown: Pictures) -> Guess | None:
    """Return that images are those of a codec of SLStudio, whose calibration lies beside or above them."""
    count = len(folder.pictures)
    for path in folder.with_suffix(".xml", ".yml", ".yaml"):
        matrices = arrays_of(path)
        if not set(PROJECTOR_MATRIX) & set(matrices):
            continue
        size = projector_size(path)
        if size is None:
            continue
        bits = [min(most, (side - 1).bit_length()) for most, side in zip((10, 6), size, strict=True)]
        codecs = {2 + bits[0]: ("slstudio-gray", "column"), 2 + sum(bits): ("slstudio-gray", "both"), 6: ("slstudio-phase-2x3", "column"),
                  12: ("slstudio-phase-2x3", "both"), 3: ("slstudio-phase-3", "column"), 4: ("slstudio-phase-4", "column")}
        if count not in codecs or not _shows(shown, codecs[count][0]):
            continue
        codec, axis = codecs[count]
        return made("a scan of SLStudio", f"{path.name} is its calibration, and {count} images are those of {codec}",
                     ["scanner", folder.path, "--calibration", path, "--codec", codec, "--axis", axis, "--unit-m", "0.001"], folder.path,
                     solve=False, sure=True, assumed=("the calibration is in millimetres",))
    return None


def _shows(shown: Pictures, codec: str) -> bool:
    """Return whether images are those of a codec of SLStudio, of which several have as many."""
    if codec == "slstudio-gray":
        return shown.stripes() is not None
    if codec != "slstudio-phase-2x3":
        return True  # steps of a single wave
    fine, coarse = (shown.waves(shown.names[at:at + 3], 3)[1] for at in (0, 3))
    return shown.steady_sums(shown.names, 3, STEADY) and coarse <= ONE_PERIOD and fine >= MANY_PERIODS * coarse


def gray(folder: Folder, shown: Pictures) -> Guess | None:
    """Return that images are those of a Gray code; a plain binary code raises ManifestError."""
    stripes = shown.stripes()
    if stripes is None:
        return _half_lit(folder, shown)
    if stripes.binary:
        bits = f"{stripes.column_bits} bits of columns and {stripes.row_bits} of rows"
        raise ManifestError(f"{folder.path}: looks like a plain binary code, {bits}, whose stripes have edges in common: relit import "
                            "reads Gray codes; docs/capture.md shows the pattern binary")
    bits_of = {"columns": stripes.column_bits, "rows": stripes.row_bits}
    words, assumed, sure = _rig(folder, lambda size: all(bits in (0, (side - 1).bit_length())
                                                         for bits, side in zip(bits_of.values(), size, strict=True)),
                                " and ".join(f"{bits} bits of {name}" for name, bits in bits_of.items() if bits))
    plain = ("columns", "rows", "white", "black")
    inverses = {"pairs": "each second of which is the inverse of the one before",
                "first": "each first of two of which is the inverse of the one behind it", "blocks": "whose inverses follow all of an axis",
                "none": "without inverses"}[stripes.inverses]
    coded = " and ".join(part for part in plain[:2] if part in stripes.sequence)
    reason = f"{len(shown.names)} images of {coded} in two levels, {inverses}"
    chosen = [] if len(shown.others) == 0 else ["--images", spelling(shown.names[0])]
    if stripes.sequence == plain and stripes.inverses == "pairs" and not stripes.fine_first and not chosen and sure:
        return made("a Gray code in OpenCV's order", reason, ["opencv-gray", folder.path, *words], folder.path, solve=False, sure=True,
                    assumed=assumed, summary=f"{len(shown.names)} images of a Gray code in OpenCV's order")
    order = ["--sequence", ",".join(stripes.sequence), "--inverses", stripes.inverses, *(["--fine-first"] if stripes.fine_first else [])]
    return made("a Gray code", reason, ["gray", folder.path, *words, *order, *chosen], folder.path, solve=False, sure=sure, assumed=assumed,
                summary=f"{len(shown.names)} images of a Gray code")


def _half_lit(folder: Folder, shown: Pictures) -> Guess | None:
    """Return that images are in OpenCV's order by their number and inverses, where the object shows too little of the coarse stripes."""
    def fits(size: tuple[int, int]) -> bool:
        return len(GrayStack().entries(size)) == len(shown.names)

    if not any(map(fits, PROJECTORS)) or shown.others or not shown.inverses_in_pairs(shown.names[:-2]):
        return None
    words, assumed, _ = _rig(folder, fits, "")
    pairs = [(at, at + 1) for at in range(0, len(shown.names) - 2, 2)]
    bits = (int(str(words[1]).partition("x")[0]) - 1).bit_length()
    first, exchanged = shown.inverse_first(pairs[:bits], pairs[bits:]), shown.brighter(shown.names[-1], shown.names[-2])
    reason = f"{len(shown.names)} images, of each two of which one is the inverse of the other"
    if first or exchanged:
        sequence = "columns,rows,black,white" if exchanged else "columns,rows,white,black"
        return made("a Gray code", reason, ["gray", folder.path, *words, "--sequence", sequence, "--inverses",
                                            "first" if first else "pairs"], folder.path, solve=False, sure=True, assumed=assumed)
    return made("a Gray code in OpenCV's order", reason, ["opencv-gray", folder.path, *words], folder.path, solve=False, sure=True,
                assumed=assumed)


def _rig(folder: Folder, fits: Callable[[tuple[int, int]], bool], told: str) -> tuple[list[object], tuple[str, ...], bool]:
    """Return the options for the projector of a code and its calibration, what they assume, and whether the number of bits fits them.
    `fits`: whether a size of the projector has as many bits as the images, which show `told`."""
    for path in folder.with_suffix(".xml", ".yml", ".yaml", ".json"):
        matrices = arrays_of(path)
        if not set(PROJECTOR_MATRIX) & set(matrices):
            continue
        said = projector_size(path)
        size = said or _centred(matrices, [size for size in PROJECTORS if fits(size)])
        moved = next((matrices[name] for name in ("T", "Tp", "trans", "translation") if name in matrices), None)
        metres = moved is not None and float(np.linalg.norm(moved)) < METRES
        if size is not None and fits(size):
            middle = () if said is not None else (
                f"the projector has {size[0]}x{size[1]} pixels: these have as many bits, and {path.name} has its principal point near the "
                "middle of their columns",)
            return (["--projector", f"{size[0]}x{size[1]}", "--calibration", path, "--unit-m", "1" if metres else "0.001"],
                    (*middle, f"the calibration is in {'metres' if metres else 'millimetres'}, as the distance of the projector suggests"),
                    True)
    sizes = [f"{width}x{height}" for width, height in PROJECTORS if fits((width, height))]
    if not sizes:
        return ["--projector", "WIDTHxHEIGHT"], (f"WIDTHxHEIGHT is the projector in pixels; the images show {told}",), False
    others = "".join(f", as {size} pixels have too" for size in sizes[1:])
    return ["--projector", sizes[0]], (f"the projector has {sizes[0]} pixels, which have as many bits{others}",), True


def _centred(matrices: Mapping[str, np.ndarray], sizes: Sequence[tuple[int, int]]) -> tuple[int, int] | None:
    """Return the size of a projector in the middle of whose columns the principal point of its matrix lies; None of none."""
    matrix = next(matrices[name] for name in PROJECTOR_MATRIX if name in matrices)
    if matrix.shape != (3, 3):
        return None
    away = [abs(float(matrix[0, 2]) / width - 0.5) for width, _ in sizes]
    return sizes[away.index(min(away))] if min(away, default=1.0) < CENTRED else None


def phase(folder: Folder, shown: Pictures) -> Guess | None:
    """Return that images are steps of waves."""
    count = len(folder.pictures)
    if shown.inverses_in_pairs(shown.names):
        return None
    for steps in range(3, MOST_STEPS + 1):
        if count % steps == 0 and count > steps and shown.steady_sums(shown.names, steps, STEADY):
            groups = [shown.names[at:at + steps] for at in range(0, count, steps)]
            axis = shown.waves(groups[0], steps)[0]
            named = [re.match(r"[A-Za-z_]*?(\d+(?:\.\d+)?)[_-]", name) for name in shown.names[::steps]]
            numbers = [found.group(1) for found in named if found is not None]
            told = len(numbers) == len(groups) == len(set(numbers)) and all(float(number) > 2 for number in numbers)
            periods = ",".join(numbers if told else [f"P{n + 1}" for n in range(len(groups))])
            return made("phase shifts", f"the sums of each {steps} images are alike", [
                "phase", folder.path, "--projector", "WIDTHxHEIGHT", "--periods", periods, "--steps", steps,
                *(["--axis", axis] if axis == "row" else [])], folder.path, solve=False,
                summary=f"{count} images of phase shifts: {len(groups)} waves in {steps} steps", assumed=(
                    "WIDTHxHEIGHT is the projector in pixels" + ("" if told else ", P1 and so on are the periods in its pixels"),
                    *((f"the names of the images have the periods, {periods} pixels of the projector",) if told else ()),
                    f"the {axis}s are coded, and waves move to larger ones: else --axis and --shift"))
    return None


def photos(folder: Folder, shown: Pictures) -> Guess | None:
    """Return that images are those of an object under lights; images of something else are refused with what they look like."""
    left, right = (sum(bool(words_of(name) & words) for name in folder.pictures) for words in (LEFT_WORDS, RIGHT_WORDS))
    with storage("read", folder.path):
        children = {path.name.lower() for path in folder.path.iterdir() if path.is_dir()}
    if (left and left == right) or (children & LEFT_WORDS and children & RIGHT_WORDS):
        raise ManifestError(f"{folder.path}: looks like images of two cameras, left and right: docs/capture.md says how other_cameras and "
                            "stereo of a capture.json name them")
    fitted = [name for name in folder.names if FITTED.fullmatch(name)]
    if fitted:
        raise ManifestError(f"{folder.path}: {fitted[0]} looks like a coefficient image that was fitted to images under lights (RTI): "
                            "import those images with their light list, which relit basis fits anew")
    if shown.names and shown.size is not None and shown.size[0] == 2 * shown.size[1] and all(
            Path(name).suffix.lower() in (".exr", ".hdr") for name in shown.names):
        raise ManifestError(f"{folder.path}: {shown.names[0]} looks like an environment map, twice as wide as high: relit relight CAPTURE "
                            f"--environment {shlex.quote(str(folder.path / shown.names[0]))} takes it")
    if len(shown.names) < FEWEST_PHOTOS:
        return None
    if shown.two_valued():
        raise ManifestError(f"{folder.path}: its {len(shown.names)} images have two values each, as masks have: name the folder of the "
                            "photographs")
    left_over = shown.unexplained_by_lights()
    smooth = left_over <= SMOOTH
    found = made("images under lights of which nothing says where they were", f"{len(shown.names)} images of one size and no table; " + (
        f"three of them explain the others to {100 * left_over:.0f} %, as those of one object under far lights" if smooth else
        f"three of them leave {100 * left_over:.0f} % of the others unexplained, which is much for one object under far lights"),
        ["photos", folder.path, *(["--images", spelling(shown.names[0])] if shown.others else [])], folder.path, solve=True,
        sure=smooth and len(shown.names) >= SURE_PHOTOS and len({spelling(name) for name in shown.names}) == 1,
        summary=f"{len(shown.names)} photographs under lights of which nothing says where they were", assumed=(
            "each image has one far light of its own, and the camera stood still", *_left_out(shown), *encoding(folder)))
    return found._replace(then=found.then + UNKNOWN_LIGHTS)


def _left_out(shown: Pictures) -> tuple[str, ...]:
    """Return the sentence for images of another size, which are left out."""
    if not shown.others or shown.size is None:
        return ()
    return (f"{shown.others[0]}{' and others' if len(shown.others) > 1 else ''} of another size than {shown.size[0]}x{shown.size[1]} "
            "is left out",)

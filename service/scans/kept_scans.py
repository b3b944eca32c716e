"""Scans that are registered without being in memory: prepared once, kept as pieces of bytes, and read again for every pair."""

import io
import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.requests.register import RegisterOptions
from service.scans.pieces import SharedPieces
from service.scans.points.cloud import Cloud
from service.scans.points.neighbours import Neighbours
from service.scans.points.scan import Scan, Target
from service.scans.read import read_scan
from service.scans.registration.candidates import Outline, outline_of
from service.scans.registration.extent import extent_of
from service.scans.registration.fine import Fit, Rows
from service.scans.registration.found_targets import board_in, markers_in, placed
from service.scans.registration.free_space import DepthRange
from service.scans.registration.pair_tasks import PairTask, register_pair
from service.scans.registration.pairs import Evidence, Pair, PairState, Prepared, prepare
from stage.capture.camera import Camera
from stage.colour.colour import convert
from stage.errors import ManifestError
from stage.formats.images import check_resolution, read_pixels
from stage.formats.npy import packed
from stage.sets.scan_set import ScanEntry, ScanSet
from stage.stack.fingerprint import digest

POINT_BYTES = 250
"""Bytes of memory that a point of a prepared scan takes, with the tree of all."""


class ScanFacts(NamedTuple):
    """Facts of a scan that was read."""

    name: str
    content: str
    """Content hash of its file."""
    points: int
    sigma_m: float
    """The median."""
    sigma_source: str
    extent_m: float
    middle: np.ndarray  # [3] metres, the mean of the points
    pose: np.ndarray | None  # [4, 4] world_from_scan
    targets: tuple[Target, ...]
    found: int
    """Targets that were found in its image."""
    missed: str | None
    """The reason why none was, in words after its name; None: some were, or none were looked for."""


def facts_of(scan: Scan, file: Path, listed: ScanSet, number: int, options: RegisterOptions) -> ScanFacts:
    """Return the facts of a scan, with the targets that are listed and those that its image shows."""
    looked = with_found_targets(scan, listed.scans[number], options, file, f"{file}: scans[{number}] ({scan.name})")
    return ScanFacts(scan.name, digest(scan.path), len(scan.points), float(np.median(scan.sigma)), scan.sigma_source, extent_of(scan),
                     scan.points.mean(axis=0, dtype=np.float64), scan.pose, looked.targets, looked.found, looked.missed)


class KeptScans:
    """The scans of a set; `service.scans.registration.registration.ScanWork`."""

    def __init__(self, file: Path, listed: ScanSet, pieces: SharedPieces, *, memory_bytes: float, threads: int) -> None:
        """Create the scans, of which none is read yet.
        `memory_bytes`: that scans read again may take, beside those that threads are at work on. `threads`: scans and pairs at one time."""
        self._file, self._listed, self._pieces, self._threads = file, listed, pieces, threads
        self._most, self._held = memory_bytes, 0.0
        self._cache: OrderedDict[int, tuple[Prepared, float]] = OrderedDict()
        self._lock = threading.Lock()
        self._contents: tuple[str, ...] = ()
        self._prepared: Callable[[str], bytes] | None = None
        self._pair_files: dict[tuple[int, int], Callable[[], bytes]] = {}

    def facts(self, options: RegisterOptions, advance: Callable[[int], None]) -> list[ScanFacts]:
        """Read every scan once, and return what is to be known of all."""
        def made(piece: str) -> bytes:
            return _packed_facts(facts_of(self.scan(int(piece)), self._file, self._listed, int(piece), options))

        names = [f"{number:05d}" for number in range(len(self._listed.scans))]
        read = self._pieces.do("read", names, made, threads=self._threads, follows_from=(options.markers, options.board), advance=advance)
        facts = [_unpacked_facts(read(name)) for name in names]
        self._contents = tuple(each.content for each in facts)
        return facts

    def outlines(self, cells: dict[int, float], advance: Callable[[float], None]) -> dict[int, Outline]:
        """Prepare scans and return their outlines."""
        def made(piece: str) -> bytes:
            return packed_scan(prepare(self.scan(int(piece)), cell_m=cells[int(piece)]))

        names = {number: f"{number:05d}" for number in cells}
        self._prepared = self._pieces.do("prepare", list(names.values()), made, threads=self._threads,
                                         follows_from=(self._contents, tuple(cells.items())),
                                         advance=lambda done: advance(done / max(len(names), 1)))
        return {number: outline_of(self.ready(number), cells[number]) for number in cells}

    def ready(self, number: int) -> Prepared:
        """Return a scan that was prepared."""
        with self._lock:
            if number in self._cache:
                self._cache.move_to_end(number)
                return self._cache[number][0]
        assert self._prepared is not None
        ready = unpacked_scan(self._prepared(f"{number:05d}"))
        size = float(POINT_BYTES * (len(ready.fine.points) + len(ready.rough.points)))
        size += 0 if ready.image is None else 2.0 * ready.image.nearest.nbytes
        with self._lock:
            if number not in self._cache:
                self._cache[number] = ready, size
                self._held += size
            while self._held > self._most and len(self._cache) > 1:
                self._held -= self._cache.popitem(last=False)[1][1]
        return ready

    def pairs(self, tasks: Sequence[PairTask], cells: dict[int, float], least_overlap: float, advance: Callable[[float], None]
              ) -> list[Pair]:
        """Register pairs; they are without their rows."""
        if not tasks:
            return []
        by_name = {f"{task.a:05d}-{task.b:05d}": task for task in tasks}

        def made(piece: str) -> bytes:
            task = by_name[piece]
            return packed_pair(register_pair(task, self.ready(task.a), self.ready(task.b), cell_m=(cells[task.a], cells[task.b]),
                                             least_overlap=least_overlap))

        content = self._pieces.do("pairs", list(by_name), made, threads=self._threads,
                                  follows_from=(self._contents, least_overlap, tuple(tuple(task) for task in tasks)),
                                  advance=lambda done: advance(done / len(by_name)))
        found = []
        for name, task in by_name.items():
            found.append(unpacked_pair(content(name)))
            self._pair_files[task.a, task.b] = partial(content, name)
        return found

    def rows(self, pair: Pair) -> Rows:
        """Return the matched points of a pair."""
        with np.load(io.BytesIO(self._pair_files[pair.a, pair.b]()), allow_pickle=False) as found:
            return Rows(*(found[f"rows_{name}"] for name in ROWS))

    def scan(self, number: int) -> Scan:
        """Read a scan; its normals are those of its file, or not there."""
        return read_scan(self._file, self._listed, number)


def _packed_facts(facts: ScanFacts) -> bytes:
    plain = facts._asdict() | {"middle": facts.middle.tolist(),
                               "pose": None if facts.pose is None else facts.pose.tolist(),
                               "targets": [(name, place.tolist(), spread.tolist()) for name, place, spread in facts.targets]}
    return json.dumps(plain).encode()


def _unpacked_facts(content: bytes) -> ScanFacts:
    plain = json.loads(content)
    return ScanFacts(**(plain | {"middle": np.array(plain["middle"]),
                                 "pose": None if plain["pose"] is None else np.array(plain["pose"]),
                                 "targets": tuple(Target(name, np.array(place), np.array(spread))
                                                  for name, place, spread in plain["targets"])}))


class Looked(NamedTuple):
    """The targets of a scan, and those among them that were found in its image."""

    targets: tuple[Target, ...]
    found: int
    missed: str | None
    """The reason why it shows none, in words after its name; None: it shows some, or none was looked for."""


def with_found_targets(scan: Scan, entry: ScanEntry, options: RegisterOptions, file: Path, where: str) -> Looked:
    """Return the targets of a scan with the markers and board corners that its image shows."""
    if options.markers is None and options.board is None:
        return Looked(scan.targets, 0, None)
    if scan.camera is None:
        if entry.image is not None:
            raise ManifestError(f"{where}: image: {entry.path} is a set of points: an image belongs to a range image")
        return Looked(scan.targets, 0, "is a set of points: markers and boards are looked for in range images")
    if entry.image is not None:
        path = file.parent / entry.image
        check_resolution(path, scan.camera.resolution, declared="the depth")
        image = read_pixels(path).astype(np.float32).mean(axis=-1)
    elif scan.colours is not None:
        image = convert(scan.image(scan.colours).astype(np.float32) / 255, "srgb_rec709_scene", "lin_rec709_scene").mean(axis=-1)
    else:
        return Looked(scan.targets, 0, "has neither an image nor colours in which markers or a board could be found")
    points = ([] if options.markers is None else markers_in(image, options.markers.value)) + (
        [] if options.board is None else board_in(image, options.board))
    found = placed(points, scan)
    both = {target.name for target in scan.targets} & {target.name for target in found}
    if both:
        raise ManifestError(f"{where}: targets: {min(both)} is listed, and found in the image too: leave out one of them")
    missed = None if found else "no marker or board is found in its image" if not points else (
        f"{len(points)} marks are found in its image, but too few depths around them")
    return Looked((*scan.targets, *found), len(found), missed)


CLOUD = ("points", "normals", "near_normals", "directions", "sigma", "spacing")
"""The arrays of a cloud that are stored in single precision, as scans are."""
FIT = ("pose", "pivot", "doubt", "information", "normal", "noise", "bend", "even_bend", "residual", "ratio", "together", "scale",
       "scale_sigma", "matches")
ROWS = tuple(Rows._fields)


def packed_scan(ready: Prepared) -> bytes:
    """Return a prepared scan as bytes, its coordinates in single precision."""
    arrays: dict[str, Any] = {"features": ready.features, "area": ready.area}
    for which, cloud in (("rough", ready.rough), ("fine", ready.fine)):
        arrays |= {f"{which}_{name}": getattr(cloud, name).astype(np.float32) for name in CLOUD}
        arrays |= {f"{which}_border": cloud.border, f"{which}_sample": cloud.sample.astype(np.int32)}
    if ready.image is not None:
        arrays |= {"nearest": ready.image.nearest, "farthest": ready.image.farthest, "step": ready.image.step,
                   "camera": np.frombuffer(ready.image.camera.model_dump_json(by_alias=True).encode(), dtype=np.uint8)}
    return packed(arrays)


def unpacked_scan(content: bytes) -> Prepared:
    """Return the scan of `packed_scan`."""
    with np.load(io.BytesIO(content), allow_pickle=False) as found:
        image = None
        if "camera" in found.files:
            camera = Camera.model_validate_json(found["camera"].tobytes())
            image = DepthRange(camera, int(found["step"]), found["nearest"], found["farthest"])
        return Prepared(rough=_cloud(found, "rough"), fine=_cloud(found, "fine"), features=found["features"], image=image,
                        area=float(found["area"]))


def _cloud(found: Mapping[str, np.ndarray], which: str) -> Cloud:
    arrays = {name: found[f"{which}_{name}"].astype(np.float64) for name in CLOUD}
    return Cloud(**arrays, border=found[f"{which}_border"], sample=found[f"{which}_sample"].astype(np.int64),
                 tree=Neighbours(arrays["points"]))


def packed_pair(pair: Pair) -> bytes:
    """Return a pair as bytes, with its rows."""
    known = {"a": pair.a, "b": pair.b, "state": pair.state.value, "overlap": pair.overlap, "contradicted": pair.contradicted,
             "reason": pair.reason, "by": pair.by.value}
    arrays: dict[str, Any] = {"known": np.frombuffer(json.dumps(known).encode(), dtype=np.uint8)}
    if pair.fit is not None:
        assert pair.fit.rows is not None
        arrays |= {name: np.asarray(getattr(pair.fit, name), dtype=np.float64) for name in FIT}
        arrays |= {f"rows_{name}": getattr(pair.fit.rows, name) for name in ROWS}
    return packed(arrays)


def unpacked_pair(content: bytes) -> Pair:
    """Return the pair of `packed_pair` without its rows."""
    with np.load(io.BytesIO(content), allow_pickle=False) as found:
        known = json.loads(found["known"].tobytes())
        fit = None
        if "pose" in found.files:
            values = {name: found[name] for name in FIT}
            numbers = {name: float(value) for name, value in values.items() if value.ndim == 0}
            fit = Fit(**(values | numbers | {"matches": int(numbers["matches"]), "rows": None}))
    return Pair(**(known | {"state": PairState(known["state"]), "by": Evidence(known["by"]), "fit": fit}))

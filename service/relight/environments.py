"""Environment maps, one for all frames or one for each: the headers of all are checked at the start, and a map is read when its first frame
is made."""

import re
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

import numpy as np

from kernels.relight.weights.environment_sources import EnvironmentParts, EnvironmentSamples, sample_environment, split_environment
from service.errors import RequestError
from service.requests.light.frame_range import numbered
from stage.colour.environment_maps import check_environment, full_sentences, multiplied_sentences, outside_sentences, read_environment
from stage.formats.images import read_header
from stage.stack import fingerprint

SHARP_RADIUS_DEGREES = 2.0
"""Largest angular radius of a map's sample that casts shadows of its own: small samples lie where the map is bright. The visibility of
other samples is interpolated from the captured lights around them."""

RADIANS, SAME_TURN = (np.pi / 2, np.pi, 2 * np.pi, 4 * np.pi), 0.002
"""Turns in radians, and the part by which a turn in degrees is near one, with which it is said: 1.57, 3.14 and 6.28 are."""
FEW_ROWS = 16
"""Number of rows below which it is said that texels count by their middle, which makes an even map of 16 rows 0.2 % brighter."""


class EnvironmentMap:
    """An environment map in a working space."""

    def __init__(self, radiance: np.ndarray) -> None:
        """Take the radiance of a map, [rows, cols, 3] float32, scene-linear."""
        self.radiance = radiance
        self.folded: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        """Directions and energies of samples that pixels were joined to, by their most rows; service/drive/judgement.py makes them."""

    @cached_property
    def samples(self) -> EnvironmentSamples:
        """The samples of the environment map, for a model of a surface."""
        return sample_environment(self.radiance)

    @cached_property
    def parts(self) -> EnvironmentParts:
        """The small bright places of the environment map, and the rest."""
        return split_environment(self.radiance, np.radians(SHARP_RADIUS_DEGREES))


class Environments:
    """The environment maps of `--environment`: a file, or a sequence of files where the name has a run of #."""

    def __init__(self, pattern: Path, *, clip_negative: bool = False, spin_degrees: float = 0.0) -> None:
        """Keep the path of the maps, as it was given, and how far they turn over a range of frames, for what is doubtful about that.

        With `clip_negative`, values that are negative beyond the noise of their map are set to 0; else such maps are refused.
        """
        self._pattern, self._spin_degrees = pattern, spin_degrees
        self._sequence = "#" in str(pattern) and not pattern.is_file()
        self.clipped: dict[str, int] | None = {} if clip_negative else None
        """The number of pixels with a value that was set to 0, by the names of the maps that were read so far; None: such are refused."""
        self.outside: dict[str, float] = {}
        """The part of the light that colours outside of the working space gain, by the names of the maps that were read so far."""
        self._full: dict[str, float] = {}
        self._encodings: dict[str, str] = {}
        self._multiplied: dict[str, float] = {}
        self._rows: dict[str, int] = {}
        self._digests: dict[Path, str] = {}
        self._last: tuple[Path, str, EnvironmentMap] | None = None
        if self._sequence and (len(re.findall("#+", pattern.name)) != 1 or "#" in str(pattern.parent)):
            raise RequestError(f"--environment {pattern}: the file name of a sequence has one run of # for the frame number")

    def path(self, number: int) -> Path:
        """Return the file of a frame's environment map."""
        return self._pattern.with_name(numbered(self._pattern.name, number)) if self._sequence else self._pattern

    def check(self, numbers: Iterable[int]) -> None:
        """Check that the environment map of every frame is there, by its header an EXR or HDR file, and twice as wide as high."""
        for path, number in {self.path(number): number for number in numbers}.items():
            if self._sequence and not path.exists():
                raise RequestError(f"--environment {self._pattern}: frame {number} has no map: {path} is not there")
            check_environment(path)

    def read(self, path: Path, space: str) -> EnvironmentMap:
        """Return one environment map in a working space; the last one that was read is kept."""
        if self._last is None or self._last[:2] != (path, space):
            radiance = read_environment(path, space, clipped=self.clipped, outside=self.outside, full=self._full,
                                        encodings=self._encodings)
            self._last = (path, space, EnvironmentMap(radiance))
            self._multiplied[path.name] = read_header(path).multiplied
            self._rows[path.name] = len(self._last[2].radiance)
        return self._last[2]

    def doubts(self) -> list[str]:
        """Return a sentence for each thing that makes the light of the maps that were read so far another one than theirs."""
        found = outside_sentences(self.outside, "environment", "the working space",
                                  "give images, or lamps, in a wider space, or a map without such colours")
        found += [*full_sentences(self._full), *list(self._encodings.values())[:1], *multiplied_sentences(self._multiplied)]
        for turn in RADIANS:
            if abs(abs(self._spin_degrees) / turn - 1) < SAME_TURN:
                found.append(f"--spin-degrees {self._spin_degrees:g}: looks like a turn in radians, and is taken in degrees: give "
                             f"{np.copysign(np.degrees(turn), self._spin_degrees):.0f} for that turn")
        fewest = min(self._rows, key=lambda name: self._rows[name], default=None)
        if fewest is not None and (rows := self._rows[fewest]) < FEW_ROWS:
            half = np.pi / (2 * rows)
            found.append(f"environment {fewest}: has {rows} rows, which count with the height of their middle: an even map is "
                         f"{100 * (half / np.sin(half) - 1):.2g} % too bright; give {FEW_ROWS} rows or more")
        return found

    def content(self, path: Path) -> str:
        """Return the content hash of an environment map."""
        if path not in self._digests:
            self._digests[path] = fingerprint.digest(path)
        return self._digests[path]

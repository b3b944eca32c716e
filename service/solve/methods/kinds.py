"""What the pixels of an object share, its diffuse lobe and its materials, and what those of a part share that is another thing.

Diffuse reflection differs from material to material. Under the lobe of the rest of the object, a pixel of another thing trades what the
lobe lacks for a tilted normal and a wide, far too bright highlight, and is sure of both. The shape of the lobe cannot be told from one
pixel, but from those of one part, which the steps of the height separate: a part that another lobe explains clearly better has a lobe and
materials of its own.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from kernels.photometric.material.material import fit_material
from kernels.photometric.material.metal_energy import with_whole_energy
from kernels.photometric.material.metal_search import Metals, metals_of
from kernels.photometric.material.mixtures import NO_PAIRS, choose_pairs
from kernels.photometric.material.shared_materials import choose_materials
from kernels.photometric.model.samples import Samples, evenly
from kernels.photometric.search.hypotheses import LobeShape
from kernels.photometric.search.lobe_shape import ShapeSpread, choose_lobe_shape
from kernels.photometric.search.normal_search import find_normals
from kernels.photometric.search.survey import QUICK

MATERIAL_PIXELS = 640
"""Pixels, spread over the object, from which the shared materials are chosen: an object has more materials than diffuse lobes."""
STRETCH = 9
"""Most neighbouring pixels of which the one with the smoothest surface is one of these: where normals turn within a pixel, they widen its
highlight. On the shipped owl, whose feathers turn them by 11° from pixel to pixel, roughness is 0.03 too high without this."""
LOBE_PIXELS = 384
"""Most pixels of an object or a part, spread over it, from which the shape of its lobes is chosen."""
LEAST_PIXELS, LEAST_SHARE = 192, 0.01
"""Pixels that face the camera, and share of those of the object, that a part has whose lobe is chosen: fewer do not tell shapes apart."""
MOST_PARTS = 16
"""Most parts, the largest, whose lobe is chosen: each takes 0.2 s on two cores."""
FACING = 0.5
"""Least z of a normal that faces the camera. What is wrong with normals at a rim passes for another lobe: of a sliver along that of a real
ball, another one saved 14 % of the cost."""
OWN = 0.9
"""Part of the cost under the object's lobe to which one of its own must lower that of a part."""

FACETS = "diffuse_facets"
"""The name of the ratio of facets in what the report says of a lobe."""
Read = Callable[[np.ndarray], Samples]
"""A function from positions of pixels to their direct light."""
READ_AT_ONCE = 4096
"""Pixels whose direct light is read at one time."""


class Kind(NamedTuple):
    """What pixels share."""

    shape: LobeShape
    """The shape of the lobes under which normals are found."""
    lobe: LobeShape
    """The shape under which materials are fitted."""
    spread: ShapeSpread
    """That of the shapes that `shape` is the mean of."""
    materials: np.ndarray | None = None  # [materials, 4] F0 and roughness; None: every pixel has a material of its own
    metals: Metals | None = None
    pairs: np.ndarray = NO_PAIRS  # [pairs, 2, 4] materials that pixels mix

    def with_materials(self, pixels: np.ndarray, read: Read, normal: np.ndarray, width: int, *, metals: bool, mixtures: bool) -> "Kind":
        """Return the same with the materials that some pixels share.

        Args:
            pixels: [n] ascending positions of those that have this lobe.
            normal: [3, pixels of the image] found so far.
            width: of the image.
            metals: whether normals are searched under shared metals.
            mixtures: whether a pixel may have two materials.
        """
        if not len(pixels):
            return self
        spread = smoothest(pixels, normal, width)
        samples = read(spread)
        # the first search saw bounced light, and a lobe would explain what its normals do not
        found = find_normals(samples, normal[:, spread].T, shape=self.shape, sweep=QUICK).best.normal
        materials = choose_materials(samples, found, shape=self.lobe)
        single = fit_material(samples, found, shape=self.lobe, shared=materials)
        if (brighter := with_whole_energy(samples, found, materials, single, shape=self.lobe)) is not None:
            materials, single = brighter, fit_material(samples, found, shape=self.lobe, shared=brighter)
        return self._replace(materials=materials, metals=metals_of(materials, single) if metals else None,
                             pairs=choose_pairs(samples, found, materials, single, shape=self.lobe) if mixtures else NO_PAIRS)

    def report(self) -> dict[str, object]:
        """Return what the report says of it."""
        return {**lobe_report(self.lobe), "shared_materials": [] if self.materials is None else material_report(self.materials)}


class Kinds:
    """The kind of each pixel."""

    def __init__(self, whole: Kind, pixels: int) -> None:
        """Let all `pixels` of the image be of one kind."""
        self.kinds = [whole]
        self.which = np.zeros(pixels, np.uint8)
        """[pixels] The place of each pixel's kind among `kinds`."""

    def tell_apart(self, part: np.ndarray, solvable: np.ndarray, read: Read, normal: np.ndarray) -> None:
        """Give parts that another lobe explains clearly better a kind of their own.

        Args:
            part: [pixels] uint8 number of the part of each pixel, 0 outside.
            solvable: [n] ascending positions of the pixels that are solved.
            normal: [3, pixels] found so far.
        """
        facing = solvable[normal[2, solvable] > FACING]
        counts = np.bincount(part[facing], minlength=1)
        numbers = np.flatnonzero(counts[1:]) + 1
        if len(numbers) < 2:
            return
        usual = self.kinds[0].lobe
        large = numbers[counts[numbers] >= max(LEAST_PIXELS, LEAST_SHARE * len(facing))]
        for number in large[np.argsort(-counts[large], kind="stable")][:MOST_PARTS]:
            spread = facing[part[facing] == number]
            spread = spread[evenly(len(spread), LOBE_PIXELS)]
            found = choose_lobe_shape(read(spread), normal[:, spread].T, beside=usual)
            if found.tried[found.best] < OWN * found.tried[usual]:
                self.which[part == number] = len(self.kinds)
                self.kinds.append(Kind(found.mean, found.best, found.spread))

    def find_materials(self, solvable: np.ndarray, read: Read, normal: np.ndarray, width: int, *, metals: bool, mixtures: bool) -> None:
        """Find the materials of each kind, as `Kind.with_materials` does."""
        self.kinds = [kind.with_materials(solvable[self.which[solvable] == number], read, normal, width, metals=metals, mixtures=mixtures)
                      for number, kind in enumerate(self.kinds)]

    @property
    def pairs(self) -> np.ndarray:
        """Return the pairs of all kinds, [pairs, 2, 4], one kind after another."""
        return np.concatenate([kind.pairs for kind in self.kinds])

    def groups(self, pixels: np.ndarray) -> Iterator[tuple[np.ndarray, Kind, int]]:
        """Yield places in `pixels`, [n] positions in the image, that are of one kind, this kind, and the place of its first pair."""
        for number in np.unique(self.which[pixels]):
            yield (np.flatnonzero(self.which[pixels] == number), self.kinds[number],
                   sum(len(kind.pairs) for kind in self.kinds[:number]))


def smoothest(pixels: np.ndarray, normal: np.ndarray, width: int) -> np.ndarray:
    """Return MATERIAL_PIXELS of some pixels, or all of fewer: of each stretch the one whose normal is most like those beside it.

    Args:
        pixels: [n] ascending positions, one or more.
        normal: [3, pixels of the image], 0 where there is none.
        width: of the image; beyond its border, neighbours are those of the next row.
    """
    stretch = int(np.clip(len(pixels) // MATERIAL_PIXELS, 1, STRETCH))
    tried = pixels[evenly(len(pixels), MATERIAL_PIXELS * stretch)]
    beside = np.clip(tried + np.array([-width, -1, 1, width])[:, None], 0, normal.shape[1] - 1)
    alike = np.einsum("cn,csn->n", normal[:, tried], normal[:, beside]).reshape(-1, stretch)
    return tried.reshape(-1, stretch)[np.arange(len(alike)), alike.argmax(axis=1)]


def lobe_report(lobe: LobeShape) -> dict[str, float | None]:
    """Return what the report says of lobes: roughness (None for Lambert's), slope and facets of the diffuse one, tails of highlights."""
    return {"diffuse_roughness": None if lobe.rough < 0 else lobe.rough, "diffuse_slope": lobe.slope, FACETS: lobe.facets,
            "short_tails": lobe.short_tails}


def material_report(materials: np.ndarray) -> list[dict[str, object]]:
    """Return what the report says of shared materials, [materials, 4] F0 and roughness."""
    return [{"specular": material[:3].tolist(), "roughness": float(material[3])} for material in materials.round(4).astype(float)]

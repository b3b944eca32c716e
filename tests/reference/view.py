"""A reader of relit.view/1, which knows the format by its documentation alone."""

import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np


class View:
    """The files of a view."""

    def __init__(self, folder: Path) -> None:
        """Read view.json and view.bin."""
        self.facts: dict[str, Any] = json.loads((folder / "view.json").read_text())
        self.bytes = (folder / "view.bin").read_bytes()

    def block(self, place: list[int], dtype: str, *shape: int) -> np.ndarray:
        """A compressed block."""
        offset, length = place
        values = np.frombuffer(zlib.decompress(self.bytes[offset : offset + length]), dtype=np.dtype(dtype).newbyteorder("<"))
        return values.reshape(shape)

    def layer(self, name: str) -> dict[str, Any]:
        """What view.json says of a layer."""
        return next(layer for layer in self.facts["layers"] if layer["name"] == name)

    def image(self, name: str, level: int = 0) -> np.ndarray:
        """[channels, rows, cols] of a level, put together from its tiles."""
        layer = self.layer(name)
        facts, channels = layer["levels"][level], len(layer["channels"])
        rows, cols, side = facts["rows"], facts["cols"], facts["tile"]
        image = np.full((channels, rows, cols), np.nan, dtype=layer["dtype"])
        places = iter(facts["tiles"])
        for row in range(0, rows, side):
            for col in range(0, cols, side):
                height, width = min(side, rows - row), min(side, cols - col)
                image[:, row : row + height, col : col + width] = self.block(next(places), layer["dtype"], channels, height, width)
        assert next(places, None) is None
        return image

    def basis(self) -> np.ndarray:
        """[terms, 3, rows, cols] float64 coefficient images."""
        facts = self.facts["relight"]
        return np.stack([self.block(place, "f2", 3, facts["rows"], facts["cols"]) for place in facts["basis"]]).astype(np.float64)

    def lit(self, weights: np.ndarray) -> np.ndarray:
        """[rows, cols, 3] the picture of weights [lights, 3] of the captured images."""
        return self.drawn(np.einsum("ltkc,lc->tkc", self.captured(), weights))

    def drawn(self, coefficients: np.ndarray) -> np.ndarray:
        """[rows, cols, 3] the picture of coefficients [tiles, terms, 3]."""
        facts, basis = self.facts["relight"], self.basis()
        picture = np.zeros((facts["rows"], facts["cols"], 3))
        side, tiles = facts["tiles"]["side"], self.tiles()
        for row, col in np.argwhere(tiles != 0xFFFF):
            place = np.s_[row * side : (row + 1) * side, col * side : (col + 1) * side]
            picture[place] = np.einsum("kcrq,kc->rqc", basis[:, :, *place], coefficients[tiles[row, col]])
        return picture

    def tiles(self) -> np.ndarray:
        """[rows of tiles, columns of tiles] index of each tile."""
        facts = self.facts["relight"]["tiles"]
        return self.block(facts["index"], "u2", facts["rows"], facts["cols"])

    def captured(self) -> np.ndarray:
        """[lights, tiles, terms, 3] float64 coefficients of the captured images."""
        facts = self.facts["relight"]
        return self.block(facts["captured"], "f2", -1, facts["tiles"]["count"], facts["terms"], 3).astype(np.float64) * facts["scale"]

    def weights(self) -> np.ndarray:
        """[rows, cols, lights, 3] weights of the captured images for a unit of irradiance from each direction of the grid."""
        cols, rows = self.facts["relight"]["directions"]
        return self.block(self.facts["relight"]["weights"], "f4", rows, cols, -1, 3).astype(np.float64)

    def samples(self, name: str) -> np.ndarray:
        """[rows, cols, lights, 3] float64 of `measured` or `model`, times the scale; [rows, cols, lights] uint8 of `used`."""
        facts = self.facts["samples"]
        shape = facts["rows"], facts["cols"], facts["lights"]
        if name == "used":
            return np.frombuffer(self.bytes, np.uint8, int(np.prod(shape)), facts[name]).reshape(shape)
        values = np.frombuffer(self.bytes, np.dtype("<f2"), 3 * int(np.prod(shape)), facts[name])
        return values.reshape(*shape, 3).astype(np.float64) * facts["scale"]

"""Prepared scans and registered pairs as bytes, so that they can lie on a disk while others are worked on."""

import io
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from service.scans.points.cloud import Cloud
from service.scans.points.neighbours import Neighbours
from service.scans.registration.fine import Fit, Rows
from service.scans.registration.free_space import DepthRange
from service.scans.registration.pairs import Evidence, Pair, PairState, Prepared
from stage.capture.camera import Camera
from stage.formats.npy import packed

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


def unpacked_rows(content: bytes) -> Rows:
    """Return the rows of a pair of `packed_pair`."""
    with np.load(io.BytesIO(content), allow_pickle=False) as found:
        return Rows(*(found[f"rows_{name}"] for name in ROWS))

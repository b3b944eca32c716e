"""The route of small pictures of results: an EXR file as a browser shows it, for players and filmstrips."""

import tempfile
from pathlib import Path
from typing import Annotated, Any

import anyio.to_thread
from fastapi import APIRouter, Depends, Response

from service.server.api.problems import ApiError, responses
from service.server.api.results import Opened, Tags, headers_of, opened, unchanged

router = APIRouter(prefix="/v1/jobs/{job}/pictures", tags=["results"], responses=responses(401, 403, 404, 412, 422, 429, 503))
SIDE = 512
"""Longest side of a picture, pixels."""
MOST_VALUES = 4 * 36_000_000
"""Values of a file that is decoded for a picture, in all of its channels: those of a frame of 8K with coverage."""
BACKDROP = 0.2
"""Display value of the grey behind the object, as on the page that relights."""
QUALITY = 85
JPEG: dict[int | str, dict[str, Any]] = {200: {"description": "The picture.", "content": {"image/jpeg": {
    "schema": {"type": "string", "format": "binary"}}}}, 304: {"description": "If-None-Match names the file as it is."}}
one_at_a_time = anyio.CapacityLimiter(1)
"""Held while a file is decoded, so that a player asks for the memory of one; those that wait hold no thread of other requests."""


@router.get("/{name:path}", responses=JPEG, response_class=Response, summary="See a small picture of a result")
async def result_picture(file: Annotated[Opened, Depends(opened)], if_match: Tags = None, if_none_match: Tags = None) -> Response:
    """Send an EXR file as a JPEG of at most 512 × 512 pixels: linear light clipped and encoded as sRGB, over a neutral grey."""
    from stage.errors import StageError

    headers = headers_of(file) | {"Content-Disposition": "inline"}
    del headers["Accept-Ranges"]
    if unchanged(file, if_match, if_none_match):
        return Response(status_code=304, headers=headers)
    if not file.name.lower().endswith(".exr"):
        raise ApiError("invalid", f"{file.name} is no EXR file, of which there are pictures")
    try:
        picture = await anyio.to_thread.run_sync(_jpeg, Path(f"/proc/self/fd/{file.descriptor}"), file.name, limiter=one_at_a_time)
    except (StageError, ValueError) as error:
        raise ApiError("invalid", f"{file.name}: cannot be shown: it is damaged, or its colours are those of no known space") from error
    return Response(picture, media_type="image/jpeg", headers=headers)


def _jpeg(path: Path, name: str) -> bytes:
    import numpy as np

    from stage.colour.colour import convert
    from stage.formats import exr
    from stage.formats.images import write_jpeg

    header = exr.read_header(path)
    if not {"R", "G", "B"} <= set(header.channels) or header.width * header.height * len(header.channels) > MOST_VALUES:
        raise ApiError("invalid", f"{name} has no R, G and B, or more than {MOST_VALUES:,} values in its channels")
    channels, metadata = exr.read(path)
    step = -(-max(header.width, header.height) // SIDE)

    def reduced(plane: np.ndarray) -> np.ndarray:
        known = np.where(np.isfinite(plane), plane, 0).astype(np.float32)
        starts = [np.arange(0, side, step) for side in known.shape]
        sums = np.add.reduceat(np.add.reduceat(known, starts[0], axis=0), starts[1], axis=1)
        counts = [np.diff([*start, side]) for start, side in zip(starts, known.shape, strict=True)]
        return np.asarray(sums / np.outer(*counts))

    colour = np.stack([reduced(channels[each]) for each in "RGB"], axis=-1)
    cover = np.clip(reduced(channels["A"]), 0, 1) if "A" in channels else np.ones(colour.shape[:2], np.float32)
    shown = convert(np.clip(colour, 0, 1).astype(np.float32), exr.color_space_of(metadata), "srgb_texture")
    shown = shown + BACKDROP * (1 - cover[..., None])
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "picture.jpg"
        write_jpeg(target, np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8), QUALITY, subsampled=True)
        return target.read_bytes()

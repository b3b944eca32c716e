"""A manifest of IIIF Presentation 3: photographs, relit pictures and maps of a capture as choices on canvases, with static image tiles.

Source: IIIF Presentation API 3.0; IIIF Image API 3.0, compliance level 0; the physical dimensions service of the IIIF annexes.
"""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels.device import to_numpy
from kernels.relight.frames.combine import combine_batch
from service.basis.capture import BasisCapture, Display, srgb, stack_bands
from service.errors import RequestError
from service.publish.annotations import Annotation
from service.publish.components import light_spacing, light_weights
from service.publish.pyramid import TILE, Pyramid, halvings, size_at, write_jpeg
from service.publish.strips import Strips
from service.reporting.progress import Timings
from service.requests.publish import DEFAULT_PHOTOGRAPHS, PublishRequest
from service.viewing.result_layers import ResultLayers
from stage.files import write_text
from stage.results.light_basis import numbers

MANIFEST_FILE = "manifest.json"
FACTS = {"relit:version": "Version", "relit:inputs": "Inputs", "relit:ocio": "Colour configuration",
         "relit:ocio_cache_id": "OpenColorIO cache id"}
"""The entries of the provenance that the manifest has, and their labels."""
SMALL_SIDE = 1024
"""The longest side of images that are there whole."""
THUMBNAIL_SIDE = 256
RELIT = {"light from the left": (-0.7, 0.2, 0.69), "light from above": (0.0, 0.7, 0.71), "light from the right": (0.7, 0.2, 0.69),
         "light from below": (0.0, -0.7, 0.71), "raking light from the left": (-0.94, 0.0, 0.34)}
"""The directions of the relit pictures, x right, y up, z towards the camera; those that are farther from each captured light than these are
from one another are left out."""
LAYERS = {"diffuse_albedo": "albedo", "normal": "normals"}
"""The layers of maps that are shown."""


class _Picture(NamedTuple):
    name: str
    label: str


class _Images:
    """The images of a publication, each with its service."""

    def __init__(self, folder: Path, source: BasisCapture, request: PublishRequest) -> None:
        self._folder, self._quality = folder, request.quality
        self._url = (request.url or "").rstrip("/")
        camera = source.capture.camera
        self.width, self.height = camera.width, camera.height
        self._levels = 1 + halvings(self.width, self.height, TILE)
        self._most = size_at(self.width, self.height, halvings(self.width, self.height, SMALL_SIDE))

    def pyramid(self, name: str) -> Pyramid:
        """Return the pyramid of an image, and write its info.json."""
        small = [size for k in range(self._levels) if max(size := size_at(self.width, self.height, k)) <= SMALL_SIDE]
        write_text(self._folder / name / "info.json", json.dumps({
            "@context": "http://iiif.io/api/image/3/context.json", **self.service(name), "protocol": "http://iiif.io/api/image",
            "width": self.width, "height": self.height, "maxWidth": self._most[0], "maxHeight": self._most[1],
            "sizes": [{"width": width, "height": height} for width, height in reversed(small)],
            "tiles": [{"width": TILE, "height": TILE, "scaleFactors": [1 << k for k in range(self._levels)]}]}, indent=1) + "\n")

        def keep(halving: int, image: np.ndarray) -> None:
            write_jpeg(self._image(name, *size_at(self.width, self.height, halving)), image, self._quality)
            if image.shape[1::-1] == self._most:
                write_jpeg(self._folder / name / "full" / "max" / "0" / "default.jpg", image, self._quality)

        def tile(halving: int, column: int, row: int) -> Path:
            side = TILE << halving
            x, y = column * side, row * side
            width, height = min(side, self.width - x), min(side, self.height - y)
            across, down = size_at(width, height, halving)
            return self._folder / name / f"{x},{y},{width},{height}" / f"{across},{down}" / "0" / "default.jpg"

        return Pyramid(self.width, self.height, tile, levels=self._levels, quality=self._quality, small=keep, small_side=SMALL_SIDE)

    def service(self, name: str) -> dict[str, str]:
        """Return what manifests say of an image's service."""
        return {"id": f"{self._url}/{name}", "type": "ImageService3", "profile": "level0"}

    def body(self, picture: _Picture) -> dict[str, Any]:
        """Return an image as the body of an annotation."""
        return {"id": f"{self._url}/{picture.name}/full/max/0/default.jpg", "type": "Image", "format": "image/jpeg",
                "label": {"en": [picture.label]}, "width": self._most[0], "height": self._most[1], "service": [self.service(picture.name)]}

    def thumbnail(self, picture: _Picture) -> dict[str, Any]:
        """Return the smallest zoom of an image."""
        width, height = size_at(self.width, self.height, halvings(self.width, self.height, THUMBNAIL_SIDE))
        return {"id": f"{self._url}/{picture.name}/full/{width},{height}/0/default.jpg", "type": "Image", "format": "image/jpeg",
                "width": width, "height": height, "service": [self.service(picture.name)]}

    def _image(self, name: str, width: int, height: int) -> Path:
        return self._folder / name / "full" / f"{width},{height}" / "0" / "default.jpg"


def write_iiif(folder: Path, source: BasisCapture, display: Display, maps: ResultLayers | None, request: PublishRequest,
               annotations: list[Annotation], device: str, timings: Timings) -> None:
    """Write the images and manifest.json; pictures are exposed alike, as the planes of the other kinds are."""
    images = _Images(folder, source, request)
    wanted = DEFAULT_PHOTOGRAPHS if request.photographs is None else request.photographs
    chosen = display.front[np.unique(np.linspace(0, len(display.front) - 1, min(wanted, len(display.front))).round().astype(int))]
    photographs = [_Picture(f"photograph_{index}", f"photograph, {source.stack.frames[index]}") for index in chosen]
    directions = source.lights.direction[display.front]
    spacing = light_spacing(directions)
    towards = {label: np.array(direction) / np.linalg.norm(direction) for label, direction in RELIT.items()}
    between = [label for label, way in towards.items() if np.linalg.norm(directions - way, axis=1).min() <= spacing]
    relit = [_Picture(f"relit_{index}", label) for index, label in enumerate(between)]
    weights = np.zeros((len(relit) + len(chosen), 3, source.stack.shape[1]), np.float32)
    if relit:
        weights[:len(relit), :, display.front] = light_weights(directions, np.array([towards[label] for label in between]))[:, None]
    weights[len(relit) + np.arange(len(chosen)), :, chosen] = 1
    if not len(weights):
        raise RequestError(f"--photographs 0: the lights of {source.where} are near none of those of the relit pictures: none is left")
    _write_pictures(images, [*relit, *photographs], source, display, weights, device, timings)
    canvases = [("under light", [*relit, *photographs])]
    if maps is not None:
        layers = [_Picture(LAYERS[name], LAYERS[name]) for name in maps.names() if name in LAYERS]
        timings.stage("maps", len(layers))
        for done, (name, values) in enumerate(_layers(maps, display), start=1):
            with Strips(images.height, images.width, [images.pyramid(LAYERS[name])], np.zeros((1, 3), np.uint8)) as strips:
                strips.put(0, values.reshape(1, -1, 3))
            timings.advance(done)
        canvases += [("maps", layers)] if layers else []
    timings.stage("write", 1)
    write_text(folder / MANIFEST_FILE, json.dumps(_manifest(images, canvases, source, request, annotations), indent=1) + "\n")


def _write_pictures(images: _Images, pictures: list[_Picture], source: BasisCapture, display: Display, weights: np.ndarray, device: str,
                    timings: Timings) -> None:
    """Write pictures as weighted sums [pictures, 3, lights padded] of what a display shows under each captured light."""
    pyramids = [images.pyramid(picture.name) for picture in pictures]
    with Strips(images.height, images.width, pyramids, np.zeros((len(pictures), 3), np.uint8)) as strips:
        for each in stack_bands(source, device, 6 * source.stack.shape[1] + 30 * len(weights), timings, "tiles"):
            values = np.where(each.inside, to_numpy(combine_batch(display.shown(each.band), weights)), 0)
            width = each.span.stop - each.span.start
            strips.put(each.span.start, np.rint(255 * np.clip(values[:, :, :width], 0, 1)).astype(np.uint8).swapaxes(1, 2))


def _layers(maps: ResultLayers, display: Display) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the layers that are shown, [rows, cols, 3] uint8: albedo for an sRGB display, normals from −1…1; 0 where nothing is solved."""
    for name in maps.names():
        if name == "normal":
            shown = (np.moveaxis(maps.take(name), 0, -1).astype(np.float32) + 1) / 2
        elif name == "diffuse_albedo":
            shown = srgb(np.moveaxis(maps.take(name), 0, -1).astype(np.float32) @ display.from_stack.T)
        else:
            continue
        yield name, np.rint(255 * np.where(maps.mask[..., None], shown, 0)).astype(np.uint8)


def _manifest(images: _Images, canvases: list[tuple[str, list[_Picture]]], source: BasisCapture, request: PublishRequest,
              annotations: list[Annotation]) -> dict[str, Any]:
    url = (request.url or "").rstrip("/")
    camera = source.capture.camera
    facts = {"Capture": source.capture.name, "Lights": str(source.stack.light_count), **{
        FACTS[name]: text for name, text in source.provenance.items() if name in FACTS}}
    service = [] if camera.pixel_size_m is None else [{
        "@context": "http://iiif.io/api/annex/services/physdim/1/context.json", "@id": f"{url}/physical-dimensions",
        "@type": "PhysicalDimensions", "profile": "http://iiif.io/api/annex/services/physdim",
        "physicalScale": numbers(1000 * camera.pixel_size_m), "physicalUnits": "mm"}]
    items = []
    for number, (label, pictures) in enumerate(canvases, start=1):
        canvas = f"{url}/canvas/{number}"
        bodies = [images.body(picture) for picture in pictures]
        notes = [{"id": f"{canvas}/note/{place}", "type": "Annotation", "motivation": "commenting",
                  "body": {"type": "TextualBody", "value": note.text, "format": "text/plain"}, "target": _target(canvas, note)}
                 for place, note in enumerate(annotations, start=1)]
        items.append({
            "id": canvas, "type": "Canvas", "label": {"en": [label]}, "width": images.width, "height": images.height,
            "thumbnail": [images.thumbnail(pictures[0])], **({"service": service} if service else {}),
            "items": [{"id": f"{canvas}/page", "type": "AnnotationPage", "items": [{
                "id": f"{canvas}/painting", "type": "Annotation", "motivation": "painting", "target": canvas,
                "body": bodies[0] if len(bodies) == 1 else {"type": "Choice", "items": bodies}}]}],
            **({"annotations": [{"id": f"{canvas}/notes", "type": "AnnotationPage", "items": notes}]} if notes else {})})
    return {
        "@context": "http://iiif.io/api/presentation/3/context.json", "id": f"{url}/{MANIFEST_FILE}", "type": "Manifest",
        "label": {"none": [request.title or source.capture.name]},
        "metadata": [{"label": {"en": [name]}, "value": {"none": [text]}} for name, text in facts.items()],
        **({} if request.rights is None else {"rights": request.rights.replace("https://", "http://")}),
        **({} if request.attribution is None else {
            "requiredStatement": {"label": {"en": ["Attribution"]}, "value": {"none": [request.attribution]}}}),
        "thumbnail": [images.thumbnail(canvases[0][1][0])], "items": items}


def _target(canvas: str, note: Annotation) -> Any:
    """Return the place of an annotation on a canvas, in whole pixels: points from 1 on, as the schema of IIIF's validator has them, and the
    pixels that a rectangle touches, as Media Fragments have them."""
    if note.width == note.height == 0:
        point = {"x": max(1, round(note.x)), "y": max(1, round(note.y))}
        return {"type": "SpecificResource", "source": canvas, "selector": {"type": "PointSelector", **point}}
    x, y = math.floor(note.x), math.floor(note.y)
    return f"{canvas}#xywh={x},{y},{math.ceil(note.x + note.width) - x},{math.ceil(note.y + note.height) - y}"

"""The closed choices of requests; apart from them, so that the command line starts without pydantic."""

from enum import StrEnum


class Method(StrEnum):
    """How normals are solved."""

    LAMBERT = "lambert"
    """Least squares on every light that gave a reading."""
    ROBUST = "robust"
    """Shadows and highlights rejected per pixel."""
    GRADIENT = "gradient"
    """Diffuse and specular normals from spherical gradient frames."""
    REFERENCE = "reference"
    """From a ball of the object's material, photographed under the same lights."""
    SVBRDF = "svbrdf"
    """Normal, diffuse albedo, specular and roughness; the default where there are lights enough."""


class Layer(StrEnum):
    """What a relit frame may carry."""

    BEAUTY = "beauty"
    """The relit image: R, G, B; always there."""
    DIFFUSE = "diffuse"
    """The relit image without the specular layer."""
    SPECULAR = "specular"
    """What a model of the solved maps reflects as from a gloss."""
    MASK = "mask"
    """Where the object is: of the solved maps, else of the capture."""
    NORMAL = "normal"
    """Of the solved maps."""
    CONFIDENCE = "confidence"
    """Of the solved maps."""


class LightWeights(StrEnum):
    """How light from between the captured lights is shared out over them."""

    CELLS = "cells"
    """Whole to the nearest light."""
    SMOOTH = "smooth"
    """To the three lights around it."""


class FrameSpace(StrEnum):
    """Colour spaces that relit frames can be written in, beside the capture's own."""

    REC709 = "lin_rec709_scene"
    ACESCG = "lin_ap1_scene"


class FrameCompression(StrEnum):
    """How relit frames are packed."""

    ZIP = "zip"
    PIZ = "piz"
    DWAA = "dwaa"
    """Lossy, and smaller."""


class BasisKind(StrEnum):
    """What a capture is reduced to."""

    SVD = "svd"
    """The coefficient images that lose least, in an EXR."""
    PTM = "ptm"
    """Polynomial texture map, six coefficients in each channel."""
    LRGB_PTM = "lrgb-ptm"
    """Polynomial texture map of the luminance, and one colour a pixel: half the size."""
    HSH = "hsh"
    """Hemispherical harmonics, in an RTI file."""


class Ranging(StrEnum):
    """What a depth is measured with."""

    PATTERN = "pattern"
    """A projector's patterns: structured light."""
    LASER = "laser"
    """Spots and stripes of a laser."""
    TOF = "tof"
    """The time that light takes."""


class Geometry(StrEnum):
    """What an asset of a depth is made of."""

    MESH = "mesh"
    """Faces between neighbouring pixels of one surface."""
    POINTS = "points"
    """The measured points."""

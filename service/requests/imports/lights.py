"""The options of `relit import` for images under lights."""

from pathlib import Path
from typing import Annotated

from service.requests.base.base import Choice, Role, Spelling
from service.requests.imports.base import Axes, CameraOptions, EncodingOptions, ImageOptions, ImportRequest, LightScale
from stage.model import Line, Positive


class DiligentImport(ImportRequest):
    """An object's folder of the DiLiGenT benchmark."""


class LpImport(CameraOptions, EncodingOptions, LightScale, ImportRequest):
    """An RTI light list (.lp) with its images; SRC may be the .lp file."""


class Sense(Choice):
    """The direction of the vectors of a table."""

    TO_LIGHT = "to-light", "directions to the light, or its position seen from the object"
    FROM_LIGHT = "from-light", "along the rays, away from the light"


class Run(Choice):
    """The rows or columns of a table of numbers, each a light."""

    ROWS = "rows"
    COLUMNS = "columns"


class OlatImport(CameraOptions, ImageOptions, LightScale, ImportRequest):
    """Images under one far light each, with a table of the lights: .csv, .txt, .json, .mat or .npy."""

    axes: Axes
    """Where x, y and z of the table point as seen by the camera: right or left, up or down, towards the camera or away from it. relit and
    OpenGL have right,up,towards, OpenCV has right,down,away."""
    sense: Annotated[Sense, Spelling(flag="--vectors")]
    """The meaning of the vectors of the table."""
    lights: Annotated[Path | None, Role.INPUT] = None
    """Table of the lights: rows of an image name or none, three numbers, and one or three of the strength or none; None: the only table in
    SRC."""
    variable: Line | None = None
    """Variable of a .mat table, or key of a .json; None: the only one that can be meant."""
    lights_in: Run | None = None
    """A light's numbers in the table are a row or a column; None: as its shape says."""
    strengths: Annotated[Path | None, Role.INPUT] = None
    """File with the strength of each light, one or three numbers; None: that in the table, else equal."""


class PhotosImport(CameraOptions, ImageOptions, ImportRequest):
    """Images under one far light each where nothing says where the lights were: relit solve --lights unknown finds them, or relit
    calibrate measures them."""


class NearLightsImport(CameraOptions, ImageOptions, ImportRequest):
    """Images under one near light each (LEDs), with a .mat or .json file of the rig as near_ps has it: S, Dir, Phi and mu."""

    axes: Axes
    """Where x, y and z of the rig point as seen by the camera, whose centre is their origin: right or left, up or down, towards the camera
    or away from it. near_ps and OpenCV have right,down,away."""
    unit_m: Positive
    """Metres in one unit of the positions: near_ps has millimetres, 0.001."""
    lights: Annotated[Path | None, Role.INPUT] = None
    """File of the rig: positions and, if they are known, directions, intensities and mu (anisotropy); None: the only table in SRC."""
    camera: Annotated[Path | None, Role.INPUT] = None
    """File with the matrix of the camera: K of a .mat file, or an OpenCV file (.yml, .xml, .json); None: as the other options say."""


class RelightlabImport(EncodingOptions, ImportRequest):
    """A project of RelightLab (.relight), or its dome (.dome) beside the images; SRC may be the file."""

"""What can be asked of Relit: one frozen model a job, the same object for the command line, the API and the workflow.

An ...Options model holds what is chosen about the work; the ...Request on top of it adds where files are. A job of the service carries
the options and names of captures, which its worker makes paths of.
"""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from service.methods import BasisKind, FrameCompression, FrameSpace, Geometry, Layer, LightWeights, Method
from service.near_lights import GivenPoint, GivenRectangle, GivenSphere
from stage.model import FirstFault

MAX_STOPS = 32.0
"""Of exposure either way: more than half has from its smallest value to its largest."""


def _split(given: Any) -> Any:
    if isinstance(given, str):
        return tuple(part.strip() for part in given.split(","))
    return tuple(given) if isinstance(given, list) else given  # which strict validation of JSON asks for


class Options(BaseModel):
    """Base of every model: what is not known is refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class Request(Options):
    """Base of every request."""

    device: str | None = None
    """cpu, cuda:0, …; None: the first CUDA device, else the CPU."""
    cache: Path | None = None
    """Folder for the stack cache; None: `.relit` in the capture's folder."""


class StackOptions(Options):
    """About the images of a capture."""

    align: bool = False
    """Warp the frames of a moving subject to the time of one tracking frame."""
    align_to: str | None = None
    """Image of that tracking frame, and so `align`; None: the middle one."""

    @property
    def aligned(self) -> bool:
        """Whether frames are warped."""
        return self.align or self.align_to is not None


class SolveOptions(StackOptions):
    """How normals, albedo and height are solved."""

    method: Method | None = None
    """None: gradient where there are gradient frames; else svbrdf where there are lights enough, else robust."""


class SolveRequest(SolveOptions, Request):
    """Normals, albedo and height of a capture."""

    capture: Path
    out: Path
    """Folder for maps.exr and report.json."""
    reference_ball: Path | None = None
    """Capture of a ball of the object's material under the same lights, for the method reference."""


class PictureOptions(Options):
    """How a picture under new light is written."""

    exposure: float = Field(default=0.0, ge=-MAX_STOPS, le=MAX_STOPS, allow_inf_nan=False)
    """Stops: every picture is multiplied by 2 to this power."""
    aov: Annotated[tuple[Layer, ...], FirstFault, BeforeValidator(_split)] = (Layer.BEAUTY,)
    """Layers of a picture; as text, names with commas between."""
    color_space: FrameSpace | None = None
    """None: the capture's own scene-linear space."""
    compression: FrameCompression = FrameCompression.ZIP


class RelightOptions(PictureOptions, StackOptions):
    """Which frames, and how light is shared out over the captured lights."""

    frames: str | None = None
    """A number, or first-last; None: 1, or 1 to the number of time steps."""
    weights: LightWeights | None = None
    """How light from between the captured lights is shared out over them; None: cells, with maps smooth."""
    spin_degrees: float = Field(default=0.0, allow_inf_nan=False)
    """How far the environment turns about +y over the whole range; the first frame is unturned, and a full turn closes."""


class RelightRequest(RelightOptions, Request):
    """Frames of a capture, or of a sequence of captures, under lat-long environments and animated lights."""

    capture: Path
    """A folder with a capture.json; or with such folders, one a time step: in order of name, each gives one frame."""
    out: str
    """Path of the frames with #### for the number."""
    environment: Path | None = None
    """A lat-long map; with #### in its name one a frame."""
    keys: Path | None = None
    """Light keys (schema relit.keys/1): animation of lights, environment, captured images and exposure."""
    only: str | None = None
    """Of `frames`, the part that this run makes, in the same form: what a farm gives to one of its machines. None: all."""
    maps: Path | None = None
    """Folder of the solved maps (of a sequence: of a folder a time step, named as its capture): frames are guided by a model of them."""
    overwrite: bool = False
    """Make frames anew that an equal request has made already."""
    sheet: Path | None = None
    """A PNG that shows the frames for review."""
    report: Path | None = None
    """A JSON file that says what was made, and where the time went."""

    @property
    def weighting(self) -> LightWeights:
        """The weights that are used."""
        return self.weights or (LightWeights.CELLS if self.maps is None else LightWeights.SMOOTH)


class ShadeOptions(PictureOptions):
    """Lights near the surface, and how its environment is turned."""

    light: Annotated[tuple[GivenPoint, ...], FirstFault] = ()
    sphere: Annotated[tuple[GivenSphere, ...], FirstFault] = ()
    rectangle: Annotated[tuple[GivenRectangle, ...], FirstFault] = ()
    turn_degrees: float = Field(default=0.0, allow_inf_nan=False)
    """Of the environment about +y, +z towards +x."""


class ShadeRequest(ShadeOptions, Request):
    """One picture of solved maps under near lights, area lights and an environment."""

    maps: Path
    """A folder with maps.exr, or the file."""
    out: Path
    """.exr."""
    environment: Path | None = None
    """A lat-long map."""
    capture: Path | None = None
    """The capture of the maps: its images give what a model of the maps cannot, interreflection and scattering."""


class BasisRequest(StackOptions, Request):
    """A capture reduced to a few coefficient images, for a browser or for viewers of relightable images."""

    capture: Path
    out: Path
    """.exr (svd), .ptm (ptm, lrgb-ptm) or .rti (hsh)."""
    kind: BasisKind | None = None
    """None: the first kind with the suffix of `out`."""
    count: int | None = Field(default=None, ge=1)
    """Coefficients in each channel. svd: 1 to the number of lights, None: 16 or that number; hsh: 4, 9 or 16, None: 9 from 18
    lights on, else 4; ptm: six in any case."""


class ExportOptions(Options):
    """What a USD asset is called and made of."""

    name: str | None = None
    """Of the asset; None: what the maps say, else the file's stem."""
    geometry: Geometry | None = None
    """Of a depth (depth.exr in place of maps.exr); None: mesh."""


class ExportRequest(ExportOptions):
    """A USD asset from solved maps or a depth."""

    maps: Path
    """A folder with maps.exr or depth.exr, or the file."""
    out: Path
    """.usdz, .usda or .usdc."""

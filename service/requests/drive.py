"""The options of `relit drive`."""

from importlib import import_module
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, GetJsonSchemaHandler, ValidationError, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from service.requests.base.base import Choice, Options, Request, Role, Spelling
from service.requests.base.review import ReviewOptions
from service.requests.light.picture_options import MAX_STOPS, FrameRate
from service.requests.relight import LightWeights
from stage.model import Finite, Line
from stage.records import describe

RIG = Spelling(argument=True, metavar="RIG")
"""Marks the rig of a command, which is given by its place."""


class Beyond(Choice):
    """The treatment of light from where no lamp stands."""

    NEAREST = "nearest", "the lamps nearest to it give it"
    DROP = "drop", "it is left out"


class DriveOptions(Options):
    """The frames to reproduce, and how their light is shared out over the lamps."""

    frames: Line = "1"
    """A number, or first-last."""
    spin_degrees: Finite = 0.0
    """Degrees by which the environment turns over the range, about +y from +z towards +x; the first frame is not turned, and with 360 the
    frame after the last would be the first again."""
    exposure: Annotated[float, Spelling(metavar="STOPS")] = Field(default=0.0, ge=-MAX_STOPS, le=MAX_STOPS, allow_inf_nan=False)
    """Exposure in stops: the environment is multiplied by 2 to this power before it is compared with the irradiance of the lamps."""
    auto_exposure: bool = False
    """Choose the exposure at which the brightest primary of all frames is just at full level; `exposure` is added to it."""
    weights: LightWeights = LightWeights.KERNEL
    """How light from between the lamps is shared out over them."""
    beyond: Beyond = Beyond.NEAREST
    """What becomes of light from where no lamp stands, twice the spacing of the lamps away from all of them or farther."""
    frames_per_second: FrameRate | None = None
    """Frames per second; None: those of the light keys, else 24."""
    clip_negative: bool = False
    """Set values of environments to 0 that are negative beyond their noise, and say how many; without it such maps are refused."""


class _CheckedDocument(BaseModel):
    """The content of a file as it was given, once a model of its schema has taken it; it is kept unchanged."""

    model_config = ConfigDict(extra="allow", frozen=True)

    MODEL: ClassVar[str]
    """The module:class of the model, which is imported with NumPy, without which requests and the command line start."""

    @classmethod
    def _model(cls) -> type[BaseModel]:
        module, _, name = cls.MODEL.partition(":")
        found: type[BaseModel] = getattr(import_module(module), name)
        return found

    @model_validator(mode="after")
    def _check(self) -> Self:
        try:
            self._model().model_validate(self.model_dump(by_alias=True))
        except ValidationError as error:
            raise ValueError(describe(error)) from error
        return self

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler, /) -> JsonSchemaValue:
        """Return the JSON schema of the model."""
        model = cls._model()
        model.model_rebuild()
        return handler(model.__pydantic_core_schema__)


class RigDocument(_CheckedDocument):
    """The content of a rig file; cues are for the rig with the digest of its file."""

    schema_: Literal["relit.rig/1"] = Field(alias="schema")
    """The kind and version of the file."""
    MODEL = "stage.rig.rig:Rig"


class ChartDocument(_CheckedDocument):
    """The content of a chart file."""

    schema_: Literal["relit.chart/1"] = Field(alias="schema")
    """The kind and version of the file."""
    MODEL = "stage.rig.chart:Chart"


class DriveRequest(ReviewOptions, DriveOptions, Request):
    """Levels at which the lamps of a rig light a subject as environments and animated lights would."""

    rig: Annotated[Path, Role.INPUT, RIG]
    """The rig (JSON, schema relit.rig/1); docs/drive.md."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder of the results: cues.csv, cues.json, report.json and preview.png; with `capture` the predicted frames too."""
    environment: Annotated[Path | None, Role.INPUT] = None
    """Lat-long environment map, .exr or .hdr; with #### in its name, a map for each frame."""
    keys: Annotated[Path | None, Role.INPUT, Spelling(metavar="FILE")] = None
    """Light keys (JSON, schema relit.keys/1): animated lights, environment and exposure; docs/relight.md."""
    chart: Annotated[Path | None, Role.INPUT, Spelling(metavar="FILE")] = None
    """Chart (JSON, schema relit.chart/1): what the camera sees of its patches under each primary; lamps of several primaries are then mixed
    such that the camera sees them as under the environment."""
    capture: Annotated[Path | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """Folder with a capture.json of images under single lights from where the lamps stand: predicted.####.exr show it at the levels of each
    frame, as `relit twin` does."""

"""Forms of jobs, made from the request models: a field of a model becomes a control with its name, words, choices, limits and default.

A form sends the JSON of the API (static/form.js). It holds the flags of `relit submit` too, so that the page can show the same job as a
command.
"""

from enum import Enum
from functools import cache
from types import NoneType
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from service.requests.base.base import Choice, Commas, JobRequest, Role
from service.requests.base.identifiers import CAPTURE, ENVIRONMENT, JOB, pattern
from service.requests.base.import_choices import Layout
from service.requests.base.options import Option, help_text, is_document, places_of, typed
from service.requests.imports.layouts import LAYOUTS, options_of_layout
from service.requests.jobs import JOBS

TITLES = {"solve": "Solve normals and materials", "pipeline": "Make an asset", "depth": "Measure depth",
          "scan": "Turn shots into points",
          "inspect-board": "Inspect the board", "gauge-board": "Find how well inspections of boards repeat",
          "drive": "Drive the lamps of a rig",
          "relight": "Relight frames", "basis": "Reduce to a few coefficient images",
          "separate": "Separate direct and global light",
          "export": "Export an asset", "shade": "Shade one picture",
          "join": "Join with a depth of the same view", "register": "Find the poses of several depths",
          "fuse": "Fuse registered depths into one mesh", "patterns": "Draw patterns to project",
          "calibrate-mirror-ball": "Calibrate light directions: one mirror ball",
          "calibrate-light-positions": "Calibrate light positions: two or more mirror balls",
          "calibrate-grey-ball": "Calibrate the brightness of lights: a grey ball",
          "calibrate-intensity": "Calibrate the brightness of lights: the object itself", "calibrate-dark": "Calibrate the dark frame",
          "calibrate-flat-field": "Calibrate the flat field", "calibrate-saturation": "Calibrate the saturation",
          "calibrate-procam": "Calibrate camera and projector", "calibrate-stereo": "Calibrate several cameras",
          "calibrate-response": "Calibrate the response of the projector",
          "calibrate-tof": "Calibrate a time-of-flight camera",
          "calibrate-rig": "Calibrate the lamps of a rig",
          "calibrate-white-balance": "Calibrate colours: a grey card", "calibrate-chart": "Calibrate colours: a colour chart",
          "calibrate-laser-planes": "Calibrate the planes of a laser"}
CAPTURE_JOBS = {name: JOBS[name] for name in TITLES if any(
    field.is_required() for part, field in JOBS[name].model_fields.items() if part in ("capture", "captures"))}
"""Jobs that begin with a capture, by kind."""
FREE_JOBS = {name: JOBS[name] for name in ("patterns", "gauge-board", "drive")}
"""Jobs that begin with neither a capture nor maps, by kind."""
MAPS_JOBS = {name: JOBS[name] for name in TITLES if name not in CAPTURE_JOBS and name not in FREE_JOBS}
"""Jobs that begin with the maps of another job, by kind."""
LIT = ("light", "pattern", "laser", "tof", "stereo")
"""All that can have lit the frames of a capture, as `lit_by` of its facts names it."""
BEGIN_WITH: dict[str, tuple[str, ...]] = {
    "solve": ("light",), "pipeline": ("light",), "relight": ("light",), "basis": ("light",),
    "depth": ("pattern", "laser", "tof", "stereo"), "separate": ("pattern",), "scan": ("shots",), "inspect-board": ("tiles",),
    "calibrate-mirror-ball": ("light",), "calibrate-light-positions": ("light",), "calibrate-grey-ball": ("light",),
    "calibrate-intensity": ("light",), "calibrate-rig": ("light",), "calibrate-dark": LIT, "calibrate-flat-field": LIT,
    "calibrate-saturation": LIT, "calibrate-white-balance": ("light", "pattern", "stereo"),
    "calibrate-chart": ("light", "pattern", "stereo"), "calibrate-procam": ("pattern",), "calibrate-stereo": ("stereo",),
    "calibrate-response": ("pattern",), "calibrate-tof": ("tof",), "calibrate-laser-planes": ("laser",),
    "export": ("maps.exr", "depth.exr", "sequence.json"), "shade": ("maps.exr",), "join": ("maps.exr",), "register": ("depth.exr",),
    "fuse": ("scan-set.json",)}
"""What there must be one of for a job to begin with something, by kind: in a capture what lit its frames (`lit_by` of its facts), the shots
of a scan or the tiles of a board; in the results of another job a file."""
NEXT_STEPS: dict[str, tuple[str, ...]] = {
    "light": ("pipeline", "solve"), "pattern": ("depth", "separate"), "laser": ("depth",), "tof": ("depth",), "stereo": ("depth",),
    "shots": ("scan",), "tiles": ("inspect-board",)}
"""What a capture is made for, by what it holds: jobs that need nothing but the capture. A capture that can be relit is lit first."""
BOUNDS = {"ge": "low", "gt": "low", "le": "high", "lt": "high"}
"""The end of a range that a constraint of a number bounds, by the name of its value in annotated_types."""
UNITS = {"px": "pixels", "m": "metres", "s": "seconds", "hz": "Hz", "deg": "degrees", "degrees": "degrees", "c": "°C"}
"""Units in words, by what ends the name of a field in them."""
WORDS = {"color_space": "Colour space", "focal_px": "Focal length (pixels)", "principal_px": "Principal point (pixels)",
         "surface_z_m": "Distance of the surface, z (metres)",
         "ball_z_m": "Distance of the ball, z (metres)", "must_find_m": "Defects that must be found (metres)"}
"""Labels of fields whose names are too short for people."""
IDENTIFIERS = {pattern(CAPTURE): "capture", pattern(ENVIRONMENT): "environment", pattern(JOB): "job"}
"""The kind of thing that the identifiers of a pattern name."""


class Field(NamedTuple):
    """One control of a form."""

    name: str
    paths: tuple[str, ...]
    """Places of the value in the JSON, each the names of the fields that lead to it, with dots between; an option that two parts of a job
    have in common has two."""
    label: str
    help: str
    control: str
    """checkbox, select, number, text, lines (several values, one a line), captures or jobs (several identifiers, one a line), json, or the
    kind of thing that an identifier names: capture, environment, job."""
    value_type: str
    """Type in JSON: boolean, integer, number, string, strings (one a line), json; integers, numbers or words, typed with commas between."""
    flag: str
    off: str
    is_argument: bool
    choices: tuple[tuple[str, str], ...]
    """Values and their words, of a select; examples of a text."""
    default: str
    required: bool
    low: str
    high: str


class Form(NamedTuple):
    """The form of one kind of job."""

    kind: str
    title: str
    about: str
    main: tuple[Field, ...]
    """Inputs of the job, and options without a default."""
    more: tuple[Field, ...]
    """Options with a default."""
    begins_with: tuple[str, ...]
    """What there must be one of, as BEGIN_WITH says; empty: the job begins with nothing."""


@cache
def form_of(kind: str, model: type[JobRequest]) -> Form:
    """Return the form of a kind of job."""
    places: dict[str, list[str]] = {}
    options: dict[str, Option] = {}
    for path, option in places_of(model):
        places.setdefault(option.name, []).append(".".join(path))
        options.setdefault(option.name, option)
    fields = [(option.role is Role.INPUT, _field(model, tuple(places[name]), option)) for name, option in options.items()]
    main = [field for is_input, field in fields if is_input] + [field for is_input, field in fields if field.required and not is_input]
    return Form(kind, TITLES[kind], " ".join((model.__doc__ or "").split()), tuple(main),
                tuple(field for _, field in fields if field not in main), BEGIN_WITH.get(kind, ()))


def import_fields(layout: Layout) -> list[Field]:
    """Return the controls of the options of an import, by the names that the API has."""
    return [_field(LAYOUTS[layout], (name,), option) for name, option in options_of_layout(layout).items()]


def _field(model: type[BaseModel], paths: tuple[str, ...], option: Option) -> Field:
    control, value_type, choices = _control(option)
    default = option.field.default
    shown = "" if option.field.is_required() or default in (None, ()) or isinstance(default, bool) else typed(default)
    limits = {end: f"{value:g}" for limit in option.constraints for name, end in BOUNDS.items()
              if (value := getattr(limit, name, None)) is not None}
    label = _label(paths[0].rpartition(".")[2])
    return Field(option.name, paths, label, help_text(option, model), control, value_type, option.flag, option.off,
                 option.spelling.argument, choices, "true" if default is True else shown, option.field.is_required(),
                 limits.get("low", ""), limits.get("high", ""))


def _label(name: str) -> str:
    """Return what people call a field: its unit in brackets."""
    *stem, last = name.split("_")
    words = [*stem, f"({UNITS[last]})"] if stem and last in UNITS else [*stem, last]
    return WORDS.get(name) or " ".join([words[0].capitalize(), *words[1:]])


def _control(option: Option) -> tuple[str, str, tuple[tuple[str, str], ...]]:
    """Return control, JSON type and choices of an option."""
    kind = option.kind
    if (named := IDENTIFIERS.get(option.pattern or "")) is not None:
        return (f"{named}s", "strings", ()) if option.is_repeated else (named, "string", ())
    if is_document(kind):
        return "json", "json", ()
    if option.is_repeated:
        return "lines", "strings", ()
    if Commas in option.constraints:
        return "text", {int: "integers", float: "numbers"}.get(_bare(get_args(kind)[0]), "words"), ()
    if kind is bool:
        return "checkbox", "boolean", ()
    if isinstance(kind, type) and issubclass(kind, Enum):
        words = [(str(each.value), each.words if isinstance(each, Choice) else "") for each in kind]
        return "select", "string", tuple(words)
    if get_origin(kind) is Literal:
        return "select", "string", tuple((str(value), "") for value in get_args(kind) if value is not NoneType)
    if kind is int:
        return "number", "integer", ()
    if kind is float:
        return "number", "number", ()
    return "text", "string", tuple((str(each), "") for each in _examples(option))


def _examples(option: Option) -> list[Any]:
    """Return the examples that a field, or the type of its values, declares."""
    kinds = [option.field, *map(FieldInfo.from_annotation, get_args(option.field.annotation))]
    return next((kind.examples for kind in kinds if kind.examples), [])


def _bare(kind: Any) -> Any:
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind

"""Every option stands once, in the field of a request model: whatever is made from it says the same."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from pydantic import BaseModel

from service.requests import (
    acquire,
    basis,
    calibrate,
    captures,
    chart,
    demo,
    depth,
    drive,
    export,
    hooks,
    jobs,
    keys,
    patterns,
    play,
    publish,
    register,
    relight,
    rig,
    shade,
    solve,
)
from service.requests.base.base import Choice, Options, Role
from service.requests.base.options import build, help_text, options_of, typed, values_of
from service.requests.depth import SimulateCwRequest, SimulatePulsedRequest
from service.requests.imports import lights
from service.requests.imports import patterns as pattern_images
from service.requests.imports.patterns import InterleavedImport
from service.requests.imports.scans import ScansImport
from service.requests.imports.tof import HistogramImport, KinectImport, TofImport
from service.requests.inspect_board import BoardCapabilityRequest, GaugeBoardRequest, InspectBoardRequest, InspectPasteRequest
from tests.service.conftest import made_program

COMMANDS: dict[str, list[type[Options]]] = {
    "solve": [solve.SolveRequest], "export": [export.ExportRequest], "inspect": [export.InspectRequest],
    "blender-extension": [export.BlenderExtensionRequest],
    "compare": [register.CompareRequest], "join": [solve.JoinRequest], "register": [register.RegisterRequest],
    "fuse": [register.FuseRequest],
    "depth": [depth.DepthRequest], "scan": [depth.ScanRequest],
    "separate": [depth.SeparateRequest], "inspect-board": [InspectBoardRequest],
    "gauge-board": [GaugeBoardRequest], "inspect-paste": [InspectPasteRequest], "board-capability": [BoardCapabilityRequest],
    "simulate cw": [SimulateCwRequest], "simulate pulsed": [SimulatePulsedRequest],
    "patterns": [patterns.PatternsRequest, patterns.PlanRequest], "relight": [relight.RelightRequest], "shade": [shade.ShadeRequest],
    "play": [play.PlayRequest], "capture": [acquire.AcquireRequest], "twin": [play.TwinRequest],
    "basis": [basis.BasisRequest], "publish": [publish.PublishRequest], "view": [captures.ViewRequest], "demo": [demo.DemoRequest],
    "bench": [demo.BenchRequest],
    "import diligent": [lights.DiligentImport], "import lp": [lights.LpImport], "import olat": [lights.OlatImport],
    "import opencv-gray": [pattern_images.OpencvGrayImport], "import near-lights": [lights.NearLightsImport],
    "import photos": [lights.PhotosImport],
    "import relightlab": [lights.RelightlabImport], "import gray": [pattern_images.GrayImport],
    "import phase": [pattern_images.PhaseImport], "import scans": [ScansImport],
    "import interleaved": [InterleavedImport],
    "import scanner": [pattern_images.ScannerImport], "import tof": [TofImport], "import histogram": [HistogramImport],
    "import kinect": [KinectImport], "import laser": [pattern_images.LaserImport],
    "drive": [drive.DriveRequest], "rig check": [rig.RigCheckRequest], "rig from-capture": [rig.RigFromCaptureRequest],
    "rig from-csv": [rig.RigFromCsvRequest], "rig from-mvr": [rig.RigFromMvrRequest], "rig plan": [rig.RigPlanRequest],
    "rig sweep": [rig.RigSweepRequest],
    "keys create": [keys.NewKey], "hooks create": [hooks.NewHook], "calibrate mirror-ball": [calibrate.MirrorBallRequest],
    "calibrate light-positions": [calibrate.LightPositionsRequest], "calibrate grey-ball": [calibrate.GreyBallRequest],
    "calibrate intensity": [calibrate.IntensityRequest], "calibrate dark": [calibrate.DarkRequest],
    "calibrate flat-field": [calibrate.FlatFieldRequest], "calibrate saturation": [calibrate.SaturationRequest],
    "calibrate white-balance": [calibrate.WhiteBalanceRequest], "calibrate chart": [chart.ChartRequest],
    "calibrate laser-planes": [calibrate.LaserPlanesRequest],
    "calibrate procam": [calibrate.ProcamRequest],
    "calibrate stereo": [calibrate.StereoRequest], "calibrate response": [calibrate.ResponseRequest],
    "calibrate tof": [calibrate.TofCalibrationRequest], "calibrate rig": [rig.RigCalibrationRequest],
    **{f"submit {kind}": [model] for kind, model in jobs.JOBS.items()},
    "farm template relight": [relight.RelightRequest], "farm template shade": [shade.ShadeRequest],
}
OWN = {
    "relight": {"progress"}, "shade": {"progress"}, "solve": {"progress"}, "export": {"progress"},
    "patterns": {"plan"}, "demo": {"serve"}, "keys create": {"data", "config"},
    "hooks create": {"server", "key"},
    **{name: {"server", "key", "wait", "out", "cancel_on_interrupt"} for name in COMMANDS if name.startswith("submit")},
    "farm template relight": {"job", "chunk_frames", "gpu"}, "farm template shade": {"job", "turns", "gpu"},
}
"""Options that a command has beside those of its models."""
KINDS = {"solve": jobs.SolveJob, "depth": jobs.DepthJob, "relight": jobs.RelightJob, "shade": jobs.ShadeJob, "export": jobs.ExportJob,
         "view": jobs.ViewJob}

PROGRAM: Any = made_program()


class Shown(NamedTuple):
    """What a command says about an option."""

    flags: tuple[str, ...]
    default: Any
    help: str


def parameters(name: str) -> dict[str, Any]:
    command = PROGRAM
    for word in name.split():
        command = command.commands[word]
    return {parameter.name: parameter for parameter in command.params}


def shown(name: str) -> dict[str, Shown]:
    return {key: Shown((*found.opts, *found.secondary_opts), found.default, found.help) for key, found in parameters(name).items()}


def in_schema(model: type[BaseModel]) -> dict[str, dict[str, Any]]:
    """The properties of a model's JSON schema and of those within it, by name."""
    document = model.model_json_schema()
    found: dict[str, dict[str, Any]] = {}

    def visit(schema: dict[str, Any]) -> None:
        for name, property in schema["properties"].items():
            inner = document["$defs"].get(property.get("$ref", "").rpartition("/")[2], {})
            if "properties" in inner and name in ("options", "sequence", "tof"):
                visit(inner)
            else:
                found[name] = property

    visit(document)
    return found


def plain(text: str) -> str:
    """Words alone, as they are in a schema and in a help."""
    text = re.sub(r"\bnone: ", "without it ", text.lower())
    return re.sub(r"[^a-z0-9]+", " ", text.replace("_", " ")).strip()


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_has_the_options_of_its_models_and_its_own(name):
    models, left_out = COMMANDS[name], {Role.PART, Role.RUN} if name.startswith("farm") else set()
    found = parameters(name)
    options = {option.name: option for model in reversed(models) for option in options_of(model) if option.role not in left_out}
    extra = OWN.get(name, set()) | ({"device", "ocio"} if not name.startswith(("submit", "farm", "keys", "hooks")) else set())
    assert found.keys() == options.keys() | extra
    for option in options.values():
        parameter = found[option.name]
        wanted = option.field.get_default() if not option.field.is_required() else None
        assert parameter.default == (typed(wanted) or None if isinstance(wanted, tuple) else wanted or (wanted if wanted == 0 else None))
        if parameter.param_type_name == "option":
            assert option.flag in parameter.opts
        assert plain(parameter.help).startswith(plain(option.field.description)) and len(option.field.description) > 3
        assert parameter.required == (option.field.is_required() and all(option.name in {o.name for o in options_of(m)} for m in models))


@pytest.mark.parametrize("kind", KINDS)
def test_a_choice_is_the_same_here_there_and_in_the_schema(kind):
    """Compared without service.requests.base.options: names, flags, defaults and words."""
    here, there, schema = shown(kind), shown(f"submit {kind}"), in_schema(KINDS[kind])
    names = {option.field.alias or option.name for option in options_of(COMMANDS[kind][0]) if option.role is Role.CHOICE}
    assert names and names <= there.keys()
    others = {option.name for option in options_of(KINDS[kind]) if option.role is not Role.CHOICE} | {"format"}
    assert there.keys() - names - OWN[f"submit {kind}"] <= others
    farm = shown(f"farm template {kind}") if f"farm template {kind}" in COMMANDS else here
    for name in names:
        assert here[name] == there[name] == farm[name]
        field = {"return_": "which", "filter": "filters"}.get(name, name)
        assert plain(here[name].help).startswith(plain(schema[field]["description"]))
        default = schema[field].get("default")
        assert default in ([], "") or here[name].default == (",".join(default) if isinstance(default, list) else default)


def test_what_is_typed_builds_the_request_and_back():
    given = {"capture": Path("c"), "out": "o.#.exr", "aov": "beauty,mask", "exposure": 1.5, "align": True}
    request = build(relight.RelightRequest, given)
    assert request == relight.RelightRequest(capture=Path("c"), out="o.#.exr", aov=("beauty", "mask"), exposure=1.5, align=True)
    values = {option.name: value for option, value in values_of(request)}
    assert values.keys() == {option.name for option in options_of(relight.RelightRequest)}
    assert {name: typed(values[name]) for name in given} == {name: str(value) for name, value in given.items()}
    inner = build(depth.DepthRequest, {"capture": Path("c"), "out": Path("o"), "filter": "flying", "return_": "first"})
    assert inner.tof == depth.TofOptions(filters=("flying",), which="first")
    pipeline = build(jobs.PipelineJob, {"capture": f"cap_{'0' * 20}", "align": True, "name": "owl", "job_name": "night"})
    assert (pipeline.kind, pipeline.solve.align, pipeline.relight.align) == ("pipeline", True, True)
    assert (pipeline.name, pipeline.export.name) == ("night", "owl")


def test_every_choice_is_explained_once_and_the_options_of_a_pipeline_are_those_of_its_parts():
    """In help as in the schema; the words stand beside the value."""
    for option in options_of(solve.SolveRequest):
        if isinstance(option.kind, type) and issubclass(option.kind, Choice):
            assert all(f"{value}: {value.words}" in shown("solve")[option.name].help for value in option.kind)
    found = shown("submit pipeline")
    for kind in ("solve", "export", "relight"):
        there = shown(f"submit {kind}")
        for option in options_of(KINDS[kind]):
            if option.role is Role.CHOICE:
                assert found[option.name] == there[option.name]


def commands(group: Any, words: tuple[str, ...] = ()) -> Any:
    for name, command in group.commands.items():
        yield from commands(command, (*words, name)) if hasattr(command, "commands") else [((*words, name), command)]


NO_JOBS = {
    "demo": "makes files of this machine from the shipped sample", "bench": "measures this machine",
    "farm": "writes job templates of other queues", "rig": "describes lamps",
    "import": "describes files before they are uploaded", "simulate": "makes raw frames, which are uploaded as any others",
    "publish": "makes files for another web server", "capture": "switches lamps and releases a camera of this machine",
    "play": "drives lamps in the network of this machine", "twin": "listens in the network of this machine",
    "blender-extension": "writes a file for another program of this machine",
    "compare": "reads a design that is no capture", "inspect-paste": "reads a layer that is no capture",
    "board-capability": "reads results of inspections that are no jobs",
    "info": "prints", "inspect": "prints", "doctor": "prints", "kernels": "makes files of this installation",
    "jobs": "asks the service", "hooks": "asks the service",
    "submit": "asks the service",
    "serve": "is the service", "worker": "is the service", "audit": "is for its operator", "backup": "is for its operator",
    "restore": "is for its operator", "keys": "is for its operator",
}
"""Why commands are no jobs of the service, by their first word (docs/service.md)."""


def test_every_command_is_a_job_or_says_why_not():
    names = {words for words, _ in commands(PROGRAM)}
    assert {words[0] for words in names if "-".join(words) not in jobs.JOBS} == NO_JOBS.keys()
    assert jobs.JOBS.keys() - {"-".join(words) for words in names} == {"pipeline"}


@pytest.mark.long
@pytest.mark.parametrize("words", [words for words, _ in commands(PROGRAM)], ids=" ".join)
def test_a_help_shows_every_word(relit, monkeypatch, words):
    """The names of options too, at the usual width of a terminal."""
    monkeypatch.setenv("COLUMNS", "80")
    shown = relit(*words, "--help").out
    models = {option.name: (option, model) for model in reversed(COMMANDS.get(" ".join(words), [])) for option in options_of(model)}
    for name, parameter in parameters(" ".join(words)).items():
        assert {spelling for spelling in parameter.opts if spelling.startswith("--")} <= set(re.split(r"[\s,]+", shown))
        if name in models and words[0] != "submit":
            assert "".join(help_text(*models[name]).split()) in "".join(shown.split())

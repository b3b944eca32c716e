"""Forms have every option of the request models, with names, defaults and limits of the models."""

import copy

import pytest

from service.requests.base.base import Role
from service.requests.base.options import build, options_of
from service.requests.calibration_jobs import ProcamJob
from service.requests.imports.layouts import LAYOUTS
from service.requests.jobs import ANY_JOB, RelightJob, SolveJob
from service.server.pages.forms import BEGIN_WITH, CAPTURE_JOBS, FREE_JOBS, MAPS_JOBS, NEXT_STEPS, UNITS, Form, form_of, import_fields
from stage.capture.manifest import LIT_BY

KINDS = CAPTURE_JOBS | MAPS_JOBS | FREE_JOBS
CAPTURE, JOB, OTHER = "cap_0123456789abcdefghjk", "job_0123456789abcdefghjk", "job_1123456789abcdefghjk"

RIG = {"schema": "relit.rig/1", "name": "one lamp", "lights": [
    {"name": "A", "type": "distant", "direction": [0, 0, 1], "primaries": [{"name": "white", "irradiance": [1, 1, 1]}]}]}
REQUIRED = {
    "calibrate-dark": {"capture": CAPTURE, "images": ["0.exr"]}, "calibrate-flat-field": {"capture": CAPTURE, "images": ["0.exr"]},
    "calibrate-response": {"capture": CAPTURE, "images": ["0.exr", "1.exr", "2.exr"]},
    "calibrate-stereo": {"capture": CAPTURE, "options": {"board": "9x6", "square_m": 0.025}},
    "calibrate-procam": {"captures": [CAPTURE], "options": {"board": "9x6", "square_m": 0.025}},
    "join": {"maps": JOB, "depth": JOB}, "register": {"depths": [JOB, OTHER]}, "fuse": {"registered": JOB},
    "calibrate-white-balance": {"capture": CAPTURE, "images": ["0.exr"]},
    "calibrate-laser-planes": {"captures": [CAPTURE, CAPTURE], "options": {"board": "9x6", "square_m": 0.025}},
    "patterns": {"options": {"code": "gray", "projector": "64x32"}},
    "gauge-board": {"study": {"schema": "relit.gauge-study/1", "name": "pads", "runs": [
        {"result": JOB, "board": "A"}, {"result": OTHER, "board": "A"}]}},
    "drive": {"rig": RIG}, "calibrate-rig": {"capture": CAPTURE, "rig": RIG, "table": "cues.csv"},
}
"""What a job must have beside a capture, where it must."""
TYPED = {"calibrate-laser-planes": {"captures": [CAPTURE, CAPTURE], "board": "9x6", "square_m": 0.025},
         "calibrate-stereo": {"capture": CAPTURE, "board": "9x6", "square_m": 0.025},
         "calibrate-procam": {"captures": [CAPTURE], "board": "9x6", "square_m": 0.025},
         "patterns": {"code": "gray", "projector": "64x32"}}

VALUES: dict[str, object] = {"corners": [1.5, 1, 9, 1, 9, 5, 1, 5], "grid": [6, 4], "marker_m": 0.018}
"""Values where the usual one does not do: lists of another length than most, and a marker within its square."""
INSTEAD = {("calibrate-laser-planes", "step_m"): ("board", "square_m")}
"""What an option stands in place of."""
WITH: dict[tuple[str, str], dict[str, object]] = {("inspect-board", "stiffness_m"): {"remove": "spline"}} | {
    (kind, name): beside for kind in ("calibrate-procam", "calibrate-stereo", "calibrate-laser-planes")
    for name, beside in (("markers", {"marker_m": 0.018}), ("marker_m", {"markers": "aruco4"}))}
"""What an option needs beside it."""


def fields(form: Form):
    return {field.name: field for field in (*form.main, *form.more)}


def allowed(field) -> float:
    """A number within the limits of a field, whole eights where there is room: bits are."""
    if field.low and field.high:
        middle = (float(field.low) + float(field.high)) / 2
        return middle // 8 * 8 if middle > 8 else middle
    return float(field.low or 0) + 1


@pytest.mark.parametrize("kind", KINDS)
def test_every_option_has_a_control_and_what_is_read_or_has_no_default_stands_first(kind):
    form = form_of(kind, KINDS[kind])
    options = options_of(KINDS[kind])
    assert set(fields(form)) == {option.name for option in options}
    first = [option.name for option in options if option.role is Role.INPUT]
    assert [field.name for field in form.main] == first + [
        option.name for option in options if option.role is not Role.INPUT and option.field.is_required()]
    assert not any(field.required for field in form.more)


@pytest.mark.parametrize("kind", KINDS)
def test_places_lead_to_the_values_of_the_command_line(kind):
    """A value put at its places is read as the same request that `relit submit` builds from the flag."""
    model = KINDS[kind]
    inputs = REQUIRED.get(kind, {"capture": CAPTURE} if kind in CAPTURE_JOBS else {"maps": JOB})
    typed = TYPED.get(kind, inputs)
    for field in fields(form_of(kind, model)).values():
        value = {"boolean": field.default != "true", "integer": int(allowed(field)), "number": allowed(field), "integers": [1, 2, 3, 4],
                 "numbers": [0.25, 0.5, 1], **VALUES}.get(field.name if field.name in VALUES else field.value_type)
        if value is None and field.choices:
            value = next(each for each, _ in field.choices if each != field.default)
        if value is None:
            continue
        request = copy.deepcopy({"kind": kind, **inputs})
        others = INSTEAD.get((kind, field.name), ())
        for other in others:
            del request["options"][other]
        beside = WITH.get((kind, field.name), {})
        if beside:
            request.setdefault("options", {}).update(beside)
        for path in field.paths:
            target = request
            *parents, last = path.split(".")
            for name in parents:
                target = target.setdefault(name, {})
            target[last] = value
        text = ",".join(map(str, value)) if isinstance(value, list) else value
        words = {name: given for name, given in typed.items() if name not in others}
        assert ANY_JOB.validate_python(request) == build(model, words | beside | {field.name: text}), field.name


def test_what_each_job_begins_with_is_declared():
    assert set(BEGIN_WITH) == set(CAPTURE_JOBS) | set(MAPS_JOBS)
    assert {each for kind in CAPTURE_JOBS for each in BEGIN_WITH[kind]} == {*LIT_BY, "shots", "tiles"} == set(NEXT_STEPS)


@pytest.mark.parametrize(("holds", "kind"), [(holds, kind) for holds, steps in NEXT_STEPS.items() for kind in steps])
def test_a_next_step_needs_nothing_but_the_capture(holds, kind):
    assert holds in BEGIN_WITH[kind]
    assert ANY_JOB.validate_python({"kind": kind, "capture": CAPTURE}).kind == kind


def test_labels_are_words_with_their_units_in_brackets():
    forms = [form_of(kind, model) for kind, model in (CAPTURE_JOBS | MAPS_JOBS | FREE_JOBS).items()]
    labels = [field.label for form in forms for field in (*form.main, *form.more)]
    labels += [field.label for layout in LAYOUTS for field in import_fields(layout)]
    assert not [label for label in labels if label.rpartition(" ")[2] in (*UNITS, "mm", "rad")]
    assert {"Focal length (pixels)", "Pixel size (metres)", "Spin (degrees)", "Frequencies (Hz)"} <= set(labels)


def test_limits_and_defaults_are_those_of_the_model():
    found = fields(form_of("relight", RelightJob))
    assert (found["exposure"].low, found["exposure"].high, found["exposure"].default) == ("-32", "32", "0")
    assert (found["priority"].low, found["priority"].high, found["priority"].default) == ("0", "100", "50")
    assert found["compression"].default == "zip"
    solve = fields(form_of("solve", SolveJob))
    assert [value for value, _ in solve["method"].choices] == ["lambert", "robust", "gradient", "reference", "svbrdf"]
    assert solve["capture"].required and solve["capture"].control == "capture"
    procam = fields(form_of("calibrate-procam", ProcamJob))
    assert [(procam[name].control, procam[name].value_type, procam[name].required) for name in ("captures", "apply_to", "board")] == [
        ("captures", "strings", True), ("captures", "strings", False), ("text", "string", True)]

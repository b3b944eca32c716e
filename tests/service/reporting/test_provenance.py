"""Progress, timings and provenance."""

import ast
import importlib
import pkgutil
from pathlib import Path
from typing import Annotated

import pytest

import service
import service.requests
from service.reporting.progress import Timings
from service.reporting.provenance import UNREPORTED, choices, requested
from service.requests.base.base import DeviceRequest, Options, Role
from service.requests.base.options import role_of
from service.requests.calibrate import LightsRequest
from service.requests.depth import DepthRequest, TofOptions
from service.requests.export import ExportRequest
from tests.service.recording import Recording, Stage


def requests() -> dict[str, type[Options]]:
    """Every model of service.requests that a command takes whole."""
    found = {}
    for module in pkgutil.iter_modules(service.requests.__path__, "service.requests."):
        for name, model in vars(importlib.import_module(module.name)).items():
            if isinstance(model, type) and issubclass(model, DeviceRequest | LightsRequest | ExportRequest) and name.endswith("Request"):
                found[name] = model
    return found


@pytest.mark.filterwarnings("ignore:Pydantic serializer warnings")  # of the stand-ins for required values
@pytest.mark.parametrize("name", requests())
def test_a_new_option_is_recorded_by_itself(name):
    class Later(requests()[name]):  # type: ignore[misc]
        strength: float = 2.5
        """A new choice."""
        table: Annotated[Path | None, Role.INPUT] = None
        """A new input."""
        share: Annotated[str | None, Role.PART] = None
        """A new way to divide the work."""
        scratch: Annotated[Path | None, Role.MACHINE] = None
        """A new folder of the machine."""

    request = Later.model_construct(**{key: "x" for key, field in Later.model_fields.items() if field.is_required()})
    in_report, in_files = requested(request), choices(request)
    assert in_report["strength"] == in_files["strength"] == 2.5
    assert in_report["table"] is None and "table" not in in_files
    assert not {"share", "scratch"} & (in_report.keys() | in_files.keys())
    fields = {key: role_of(field) for key, field in Later.model_fields.items()}
    assert in_report.keys() == {key for key, role in fields.items() if role not in UNREPORTED}
    assert in_files.keys() == {key for key, role in fields.items() if role is Role.CHOICE}


def test_a_report_has_the_options_within_an_option_and_files_have_none_of_their_paths():
    request = DepthRequest(capture=Path("c"), out=Path("o"), tof=TofOptions(calibration=Path("c.json"), vote=False))
    assert requested(request)["tof"] == {"filters": [], "vote": False, "which": "strongest", "temperature_c": None, "calibration": "c.json"}
    assert choices(request)["tof"] == {"filters": [], "vote": False, "which": "strongest", "temperature_c": None}


def test_no_module_lists_the_options_that_it_records():
    texts = {path: path.read_text(encoding="utf-8") for path in Path(service.__file__).parent.rglob("*.py") if path.name != "provenance.py"}
    listed = [f"{path}:{node.lineno}" for path, text in texts.items() if "model_dump" in text for node in ast.walk(ast.parse(text))
              if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "model_dump"
              and {"include", "exclude"} & {keyword.arg for keyword in node.keywords}]
    assert listed == []


@pytest.mark.parametrize(("total", "told", "fault"), [
    (1, [], None), (1, [1], None), (3, [1, 2, 3], None), (3, [0, 0, 3], None), (100, [7, 100], None),
    (0, [], "has 0 steps"), (3, [1, 1, 1], "ends at 1 of 3"), (3, [], "ends at 0 of 3"), (3, [4], "ends at 4 of 3"),
    (3, [2, 1, 3], "goes back"),
])
def test_a_stage_that_does_not_come_to_its_total_is_found(total, told, fault):
    found = Stage("frames", total, told).fault
    assert (found is None) == (fault is None) and (fault is None or fault in found)


def test_timings_pass_everything_on_and_keep_the_seconds_of_each_stage():
    recording = Recording()
    timings = Timings(recording)
    timings.stage("frames", 2)
    timings.advance(1)
    timings.advance(2)
    timings.stage("write", 1)
    timings.stage("frames", 1)  # comes again: its seconds are added
    assert list(timings.close()) == ["frames", "write"] and all(seconds >= 0 for seconds in timings.seconds.values())
    assert recording.stages == [("frames", 2, [1, 2]), ("write", 1, []), ("frames", 1, [])]


def test_parts_of_a_stage_are_timed_and_not_told():
    recording = Recording()
    timings = Timings(recording)
    timings.stage("frames", 1)
    for _ in range(2):
        with timings.part("product"):
            pass
    assert list(timings.parts) == ["product"] and len(recording.stages) == 1

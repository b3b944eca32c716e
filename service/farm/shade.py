"""relit shade as a farm's job: one picture, or a task for each of a number of turns of the environment."""

import re

from service.errors import RequestError
from service.farm.document import Plain
from service.farm.job import JobOptions, job, picture_options, title
from service.farm.parameters import Job, Parameters
from service.requests.frame_range import numbered
from service.requests.near_lights import PointLight, RectangleLight, SphereLight
from service.requests.shade import ShadeRequest

MOST_TURNS = 1024
"""Values of a task's parameter, by the specification."""


def shade_job(request: ShadeRequest, options: JobOptions, turns: int | None) -> Job:
    """A job of one task, or of one for each turn.

    Args:
        request: of one picture, checked; its turn is the first.
        options: of the job.
        turns: how many pictures the environment turns once around in; None: one picture.

    Raises:
        RequestError: turns without an environment, too many, or no run of # in the picture's name for their number.
    """
    given = Parameters()
    words = ["shade", given.folder("Maps", request.maps, "IN", "The solved maps.") if request.maps.is_dir() else
             given.file("Maps", request.maps, "The solved maps.")]
    for option, lights in (("--light", request.light), ("--sphere", request.sphere), ("--rectangle", request.rectangle)):
        for light in lights:
            words += [option, _numbers(light)]
    if request.environment is not None:
        words += ["--environment", given.file("Environment", request.environment, "A lat-long map.")]
    if request.capture is not None:
        words += ["--capture", given.folder("Capture", request.capture, "IN", "The capture of the maps.")]
    folder = given.folder("OutputFolder", request.out.parent, "OUT", "Where the picture goes.")
    space = None
    if turns is None:
        words += ["--out", f"{folder}/" + given.text("PictureName", request.out.name, "Of the picture.")]
        if request.turn_degrees:
            words += ["--turn-degrees", repr(request.turn_degrees)]
    else:
        space = _turned(request, turns)
        words += ["--out", f"{folder}/{{{{Task.Param.Picture}}}}", "--turn-degrees", "{{Task.Param.TurnDegrees}}"]
    words += picture_options(request)
    return job(title("shade", request.maps), "shade", words, request, options, given, space)


def _turned(request: ShadeRequest, turns: int) -> dict[str, Plain]:
    name = request.out.name
    if request.environment is None:
        raise RequestError(f"--turns {turns}: turns the environment: give --environment MAP")
    if turns > MOST_TURNS:
        raise RequestError(f"--turns {turns}: a job has {MOST_TURNS} pictures at the most")
    if len(re.findall("#+", name)) != 1 or "{{" in name:
        raise RequestError(f"--out {request.out}: with --turns the file name needs one run of # for the number, such as turn.####.exr, "
                           "and no {{")
    return {"taskParameterDefinitions": [
        {"name": "Picture", "type": "STRING", "range": [numbered(name, number) for number in range(1, turns + 1)]},
        {"name": "TurnDegrees", "type": "FLOAT", "range": [request.turn_degrees + 360 * turn / turns for turn in range(turns)]},
    ], "combination": "(Picture, TurnDegrees)"}


def _numbers(light: PointLight | SphereLight | RectangleLight) -> str:
    """As the command line takes it."""
    values = light.model_dump(exclude={"axis", "anisotropy"} if isinstance(light, PointLight) and light.axis is None else None)
    return ",".join(repr(number) for value in values.values() for number in (value if isinstance(value, tuple) else (value,)))

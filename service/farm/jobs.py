"""The jobs that a farm can do: frames of `relit relight` in chunks, and pictures of `relit shade`."""

import re
from pathlib import Path
from typing import Any

from service.errors import RequestError
from service.farm.parameters import Parameters
from service.farm.template import Job, job
from service.requests.frame_range import numbered
from service.requests.relight import RelightRequest
from service.requests.shade import ShadeRequest

MOST_TURNS = 1024
"""The specification's limit on the values of a task's parameter."""


def relight_job(request: RelightRequest, *, chunk_frames: int, gpu: bool) -> Job:
    """Return a job whose tasks make parts of the frames.

    Args:
        request: of the whole range, which must be named; checked.
        chunk_frames: frames of a task, as a default.
        gpu: whether tasks need a worker with a GPU.

    Raises:
        RequestError: a text that no farm takes.
    """
    given = Parameters()
    words = given.words(request)
    folder, _, name = str(Path(request.out)).rpartition("/")
    words += ["--out", given.folder("OutputFolder", Path(folder), "OUT", "Where the frames go.") + "/"
              + given.text("FrameName", name, "Name of the frames, #### for the number."), "--only", "{{Task.Param.Chunk}}"]
    chunk = given.count("ChunkFrames", chunk_frames, "Frames of a task.")
    chunks = {"name": "Chunk", "type": "CHUNK[INT]", "range": "{{Param.Frames}}",
              "chunks": {"defaultTaskCount": chunk, "rangeConstraint": "CONTIGUOUS"}}
    return job("relight", request.capture, words, request, given, gpu=gpu, space={"taskParameterDefinitions": [chunks]},
               extensions=("TASK_CHUNKING",))


def shade_job(request: ShadeRequest, *, turns: int | None, gpu: bool) -> Job:
    """Return a job of one task, or of one for each turn.

    Args:
        request: of one picture, checked; its turn is the first.
        turns: how many pictures the environment turns once around in; None: one picture.
        gpu: whether tasks need a worker with a GPU.

    Raises:
        RequestError: turns without an environment, too many, or no run of # in the picture's name for their number.
    """
    given = Parameters()
    words = given.words(request if turns is None else request.model_copy(update={"turn_degrees": 0.0}))
    folder = given.folder("OutputFolder", request.out.parent, "OUT", "Where the picture goes.")
    if turns is None:
        words += ["--out", f"{folder}/" + given.text("PictureName", request.out.name, "Name of the picture.")]
        return job("shade", request.maps, words, request, given, gpu=gpu)
    words += ["--out", f"{folder}/{{{{Task.Param.Picture}}}}", "--turn-degrees", "{{Task.Param.TurnDegrees}}"]
    return job("shade", request.maps, words, request, given, gpu=gpu, space=_turned(request, turns))


def _turned(request: ShadeRequest, turns: int) -> dict[str, Any]:
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

"""relit relight as a farm's job: a task a chunk of frames."""

from pathlib import Path

from service.farm.document import Plain
from service.farm.job import JobOptions, job, picture_options, title
from service.farm.parameters import Job, Parameters
from service.requests.relight import RelightRequest


def relight_job(request: RelightRequest, options: JobOptions, chunk_frames: int) -> Job:
    """A job whose tasks make parts of the frames.

    Args:
        request: of the whole range, which must be named; checked.
        options: of the job.
        chunk_frames: frames of a task, as a default.

    Raises:
        RequestError: a text that no farm takes.
    """
    given = Parameters()
    words = ["relight", given.folder("Capture", request.capture, "IN", "A capture, or a folder with one a time step.")]
    if request.environment is not None:
        words += ["--environment", _environment(request.environment, given)]
    if request.keys is not None:
        words += ["--keys", given.file("Keys", request.keys, "Light keys.")]
    if request.maps is not None:
        words += ["--maps", given.folder("Maps", request.maps, "IN", "The solved maps that guide the frames.")]
    folder, _, name = str(Path(request.out)).rpartition("/")
    words += ["--out", given.folder("OutputFolder", Path(folder), "OUT", "Where the frames go.") + "/"
              + given.text("FrameName", name, "Of the frames, #### for the number.")]
    assert request.frames is not None
    frames = given.text("Frames", request.frames, "The whole range, such as 1-240.")
    words += ["--frames", frames, "--only", "{{Task.Param.Chunk}}"]
    if request.spin_degrees:
        words += ["--spin-degrees", repr(request.spin_degrees)]
    if request.weights is not None:
        words += ["--weights", str(request.weights)]
    words += picture_options(request)
    if request.align_to is not None:
        words += ["--align-to", given.text("AlignTo", request.align_to, "The tracking frame.")]
    elif request.align:
        words += ["--align"]
    chunk = given.count("ChunkFrames", chunk_frames, "Frames of a task.")
    chunks: dict[str, Plain] = {"name": "Chunk", "type": "CHUNK[INT]", "range": frames,
                                "chunks": {"defaultTaskCount": chunk, "rangeConstraint": "CONTIGUOUS"}}
    return job(title("relight", request.capture), "relight", words, request, options, given, {"taskParameterDefinitions": [chunks]},
               extensions=["TASK_CHUNKING"])


def _environment(environment: Path, given: Parameters) -> str:
    if "#" not in environment.name or environment.is_file():
        return given.file("Environment", environment, "A lat-long map.")
    return (given.folder("EnvironmentFolder", environment.parent, "IN", "The lat-long maps, one a frame.") + "/"
            + given.text("EnvironmentName", environment.name, "Of the maps, #### for the number."))

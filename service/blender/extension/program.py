"""The program `relit` on this machine, with its progress read from the lines of `--progress openjd`.

Source: Open Job Description, How Jobs Are Run, Stdout/Stderr Messages.
"""

import json
import subprocess
from pathlib import Path

from .service import JOB_FILE
from .tasks import Cancelled, Failure, Task

STATUS, PROGRESS, ERROR = "openjd_status: ", "openjd_progress: ", "relit: "


class Program:
    """What the extension asks of Relit, done by the program."""

    def __init__(self, path: str) -> None:
        self._path = path

    def solve(self, capture: Path, out: Path, environment: Path | None, levels: int, task: Task) -> Path:
        """Solve a capture into the folder `out` and export its asset with its rig; return the asset."""
        asset = out / "asset.usda"
        (out / "maps" / JOB_FILE).unlink(missing_ok=True)  # the maps are no longer those of a job
        self._run(["solve", capture, "--out", out / "maps"], task)
        words = ["export", out / "maps", "--out", asset, "--rig", capture, "--levels", levels]
        self._run([*words, *([] if environment is None else ["--environment", environment])], task)
        return asset

    def relight(self, capture: Path, maps: Path | None, keys: dict, environment: Path | None, frames: range, out: Path, task: Task) -> None:
        """Relight a frame range; `environment` and `out` may have #### for the number of a frame."""
        file = out.parent / "light_keys.json"
        file.write_text(json.dumps(keys, indent=1), encoding="utf-8")
        words = ["relight", capture, "--keys", file, "--frames", f"{frames[0]}-{frames[-1]}", "--out", out,
                 "--color-space", "lin_rec709_scene"]
        words += [] if maps is None else ["--maps", maps]
        self._run([*words, *([] if environment is None else ["--environment", environment])], task)

    def shade(self, maps: Path, lights: dict, environment: Path | None, out: Path, task: Task) -> None:
        """Shade solved maps once, under near lights as options of `relit shade` name them."""
        words = ["shade", maps, "--out", out, "--color-space", "lin_rec709_scene"]
        for kind, several in lights.items():
            for light in several:
                words += [f"--{kind}={','.join(f'{number:.9g}' for value in light.values() for number in value)}"]
        self._run([*words, *([] if environment is None else ["--environment", environment])], task)

    def _run(self, words: list, task: Task) -> None:
        command = [self._path, *map(str, words), "--progress", "openjd"]
        try:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                                       encoding="utf-8", errors="replace")
        except OSError as error:
            raise Failure(f"the program {self._path} cannot be started ({error.strerror}): give the path of relit in the preferences of "
                          "the extension") from error
        said = []
        stage = words[0]
        task.stoppable(process.terminate)
        try:
            assert process.stdout is not None
            for line in map(str.rstrip, process.stdout):
                if line.startswith(STATUS):
                    stage = f"{words[0]}: {line.removeprefix(STATUS)}"
                    task.tell(stage, 0)
                elif line.startswith(PROGRESS):
                    task.tell(stage, int(float(line.removeprefix(PROGRESS))))
                elif line:
                    said.append(line)
        except BaseException:
            process.terminate()
            raise
        finally:
            task.stoppable(None)
            process.stdout.close()
            code = process.wait()
        if task.cancelled:
            raise Cancelled
        if code:
            errors = [line.removeprefix(ERROR) for line in said if line.startswith(ERROR)] or said or [f"it ended with the code {code}"]
            raise Failure(f"relit {words[0]}: {errors[-1]}")

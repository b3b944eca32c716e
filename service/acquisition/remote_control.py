"""Captures that are started and watched from a page: `relit capture` as a process of its own, whose files say how far it is."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from service.acquisition.journal import lines_of, record
from service.acquisition.lights.lights import PLEASE, THEN_ENTER
from service.acquisition.meter import PICTURE_FILE
from service.acquisition.plans.plan import NAMED, read_plan
from service.acquisition.plans.shots import Shot, shots_of
from service.acquisition.preview import PREVIEW_FILE
from service.errors import RequestError
from service.relight.sheet import display, fit
from service.reporting.provenance import REPORT_FILE
from stage.colour.colour import linearise
from stage.colour.colour_spaces import linear_space
from stage.files import replacing
from stage.formats import images
from stage.importers.layout import color_space_of
from stage.rig.rig import read_rig

LINES = 40
"""The last lines of the process that are kept."""
PICTURE_ROWS = 480
END_S = 30.0
"""The longest time until the lamps are dark and the process has ended."""


class RemoteControl:
    """One stage, at which one capture is taken at a time."""

    def __init__(self, rig: Path, camera: str, trigger: str | None, folder: Path) -> None:
        """Read the rig; captures lie below a folder.

        Raises:
            StageError: the rig is wrong; names file and field.
        """
        self._rig, self._path, self._folder = read_rig(rig), rig.resolve(), folder
        self._words = ["--rig", str(self._path), "--camera", camera, *([] if trigger is None else ["--trigger", trigger])]
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._terminal = -1
        self._lines: deque[str] = deque(maxlen=LINES)
        self._prompt: str | None = None
        self._capture = folder
        self._shots: tuple[Shot, ...] = ()

    def described(self) -> dict[str, Any]:
        """Return the name of the rig, its lamps with their directions, and the names of plans."""
        lamps = [{"name": lamp.name, "direction": direction}
                 for lamp, direction in zip(self._rig.lights, self._rig.directions.tolist(), strict=True)]
        return {"name": self._rig.name, "lamps": lamps, "plans": list(NAMED)}

    def start(self, name: str, plan: str, *, preview: bool = False, then: str = "", retake: str | None = None) -> None:
        """Start a capture, go on with one, or meter the light.

        Raises:
            RequestError: a capture is running, or a name or the plan cannot be used.
        """
        if re.fullmatch(r"\w[\w-]{0,63}", name) is None:
            raise RequestError(f"name: {name!r} is no name of a capture: give letters, digits, - and _")
        if unknown := [word for word in plan.split(",") if word not in NAMED]:
            raise RequestError(f"plan: {unknown[0]!r} is none of {', '.join(NAMED)}")
        with self._lock:
            if self._running():
                raise RequestError("a capture is running: wait for its end, or stop it")
            self._shots, self._capture = shots_of(read_plan(plan), self._rig, None), self._folder / name
            words = [plan, *self._words, "--out", str(self._capture), *(["--preview"] if preview else []),
                     *(["--then", then] if then else []), *([] if retake is None else ["--retake", retake])]
            self._folder.mkdir(parents=True, exist_ok=True)
            if self._terminal >= 0:
                os.close(self._terminal)
            self._terminal, terminal = os.openpty()  # the program asks a person where its input is a terminal
            self._lines.clear()
            self._prompt = None
            try:
                self._process = subprocess.Popen([sys.executable, "-m", "service.cli.main", "capture", *words], stdin=terminal, text=True,
                                                 stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True)
            finally:
                os.close(terminal)
            threading.Thread(target=self._listen, args=[self._process], name="relit-set", daemon=True).start()

    def confirm(self) -> None:
        """Tell the capture that a person has done what it asked for."""
        with self._lock:
            if self._prompt is not None and self._running():
                self._prompt = None
                os.write(self._terminal, b"\n")

    def stop(self) -> None:
        """End the capture as Ctrl-C does, with the lamps dark and its pictures kept."""
        with self._lock:
            if self._process is not None and self._running():
                self._process.send_signal(signal.SIGINT)

    def close(self) -> None:
        """End the capture, and wait for it."""
        self.stop()
        if self._process is not None:
            self._process.wait(END_S)

    def state(self) -> dict[str, Any]:
        """Return how far the capture is: its shots with the faults of their pictures, what it asks for, and what there is of it."""
        taken: dict[str, dict[str, Any]] = {}
        retaken: dict[str, int] = {}
        for line in lines_of(self._capture):
            record(taken, line)
            if line.get("event") == "rejected":
                retaken[line["shot"]] = retaken.get(line["shot"], 0) + 1
        running = self._running()
        faults = {key: [words for _, words in line.get("faults", [])] for key, line in taken.items()}
        if not running and taken and (report := self._capture / REPORT_FILE).exists():  # all pictures together have been judged
            faults = {}
            for fault in json.loads(report.read_text())["faults"]:
                faults.setdefault(fault["shot"], []).append(fault["sentence"])
        shots = [{"shot": shot.key, "lamp": shot.lamp, "taken": shot.key in taken,
                  "retaken": retaken.get(shot.key, 0), "faults": faults.get(shot.key, [])} for shot in self._shots]
        found = {name: path.stat().st_mtime_ns for name in (PREVIEW_FILE, PICTURE_FILE) if (path := self._capture / name).exists()}
        return {"running": running, "code": None if self._process is None else self._process.poll(), "prompt": self._prompt,
                "shots": shots, "files": found, "lines": list(self._lines)}

    def file(self, name: str) -> Path | None:
        """Return the path of preview.png or meter.png of the capture; None where it is not there."""
        path = self._capture / name
        return path if name in (PREVIEW_FILE, PICTURE_FILE) and path.exists() else None

    def picture(self, shot: str, target: Path) -> bool:
        """Write the picture of a shot, as it is displayed, and return whether there is one."""
        line = next((line for line in reversed(lines_of(self._capture)) if line.get("shot") == shot and line.get("event") == "taken"), None)
        if line is None or not (path := self._capture / line["file"]).exists():
            return False
        pixels, space = images.read_pixels(path).astype(np.float32), color_space_of(path)
        small = fit(linearise(pixels, space), min(len(pixels), PICTURE_ROWS), kernel="triangle")
        shown = display(small, linear_space(space))
        with replacing(target, flush=False) as temporary:
            images.write_png(temporary, np.round(np.clip(shown, 0, 1) * 255).astype(np.uint8), srgb=True)
        return True

    def _running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def _listen(self, process: "subprocess.Popen[str]") -> None:
        assert process.stdout is not None
        for line in process.stdout:
            text = line.rstrip()
            if text.startswith(PLEASE) and text.endswith(THEN_ENTER):
                self._prompt = text.removeprefix(PLEASE).removesuffix(THEN_ENTER)
            elif text:
                self._lines.append(text)
        process.wait()

"""Captures that are started and watched from a page: `relit capture` as a process of its own, whose files say how far it is."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections import Counter, deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from service.acquisition.cameras.camera import LIVE
from service.acquisition.capture_files import JOURNAL_FILE, lines_of, taken_by
from service.acquisition.early_ingest import PREVIEW_FILE
from service.acquisition.lights.lights import PLEASE, THEN_ENTER
from service.acquisition.live_view import LiveView
from service.acquisition.meter import PICTURE_FILE
from service.acquisition.plans.plan import NAMED, Plan, choices_of, needs_projector, plan_of
from service.acquisition.plans.shots import FLAT, Shot, shots_of
from service.errors import RequestError
from service.relight.sheet import display, fit
from service.reporting.provenance import REPORT_FILE
from service.requests.acquire import PlanChoices
from service.requests.patterns import PatternCode
from stage.capture.light import OffLight
from stage.capture.manifest import FILE_NAME
from stage.colour.colour import linearise
from stage.colour.colour_spaces import linear_space
from stage.files import replacing, write_text
from stage.formats import images
from stage.importers.layout import color_space_of
from stage.rig.cues import rig_digest
from stage.rig.rig import read_rig

NAME = r"\w[\w-]{0,63}"
"""A name of a capture, which is that of its folder."""
CALIBRATIONS = {"ball": {"mirror-ball": "mirror-ball", "grey-ball": "grey-ball"}, "chart": {"chart": "chart"}}
"""For each step of what belongs to a capture, the kinds of `relit calibrate` by the folder of their pictures."""
SPOOL, PLANS = ".live", ".plans"
"""The folders of live pictures and of plans, in that of the captures."""
LINES = 40
"""The last lines of the process that are kept."""
PICTURE_ROWS = 480
END_S = 30.0
"""The longest time until the lamps are dark and the process has ended."""


class RemoteControl:
    """One stage, at which one capture is taken at a time."""

    def __init__(self, rig: Path, camera: str, folder: Path, *, trigger: str | None = None, projector: str | None = None,
                 projector_port: int | None = None) -> None:
        """Read the rig; captures lie below a folder, and devices are named as `relit capture` takes them.
        Raises RequestError if the size of the projector cannot be read. Raises StageError if the rig is wrong; names file and field."""
        self._rig, self._path, self._camera, self._folder = read_rig(rig), rig.resolve(), camera, folder
        size = None if projector is None else re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", projector)
        if projector is not None and size is None:
            raise RequestError(f"--projector: is {projector}: give width x height in pixels, as in 1280x800")
        self._projector = None if size is None else (int(size[1]), int(size[2]))
        given = {"--rig": self._path, "--camera": camera, "--trigger": trigger, "--projector": projector,
                 "--projector-port": projector_port}
        self._words = [str(word) for option, value in given.items() if value is not None for word in (option, value)]
        self._patterns = () if self._projector is None else tuple(map(str, PatternCode))
        self._plans = tuple(name for name in NAMED if self._projector is not None or not needs_projector(NAMED[name]))
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._terminal = -1
        self._lines: deque[str] = deque(maxlen=LINES)
        self._prompt: str | None = None
        self._address: str | None = None
        self._name, self._chosen, self._metering = "", PlanChoices(plan="olat"), False
        self._shots: tuple[Shot, ...] = ()
        self._live: LiveView | None = None
        self._calibrating: str | None = None
        self._calibrated: dict[tuple[str, str], int] = {}  # when the pictures had been taken that a step has calibrated

    def described(self) -> dict[str, Any]:
        """Return the name of the rig, its lamps with their directions, the names of plans, and whether the camera has a live view."""
        lamps = [{"name": lamp.name, "direction": direction}
                 for lamp, direction in zip(self._rig.lights, self._rig.directions.tolist(), strict=True)]
        return {"name": self._rig.name, "lamps": lamps, "plans": self._plans, "patterns": self._patterns,
                "live": self._camera.partition(":")[0] in LIVE}

    def open(self, name: str) -> None:
        """Show a capture that was taken before.
        Raises RequestError if a capture is running, there is no such capture, or it was not taken on this page with this rig."""
        with self._lock:
            self._refuse_beside_another()
            head = next(iter(lines_of(self._folder / name)), None) if re.fullmatch(NAME, name) else None
            if head is None:
                raise RequestError(f"name: there is no capture {name!r}")
            if head["rig"] != rig_digest(self._rig):
                raise RequestError(f"name: {name} was taken with another rig: start the service with it")
            chosen = choices_of(Plan.model_validate(head["plan"]))
            if chosen is None or not set(chosen.plan.split(",")) <= set(self._plans):
                raise RequestError(f"name: {name} was taken with a plan of its own: go on with relit capture")
            self._show(name, chosen)

    def start(self, name: str, chosen: PlanChoices, *, preview: bool = False, retake: Sequence[str] = ()) -> None:
        """Start a capture, go on with one, or meter the light.
        Raises RequestError if a capture is running, or a name or the plan cannot be used."""
        if re.fullmatch(NAME, name) is None:
            raise RequestError(f"name: {name!r} is no name of a capture: give letters, digits, - and _")
        if unknown := [word for word in chosen.plan.split(",") if word not in self._plans]:
            why = f"is none of {', '.join(self._plans)}"
            if unknown[0] in NAMED:
                why = "shows patterns: start the service with --projector 1280x800"
            raise RequestError(f"plan: {unknown[0]!r} {why}")
        with self._lock:
            self._refuse_beside_another()
            self._show(name, chosen)
            self._metering = preview
            plan = self._folder / PLANS / f"{name}.json"
            write_text(plan, plan_of(chosen).model_dump_json(by_alias=True))
            words = [str(plan), *self._words, "--out", str(self._capture), *(["--preview", "--no-live"] if preview else []),
                     *(word for shot in retake for word in ("--retake", shot))]
            self._darken()
            if self._terminal >= 0:
                os.close(self._terminal)
            self._terminal, terminal = os.openpty()  # the program asks a person where its input is a terminal
            try:
                self._run("capture", *words, terminal=terminal)
            finally:
                os.close(terminal)

    def calibrate(self, step: str) -> None:
        """Measure the lights by the ball, or the colours by the chart, that belongs to the capture that is shown, and write its manifest.
        Raises RequestError if a capture is running, or there is no such calibration."""
        with self._lock:
            self._refuse_beside_another()
            kind, source = self._calibrations().get(step, ("", Path()))
            if not kind or self._version() is None:
                raise RequestError(f"step: {self._name} has all its pictures and those of a ball or a chart before it is calibrated: "
                                   f"{step!r} is not there")
            self._lines.clear()
            self._calibrating = step
            self._run("calibrate", kind, str(source), "--apply-to", str(self._capture))

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

    def look(self, on: bool) -> None:
        """Begin or end the live view. Raises RequestError if a capture is running, or the camera has no live view."""
        with self._lock:
            self._darken()
            if on:
                self._refuse_beside_another()
                self._live = LiveView(self._path, self._camera, self._folder / SPOOL)

    def live_picture(self) -> bytes | None:
        """Return the last picture of the live view as PNG; None where there is none."""
        live = self._live
        return None if live is None else live.picture()

    def close(self) -> None:
        """End the capture and the live view, and wait for them."""
        with self._lock:
            self._darken()
        self.stop()
        if self._process is not None:
            self._process.wait(END_S)

    def state(self) -> dict[str, Any]:
        """Return how far the capture is: its shots with the faults of their pictures, what it asks for, and what there is of it.

        `version` is a word that is another one when its pictures are; None where there is no capture with all of them.
        """
        lines = lines_of(self._capture)
        taken, retaken = taken_by(lines), Counter(line["shot"] for line in lines if line.get("event") == "rejected")
        running = self._running()
        faults = {key: [_named(*fault) for fault in line.get("faults", [])] for key, line in taken.items()}
        if not running and taken and (report := self._capture / REPORT_FILE).exists():  # all pictures together have been judged
            faults = {}
            for fault in json.loads(report.read_text())["faults"]:
                faults.setdefault(fault["shot"], []).append(_named(fault["kind"], fault["sentence"]))
        shots = [{"shot": shot.key, "step": _step_of(shot), "lamp": shot.lamp, "taken": shot.key in taken,
                  "retaken": retaken[shot.key], "faults": faults.get(shot.key, [])} for shot in self._shots]
        found = {name: path.stat().st_mtime_ns for name in (PREVIEW_FILE, PICTURE_FILE) if (path := self._capture / name).exists()}
        live, version = self._live, self._version()
        chosen = PlanChoices.model_validate(self._chosen, from_attributes=True)  # without what else a request holds
        return {"name": self._name, "chosen": chosen.model_dump(), "running": running,
                "metering": self._metering and running, "prompt": self._prompt,
                "code": self._code(), "projector": self._address if running else None, "shots": shots,
                "files": found, "lines": list(self._lines), "folder": str(self._capture),
                "version": version, "calibrating": self._calibrating if running else None,
                "calibrations": {step: version is not None and self._calibrated.get((self._name, step)) == self._taken_at()
                                 for step in self._calibrations()},
                "captures": sorted(path.parent.name for path in self._folder.glob(f"*/{JOURNAL_FILE}")),
                "live": None if live is None else live.state()}

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

    @property
    def _capture(self) -> Path:
        return self._folder / self._name

    def _show(self, name: str, chosen: PlanChoices) -> None:
        self._shots = shots_of(plan_of(chosen), self._rig, self._projector)
        self._name, self._chosen, self._metering = name, chosen, False
        self._lines.clear()
        self._process = self._prompt = self._address = None

    def _run(self, *words: str, terminal: int | None = None) -> None:
        """Start a command, whose lines are listened to."""
        self._process = subprocess.Popen([sys.executable, "-m", "service.cli.main", *words], text=True,
                                         stdin=subprocess.DEVNULL if terminal is None else terminal, stdout=subprocess.PIPE,
                                         stderr=subprocess.STDOUT, start_new_session=True)
        threading.Thread(target=self._listen, args=[self._process, self._name, self._calibrating], name="relit-set", daemon=True).start()

    def _version(self) -> str | None:
        """Return a word that is another one when the capture is; None where not all of its pictures are there, or it is being made."""
        taken = taken_by(lines_of(self._capture))
        if self._running() or not self._shots or len(taken) < len(self._shots) or not (self._capture / FILE_NAME).exists():
            return None
        return f"{self._taken_at()}-{(self._capture / FILE_NAME).stat().st_mtime_ns}"

    def _taken_at(self) -> int:
        return (self._capture / JOURNAL_FILE).stat().st_mtime_ns

    def _calibrations(self) -> dict[str, tuple[str, Path]]:
        """Return the kind of `relit calibrate`, and the capture that it reads, of each step that belongs to the capture that is shown."""
        return {step: (kind, folder) for step, kinds in CALIBRATIONS.items() for name in (self._name, f"{self._name}-{step}")
                for place, kind in kinds.items() if self._name and ((folder := self._folder / name / place) / FILE_NAME).exists()}

    def _refuse_beside_another(self) -> None:
        if self._running():
            raise RequestError("a capture is running: wait for its end, or stop it")

    def _darken(self) -> None:
        """End the live view, so that the camera and the lamps are free."""
        if self._live is not None:
            self._live.close()
            self._live = None

    def _running(self) -> bool:
        return self._code() is None and self._process is not None

    def _code(self) -> int | None:
        process = self._process
        return None if process is None else process.poll()

    def _listen(self, process: "subprocess.Popen[str]", name: str, step: str | None) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            if process is not self._process:  # of a child of it that outlives it
                continue
            text = line.rstrip()
            if text.startswith(PLEASE) and text.endswith(THEN_ENTER):
                self._prompt = text.removeprefix(PLEASE).removesuffix(THEN_ENTER)
            elif text:
                self._lines.append(text)
                if text.startswith(PLEASE) and (address := re.search(r"http://\S+", text)) is not None:
                    self._address = address[0]
        if process.wait() == 0 and step is not None:
            self._calibrated[name, step] = (self._folder / name / JOURNAL_FILE).stat().st_mtime_ns
        if process is self._process:
            self._calibrating = None


def _named(kind: str, sentence: str) -> str:
    """Return a fault as `relit capture` prints it."""
    return f"{kind.replace('_', ' ')}: {sentence}"


def _step_of(shot: Shot) -> str:
    """Return what the picture of a shot is for: ball, chart, dark, flat or object."""
    if shot.folder:
        return "ball" if shot.folder.endswith("-ball") else shot.folder
    if shot.name == FLAT:
        return FLAT
    return "dark" if isinstance(shot.light, OffLight) else "object"

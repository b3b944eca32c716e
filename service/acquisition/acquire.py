"""Take a capture shot by shot: lamps, settling, picture, checks, files; and leave the lamps dark however it ends."""

import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from service.acquisition.cameras.camera import SPOOL, Camera, NoPictureError, Picture, Setup, open_camera
from service.acquisition.capture_files import CaptureFiles, Journal
from service.acquisition.checks.expectation import Fault, FaultKind, said
from service.acquisition.checks.judge import FULL_SCALE, Judge
from service.acquisition.checks.unreached import ADVICE
from service.acquisition.lights.lights import Ask, Lights
from service.acquisition.plans.plan import Plan, read_plan
from service.acquisition.plans.shots import Shot, refuse_dimming, shots_of
from service.acquisition.projector import PatternImages, Projector
from service.acquisition.resuming import change_since, compared_shot, refuse_other_settings, settings_of_files
from service.errors import RequestError
from service.play.play import ended_by_signals
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, report
from service.requests.acquire import AcquireRequest
from stage.errors import ImageError
from stage.files import write_text
from stage.formats import images
from stage.importers.layout import color_space_of
from stage.rig.controllers import Controllers
from stage.rig.cues import rig_digest
from stage.rig.rig import Rig, read_rig
from stage.stack import fingerprint

LATE_POLL_S = 0.05
"""The time between two looks for pictures that are late."""
NO_LAMPS = Rig.model_construct(schema_="relit.rig/1", name="no lamps", color_space="lin_rec709_scene", subject_m=(0.0, 0.0, 0.0),
                               controllers=Controllers(), camera=None, lights=())
"""The rig of a capture under a projector alone."""


class AcquireResult(NamedTuple):
    """A summary of what was taken."""

    path: Path
    """The folder of the capture."""
    taken: int
    """Number of pictures that were taken in this run."""
    there: int
    """Number of shots of the plan that have a picture."""
    shots: int
    """Number of shots of the plan."""
    faults: tuple[Fault, ...]
    """Faults of the pictures that the capture has, and of shots without a picture."""
    retaken: tuple[Fault, ...]
    """Faults for which pictures were taken again."""
    own_s: tuple[float, ...]
    """Seconds that each picture of this run took beside settling, exposure and transfer."""


class Receiver(Protocol):
    """Gets the pictures of a capture while others are taken."""

    def open(self) -> None:
        """Begin; the journal of the capture is there."""

    def send(self, name: str, *, new: bool) -> None:
        """Take note of a file of the capture, and return at once; `new`: it was taken in this run."""

    def stop(self) -> None:
        """End, as the capture has ended before its last picture."""


class Acquisition:
    """One run of a capture."""

    def __init__(self, request: AcquireRequest, ask: Ask, tell: Ask = print, progress: Progress | None = None) -> None:
        """Read the plan and the rig, and open the journal and the camera; no lamp is switched yet.
        `ask`: asks a person to do something, and returns when it is done. `tell`: tells a person something, and returns at once. Raises
        RequestError if an option cannot be used, the folder holds another capture, or the camera cannot be opened. Raises StageError if the
        plan or the rig is wrong; names file and field."""
        self._request, self._ask, self._tell, self._timings = request, ask, tell, Timings(progress)
        self._projector: Projector | None = None
        self.rig: Rig = NO_LAMPS if request.rig is None else read_rig(request.rig)
        self.plan: Plan = read_plan(request.plan)
        self.shots: tuple[Shot, ...] = shots_of(self.plan, self.rig, request.projector)
        refuse_dimming(self.shots, self.rig)
        self.patterns: PatternImages = PatternImages(request, self.shots)
        head = {"plan": self.plan.model_dump(mode="json", by_alias=True), "rig": rig_digest(self.rig), "camera": request.camera}
        self.journal = Journal(request.out, head)
        known = None if self.journal.known is None else frozenset(self.journal.known)
        self._camera: Camera = open_camera(request.camera, Setup.of(request, known))
        if self.journal.known is None:
            self.journal.begin(self._camera.present())
        self._files = CaptureFiles(request.out, self.rig, self.shots, request.color_space, request.saturation)
        self.judge = Judge(self.rig)
        self.faults: dict[str, list[Fault]] = {}  # of each shot's picture, or of its absence, by the key of the shot
        self.retaken: list[Fault] = []  # the faults of pictures that were taken again, and of pictures that came late
        self._own: list[float] = []
        self._receivers: list[Receiver] = []

    def run(self, stop: threading.Event | None = None, receivers: Sequence[Receiver] = ()) -> AcquireResult:
        """Take all pictures that are missing; ends early when `stop` is set or the program is interrupted, with the lamps dark.
        `receivers`: get the name of each picture of the capture itself; opened before a lamp is switched. Raises RequestError if the lamps
        or the camera do not answer any more; the pictures that were taken are kept."""
        with ended_by_signals(stop or threading.Event()) as stopping, ExitStack() as receiving:
            lights = None
            try:
                for receiver in receivers:
                    receiver.open()
                    receiving.callback(receiver.stop)
                    self._receivers.append(receiver)
                self._recall()
                self.journal.camera(self._camera.settings)
                lights = Lights(self._request.rig or Path(), self.rig, self._ask)
                self._adopt()
                self._withdraw()
                if any(shot.projected and shot.key not in self.journal.taken for shot in self.shots):
                    self._open_projector()  # lamps before the first pattern find it black
                if 0 < len(self.journal.taken) < len(self.shots):
                    self._compare(lights, stopping)
                self._timings.stage("capture", len(self.shots))
                for number, shot in enumerate(self.shots, start=1):
                    if shot.key not in self.journal.taken:
                        self._take(shot, lights, stopping)
                    if stopping.is_set():
                        break
                    self._timings.advance(number)
                else:
                    self._review(lights, stopping)
            finally:
                settings = self._close(lights)
                self.journal.close()
            if len(self.journal.taken) == len(self.shots):
                receiving.pop_all()
        faults = tuple(fault for found in self.faults.values() for fault in found)
        self._report(faults, settings)
        return AcquireResult(self._request.out, len(self._own), len(self.journal.taken), len(self.shots), faults, tuple(self.retaken),
                             tuple(self._own))

    def _open_projector(self) -> None:
        """Serve the projector's page, and wait for its window."""
        request = self._request
        assert request.projector is not None
        self._projector = Projector(request.projector, request.projector_port, request.timeout, request.out / SPOOL)
        self._tell(f"open {self._projector.address} in a browser on the projector's screen, and click into it")
        self._projector.wait()

    def _light(self, shot: Shot, lights: Lights) -> None:
        """Switch the lamps of a shot, and show its pattern; other shots find the projector black."""
        lights.set(shot.levels)
        if shot.projected and self._projector is None:  # one that is compared, or in which all together have shown a fault
            self._open_projector()
        if self._projector is not None:
            self._projector.show(self.patterns.image(shot, self._greys))

    def _greys(self) -> dict[float, Path]:
        """Return the pictures of even grey that there are, by its level."""
        return {shot.grey: self._request.out / self.journal.taken[shot.key]["file"] for shot in self.shots
                if shot.grey is not None and shot.key in self.journal.taken}

    def _recall(self) -> None:
        """Take note of the pictures that an earlier run has taken; those that are deleted or damaged since are taken again."""
        for shot, line in [(each, self.journal.taken[each.key]) for each in self.shots if each.key in self.journal.taken]:
            path = self._request.out / line["file"]
            try:
                pixels = images.read_pixels(path) if path.exists() else None
            except ImageError:  # as where the power failed
                pixels = None
            if pixels is None:
                self.retaken.append(Fault(shot.key, FaultKind.MISSING, f"{path} is deleted or damaged since it was taken"))
                self.journal.picture(shot.key, "rejected", {**self._files.withdraw(shot, line), **said(self.retaken[-1:])})
                continue
            self.faults[shot.key] = [Fault(shot.key, FaultKind(kind), sentence) for kind, sentence in line.get("faults", [])]
            self.judge.accept(shot, pixels, *self._encoding(path), self.faults[shot.key])
            self._send(shot, new=False)

    def _adopt(self) -> None:
        """Take the picture that came after an earlier run had released the camera and before it recorded the picture."""
        released, left = self.journal.released, self._camera.unasked()
        shot = next((shot for shot in self.shots if released is not None and shot.key == released["shot"]), None)
        if shot is None or released is None or len(left) != 1 or shot.key in self.journal.taken:
            for path in left:  # of several nobody knows which is the shot's; recorded, none is taken for another shot's later
                self.journal.picture("" if released is None else released["shot"], "unasked", {"source": path.name})
            return
        picture = Picture(left[0], images.read_pixels(left[0]))
        if faults := self.judge.judge(shot, picture.pixels, *self._encoding(picture.path)):
            self.journal.picture(shot.key, "rejected", {**self._files.reject(shot, picture.path, released["attempt"]), **said(faults)})
        else:
            self._accept(shot, picture, [])

    def _withdraw(self) -> None:
        """Take the pictures away that are to be taken again."""
        shots = {shot.key: shot for shot in self.shots}
        for key in self._request.retake:
            if key not in shots:
                raise RequestError(f"--retake {key}: the plan has no such picture: its last one is {self.shots[-1].key}")
            if shots[key].grey is not None and any(shot.pattern is not None and shot.key in self.journal.taken for shot in self.shots):
                raise RequestError(f"--retake {key}: patterns have been shown by the response that it measured: begin a new capture")
            if key in self.journal.taken:
                self.journal.picture(key, "rejected", {**self._files.withdraw(shots[key], self.journal.taken[key]), "faults": []})
                self.judge.forget(shots[key])
                self.faults.pop(key, None)

    def _compare(self, lights: Lights, stopping: threading.Event) -> None:
        """Take a picture of an earlier run again, and refuse to go on if something is not as it was."""
        refuse_other_settings(self._request.out, self.journal.settings, self._camera.settings, self.shots)
        shot = compared_shot([shot for shot in self.shots if shot.key in self.journal.taken], self.judge, self.rig)
        self._light(shot, lights)
        if stopping.wait(self.plan.settle_s):
            return
        for owed in (1, 0):  # the first to come may be a picture for which a run that was killed had released the camera
            self.journal.release(shot.key, 0)  # else a run after this one would take its picture for that of an earlier release
            try:
                picture = self._camera.take(shot.exposure_s)
            except NoPictureError as error:
                raise RequestError(f"the camera does not answer: {error}") from error
            self.journal.picture(shot.key, "compared", {"source": picture.path.name})
            change = change_since(self._request.out / self.journal.taken[shot.key]["file"], picture, shot, self.judge, self.rig,
                                  *self._encoding(picture.path))
            if change is None:
                return
            self._await(shot, owed, stopping)
        raise RequestError(f"{self._request.out}: {change}, or give another folder to --out and begin again")

    def _take(self, shot: Shot, lights: Lights, stopping: threading.Event) -> None:
        """Take the picture of a shot, again where it has a fault, and keep the last one."""
        if shot.prompt is not None:
            self._ask(shot.prompt)
        owed = 0  # releases whose picture has not come
        for attempt in range(1, self._request.retakes + 2):
            began = time.perf_counter()
            self._light(shot, lights)
            if stopping.wait(self.plan.settle_s):
                return
            for path in self._camera.unasked():
                self._notice(Fault(shot.key, FaultKind.LATE, f"{path.name} came when no picture was asked for"), path)
            self.journal.release(shot.key, attempt)
            released = time.perf_counter()
            try:
                picture = self._camera.take(shot.exposure_s)
            except NoPictureError as error:
                owed += 1
                missing = Fault(shot.key, FaultKind.MISSING, str(error))
                self.faults[shot.key] = [missing]
                self.retaken.append(missing)
                continue
            came = time.perf_counter()
            if owed:
                self._await(shot, owed, stopping)
                owed = 0
            faults = self.judge.judge(shot, picture.pixels, *self._encoding(picture.path))
            if faults and attempt <= self._request.retakes:
                self.retaken += faults
                self.journal.picture(shot.key, "rejected", {**self._files.reject(shot, picture.path, attempt), **said(faults)})
                continue
            self._refuse_darkness(shot, picture, faults, attempt)
            self._accept(shot, picture, faults)
            self._own.append(released - began - self.plan.settle_s + time.perf_counter() - came)
            return
        self._await(shot, owed, stopping)

    def _refuse_darkness(self, shot: Shot, picture: Picture, faults: list[Fault], attempt: int) -> None:
        """Raise RequestError where two lamps did not light, at every attempt, and none has yet."""
        if not any(fault.kind is FaultKind.UNLIT for fault in faults) or shot.lamp is None:
            return
        lamps = {each.key for each in self.shots if each.lamp is not None and each.key in self.journal.taken}
        if lamps and all(any(fault.kind is FaultKind.UNLIT for fault in self.faults.get(key, ())) for key in lamps):
            self.journal.picture(shot.key, "rejected", {**self._files.reject(shot, picture.path, attempt), **said(faults)})
            raise RequestError(f"no lamp has lit yet: {ADVICE} Then run the same command again, with --retake {min(lamps)}")

    def _await(self, shot: Shot, owed: int, stopping: threading.Event) -> None:
        """Wait for pictures that are late, while the lamps shine for which they were asked, so that none is taken for another shot's."""
        until = time.monotonic() + self._request.timeout
        while owed > 0 and time.monotonic() < until and not stopping.wait(LATE_POLL_S):
            for path in self._camera.unasked():
                self._notice(Fault(shot.key, FaultKind.LATE, f"{path.name} came late"), path)
                owed -= 1

    def _notice(self, fault: Fault, path: Path) -> None:
        """Record a picture that no shot has."""
        self.retaken.append(fault)
        self.journal.picture(fault.shot, "unasked", {"source": path.name, **said([fault])})

    def _encoding(self, path: Path) -> tuple[str, float]:
        """Return the colour space of a picture, and the value from which its readings are clipped."""
        return self._request.color_space or color_space_of(path), self._request.saturation or FULL_SCALE

    def _accept(self, shot: Shot, picture: Picture, faults: list[Fault]) -> None:
        if (wrong := self._files.wrong_size(picture.path)) is not None:
            self.journal.picture(shot.key, "rejected", {**self._files.reject(shot, picture.path, 0), **said(faults)})
            raise RequestError(wrong)
        self.judge.accept(shot, picture.pixels, *self._encoding(picture.path), faults)
        self.faults[shot.key] = faults
        self.journal.picture(shot.key, "taken", {**self._files.keep(shot, picture.path), **said(faults)})
        self._files.write_manifest(shot.folder, self.journal.taken)
        self._send(shot, new=True)

    def _send(self, shot: Shot, *, new: bool) -> None:
        """Name the picture of a shot of the capture itself to the receivers."""
        for receiver in self._receivers if not shot.folder else ():
            receiver.send(self.journal.taken[shot.key]["file"], new=new)

    def _review(self, lights: Lights, stopping: threading.Event) -> None:
        """Take those pictures again, the worst first, in which all of them together show a fault that none showed when it came."""
        shots = {shot.key: shot for shot in self.shots}
        for fault in self.judge.review() if self._request.retakes else ():
            shot, line = shots[fault.shot], self.journal.taken[fault.shot]
            if self.faults.get(shot.key) or stopping.is_set():
                continue
            self.retaken.append(fault)
            self.journal.picture(shot.key, "rejected", {**self._files.withdraw(shot, line), **said([fault])})
            self.judge.forget(shot)
            self._take(shot._replace(prompt=None), lights, stopping)
        self.faults = {key: found for key, found in self.faults.items() if key not in self.journal.taken}  # no picture came
        for fault in self.judge.review():
            self.faults[fault.shot] = [fault]

    def _close(self, lights: Lights | None) -> Mapping[str, str]:
        """Turn the lamps dark, end the projector's page, and let go of the camera; return the settings that it told."""
        with ExitStack() as closing:
            closing.callback(self._camera.close)
            if self._projector is not None:
                closing.callback(self._projector.close)
            if lights is not None:
                closing.callback(lights.close)
            return self._camera.settings  # a question would open a closed camera anew, or find nothing

    def _report(self, faults: tuple[Fault, ...], settings: Mapping[str, str]) -> None:
        """Write report.json of the capture."""
        missing = [shot.key for shot in self.shots if shot.key not in self.journal.taken]
        own = {"median": round(1e3 * float(np.median(self._own)), 1)} if self._own else {}
        inputs = {} if (rig := self._request.rig) is None else {"rig": {"path": str(rig), "content": fingerprint.digest(rig)}}
        text = report(self._request, inputs=inputs, rig=self.rig.name, shots=len(self.shots), pictures=len(self.journal.taken),
                      camera_settings=settings or settings_of_files(self._request.out, self.journal.taken), missing=missing,
                      faults=[fault._asdict() for fault in faults], retaken=[fault._asdict() for fault in self.retaken], own_ms=own,
                      projector_response=self.patterns.entry(), seconds=self._timings.close())
        write_text(self._request.out / REPORT_FILE, text)


def acquire(request: AcquireRequest, ask: Ask, tell: Ask = print, progress: Progress | None = None, stop: threading.Event | None = None
            ) -> AcquireResult:
    """Take a capture, or go on with one; see `Acquisition`."""
    return Acquisition(request, ask, tell, progress).run(stop)


def refuse_to_ask(what: str) -> None:
    """Refuse what a person would have to do, where nobody can be asked."""
    raise RequestError(f"somebody must act: {what}: start the capture from a terminal")

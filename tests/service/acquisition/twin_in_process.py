"""The shipped owl on the twin of a stage with 96 lamps, in the process of a test, and its faults."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np

from service.acquisition.acquire import AcquireResult, acquire, refuse_to_ask
from service.acquisition.cameras.watched_folder import WatchedFolder
from service.acquisition.checks.expectation import Fault, FaultKind
from service.acquisition.lights import dmx
from service.requests.acquire import AcquireRequest
from service.requests.play import PictureFault, TwinRequest
from service.twin.camera import TwinCamera
from service.twin.twin import open_twin
from stage.capture.capture import Capture
from tests.scenes.patched_rigs import write_plan
from tests.scenes.rigs import write_rig
from tests.service.acquisition.scenes import BRIGHT
from tests.service.owl import OWL

KINDS = {PictureFault.DEAD: FaultKind.UNLIT, PictureFault.WRONG: FaultKind.WRONG_LIGHT, PictureFault.DOUBLED: FaultKind.DOUBLED,
         PictureFault.DROPPED: FaultKind.MISSING, PictureFault.LATE: FaultKind.LATE, PictureFault.MOVED: FaultKind.MOVED,
         PictureFault.CLIPPED: FaultKind.CLIPPED, PictureFault.AMBIENT: FaultKind.AMBIENT, PictureFault.FOCUS: FaultKind.UNSHARP}
LEAST_LIGHT = {PictureFault.MOVED: 0.6, PictureFault.FOCUS: 0.4, PictureFault.WRONG: 0.3, PictureFault.DEAD: 0.3}
"""The part of the mean light of a lamp from which a fault is told on the owl; others from 0.05. docs/set.md says it."""
TIMEOUT_S = 0.5


class TwinInProcess:
    """The twin of a stage without sockets: what lamps are told is what its camera sees, which writes into a watched folder."""

    def __init__(self, folder: Path, *, exposure: float = -3.0, noise: float = 0.001, **address: str) -> None:
        """Light the owl at 1/8 of its exposure: its brightest pictures come to 0.9 of full scale."""
        self.rig_path, self._folder = folder / "rig.json", folder
        write_rig(self.rig_path, [frame.light.direction for frame in Capture.open(OWL).manifest.frames], {"white": (1.0, 1.0, 1.0)},
                  irradiance=3.0, **address)
        self._request = TwinRequest(rig=self.rig_path, capture=OWL, exposure=exposure, noise=noise, cache=folder)
        self._twin = open_twin(self._request)
        self.levels = np.zeros(len(self._twin.rig.emitters))
        self._pictures: dict[bytes, np.ndarray] = {}
        self.light = np.array([self.radiance(row).mean() for row in np.eye(len(self.levels))])
        """What each lamp gives, as a part of what lamps give on the average."""
        self.light /= self.light.mean()

    def radiance(self, levels: np.ndarray) -> np.ndarray:
        """Return the picture at levels, computed once."""
        key = levels.tobytes()
        if key not in self._pictures:
            self._pictures[key] = self._twin.picture.radiance(levels)
        return self._pictures[key]

    def capture(self, name: str, seed: int, faults: Mapping[int, PictureFault], **options: object) -> AcquireResult:
        """Take the dark picture and those of all lamps, with a fault at the first release under each of these lamps."""
        left, folder = dict(faults), self._folder / f"{name}_watched"
        folder.mkdir()
        camera = TwinCamera(self._twin.rig, SimpleNamespace(radiance=self.radiance, space=self._twin.picture.space), None, folder,
                            self._request.model_copy(update={"seed": seed}))
        plan = write_plan(self._folder, {"take": "dark"}, {"take": "olat"})

        def release(_: WatchedFolder, exposure_s: float | None) -> None:
            lit = np.flatnonzero(self.levels)
            found = left.pop(int(lit[0]), None) if len(lit) == 1 else None
            with mock.patch.object(camera, "_faults", lambda number: set() if found is None else {found}), \
                    mock.patch("service.twin.camera.levels_of_universes", lambda rig, values: self.levels), \
                    mock.patch.object(camera, "_listener", SimpleNamespace(last=SimpleNamespace(values={}))):
                camera.release(exposure_s)
        switch = SimpleNamespace(set=lambda levels: setattr(self, "levels", levels), close=lambda: None)
        with mock.patch.object(WatchedFolder, "_release", release), mock.patch.object(dmx, "open_switch", lambda path, rig, ask: switch), \
                mock.patch("service.twin.camera.LATE_S", 1.5 * TIMEOUT_S):
            return acquire(AcquireRequest(**{"plan": str(plan), "rig": self.rig_path, "camera": f"watch:{folder}", "timeout": TIMEOUT_S,
                                             "out": self._folder / name, **options}), refuse_to_ask)

    def faults(self, seed: int) -> dict[int, PictureFault]:
        """Return all kinds of faults at random lamps, none beside another in the order of the rig, each where it can be told."""
        random, made = np.random.default_rng(seed), {}
        for kind in PictureFault:
            able = np.flatnonzero((self.light > LEAST_LIGHT.get(kind, 0.05)) & (np.roll(self.light, -1) > 0.05))
            free = [lamp for lamp in able.tolist() if not {lamp - 1, lamp, lamp + 1} & made.keys()
                    and (kind is not PictureFault.AMBIENT or self.light[lamp] < BRIGHT)]
            made[int(random.choice(free))] = kind
        return made


def wanted(faults: Mapping[int, PictureFault]) -> set[tuple[str, FaultKind]]:
    """Return the shots of lamps with faults, and the fault that should be named; a late picture is missing first."""
    found = {(f"{lamp + 2:04d}_light_{lamp + 1:03d}", KINDS[kind]) for lamp, kind in faults.items()}
    return found | {(shot, FaultKind.MISSING) for shot, kind in found if kind is FaultKind.LATE}


def named(faults: Iterable[Fault]) -> set[tuple[str, FaultKind]]:
    """Return the shots and kinds of faults; a picture that is far too bright may also clip."""
    return {(fault.shot, FaultKind.CLIPPED if fault.kind is FaultKind.BRIGHT else fault.kind) for fault in faults}

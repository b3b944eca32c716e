"""Devices that contradict each other: each fits the boards alone, and together they do not.

The reasons are those that the corners of one device alone do not show: a device that was moved, turned or refocused between the views,
views whose images are not of one moment or were exchanged, and images that are mirrored or sheared. A board whose squares are none is
another one.

Convention: as bundle.py.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from service.calibrate.solvers.boards.alone import Alone, Sight, alone, camera_matrix, each_alone, sights_of
from service.calibrate.solvers.boards.bundle import Bundle, adjust, after, inverse
from stage.errors import CalibrationError

CONTRADICTED, AGREED = 4.0, 2.0
"""`Bundle.excess` from which devices contradict each other, and up to which they do not. Noise gives 1.6 at most in 40 calibrations, and
more than 4 in one of 100 000 (chi squared of the 12 degrees of freedom that three views of two devices leave)."""
MISREAD = 100.0
"""`Bundle.excess` from which other readings of the images are tried: images that are mirrored leave 100 000 and more."""
LEAST_VIEWS = 3
"""Views that must agree, for the others to be named."""
ASPECT, MOST_ASPECT = 0.01, 0.05
"""By how much taller squares are tried to be than wide, and the most by which prints are: a print is scaled by a few percent at most."""
SHEARED = 0.75
"""Part of what a device leaves alone, down to which its image must fit sheared, for keystone correction to be named."""
ALIKE = 2.0
"""Readings fit alike whose views agree to within this many times the best one's pixels."""
Reading = Callable[[np.ndarray], np.ndarray]


def contradiction(found: Bundle, names: Sequence[str], views: Sequence[str]) -> str | None:
    """Return how devices contradict each other, and what does, or None. `names`: of the devices. `views`: names of the views."""
    if not found.excess > CONTRADICTED:
        return None
    own = _listed([f"{device.rms_px:.2g}" for device in found.alone])
    said = f"{_listed(names)} contradict each other: alone they fit the boards to {own} px, together to {found.rms_px():.2g} px"
    if found.excess > MISREAD:
        for device in range(1, len(names)):
            reading = _other_reading(found, device, names[device], names[0])
            if reading is not None:
                return f"{said}; {reading}"
    for device, name in list(enumerate(names))[1:]:
        sheared = _sheared(found, device, name)
        if sheared is not None:
            raise CalibrationError(f"{said}; {sheared}")
    taller = _other_aspect(found, names)
    if taller is not None:
        return f"{said}; {taller}"
    odd = [views[view] for view in _odd_views(found)]
    which = f"; without {', '.join(odd)} they do not" if odd else ""
    return (f"{said}{which}: check that nothing moved or was refocused between the views, that the images of a view are of one moment, and "
            "that the board is flat")


def _listed(words: Sequence[str]) -> str:
    return f"{', '.join(words[:-1])} and {words[-1]}"


def _other_aspect(found: Bundle, names: Sequence[str]) -> str | None:
    """Return by how much the squares of the board are taller than wide, if nothing is contradicted then; None where that is not so."""

    def fitted(aspect: float) -> Bundle:
        sights = [sight._replace(board=sight.board * [1, aspect, 0]) for sight in found.sights]
        return adjust(sights, each_alone(sights, [device.size for device in found.alone], names))

    aspect = 1.0
    try:
        for step in (ASPECT, ASPECT / 4):
            below, at, above = (fitted(aspect + times * step).rms_px() ** 2 for times in (-1, 0, 1))
            bend = below - 2 * at + above
            if not bend > 0:
                return None
            aspect += step * float(np.clip((below - above) / (2 * bend), -3, 3))
        best = fitted(aspect)
    except CalibrationError:  # boards of another form determine no lens
        return None
    if not (abs(aspect - 1) < MOST_ASPECT and best.excess < AGREED):
        return None
    form = f"{100 * abs(aspect - 1):.2g} % {'taller than wide' if aspect > 1 else 'wider than tall'}"
    return (f"with squares that are {form} they fit to {best.rms_px():.2g} px: measure the print along both sides, and print it without "
            "scaling")


def _sheared(found: Bundle, device: int, name: str) -> str | None:
    """Return by how much the image of a device is sheared, if it fits alone then; None where that is not so."""
    own, sights = found.alone[device], sights_of(device, found.sights)
    matrix = camera_matrix(sights, found.alone[0])
    shear, matrix[0, 1] = matrix[0, 1] / matrix[1, 1], 0
    upright = [sight._replace(corners=sight.corners - shear * (sight.corners[:, 1:] - matrix[1, 2]) * [1, 0]) for sight in sights]
    try:
        best = alone(upright, own.size, name, matrix)
    except CalibrationError:
        return None
    if not best.rms_px < SHEARED * own.rms_px:
        return None
    return (f"with the image of {name} sheared by {100 * abs(shear):.2g} % it fits alone to {best.rms_px:.2g} px, which no lens does: "
            "switch keystone correction off, and project the images unscaled")


def _odd_views(found: Bundle) -> list[int]:
    """Return the views, at most half of them, without which the devices agree; none where there are no such."""
    oddness: dict[int, float] = {}
    for device in range(1, len(found.alone)):
        off, _ = _oddness(found.sights, found.alone[0], found.alone[device], device)
        for view, apart in off.items():
            oddness[view] = max(apart, oddness.get(view, 0.0))
    views = sorted(oddness, key=lambda view: -oddness[view])
    far = np.array([oddness[view] for view in views])
    most = min(len(views) // 2, len(views) - LEAST_VIEWS)
    if most < 1:
        return []
    odd = views[:int((far[:most] / np.maximum(far[1:most + 1], 1e-300)).argmax()) + 1]  # up to the largest step
    rest = [own._replace(boards={view: pose for view, pose in own.boards.items() if view not in odd}) for own in found.alone]
    if any(len(rest[0].boards.keys() & own.boards.keys()) < LEAST_VIEWS for own in rest):
        return []
    agreed = adjust([sight for sight in found.sights if sight.view not in odd], rest).excess < AGREED
    return sorted(odd) if agreed else []


def _oddness(sights: Sequence[Sight], first: Alone, other: Alone, device: int) -> tuple[dict[int, float], np.ndarray]:
    """Return of each view how far a device sees the board from where most other views have it, in pixels, root mean square, and the place
    of the device beside the first one that most views have, [6]."""
    sights = [sight for sight in sights if sight.device == device and sight.view in first.boards]
    places = [after(inverse(first.boards[sight.view]), other.boards[sight.view]) for sight in sights]
    off = np.zeros((len(sights), len(sights)))  # of each view, where devices stand beside each other as in another one
    for row, place in zip(off, places, strict=True):
        for number, sight in enumerate(sights):
            pose = after(first.boards[sight.view], place)
            seen = cv2.projectPoints(sight.board.astype(np.float64), pose[:3], pose[3:], *other.lens)[0].reshape(-1, 2)
            row[number] = np.sqrt(((seen - sight.corners)**2).sum(axis=1).mean())
    best = int(np.median(off, axis=1).argmin())
    return {sight.view: float(far) for sight, far in zip(sights, off[best], strict=True)}, places[best]


def _other_reading(found: Bundle, device: int, name: str, first: str) -> str | None:
    """Return how the images of a device may be read, instead of as they are, so that nothing is contradicted; None where none is so."""
    own, (width, height) = found.alone[device], found.alone[device].size
    mirrored = f"as where its images or those of {first} are mirrored"
    readings: list[tuple[str, str, Reading]] = [
        (f"the columns of {name} counted from the other side", mirrored, lambda corners: [width, 0] + corners * [-1, 1]),
        (f"the rows of {name} counted from the other side", mirrored, lambda corners: [0, height] + corners * [1, -1]),
        (f"columns and rows of {name} exchanged", "as where its frames are mistaken for each other", lambda corners: corners[:, ::-1]),
        (f"the board seen from its other end by {name}", "as where it stands upside down: turn its images by 180°",
         lambda corners: corners)]
    x, y, _ = np.max([sight.board.max(axis=0) for sight in found.sights], axis=0)
    # corners of a mirrored board are counted from another end too, which is as if it were turned over
    turns = np.zeros(6), np.array([0, np.pi, 0, x, 0, 0]), np.array([np.pi, 0, 0, 0, y, 0]), np.array([0, 0, np.pi, x, y, 0])
    trials = []
    for words, cause, reading in readings:
        sights = [sight._replace(board=sight.board * [1, 1, 0], corners=reading(sight.corners)) for sight in found.sights
                  if sight.device == device]
        read = alone(sights, (max(own.size), max(own.size)), name)
        for turn in turns:
            turned = read._replace(boards={view: after(turn, pose) for view, pose in read.boards.items()})
            changed = [sight._replace(board=sight.board @ cv2.Rodrigues(turn[:3])[0].T + turn[3:]) for sight in sights]
            off, place = _oddness(changed, found.alone[0], turned, device)
            trials.append((float(np.median(list(off.values()))), float(np.linalg.norm(place[:3])), words, cause, changed, turned))
    # what is mirrored fits as well when it is turned too: of those that fit alike, devices stand upright
    best, declared = min(trial[0] for trial in trials), _oddness(found.sights, found.alone[0], own, device)[0]
    if ALIKE * best > np.median(list(declared.values())):
        return None
    _, _, words, cause, changed, turned = min((trial for trial in trials if trial[0] < ALIKE * best), key=lambda trial: trial[1])
    fitted = adjust([*(sight for sight in found.sights if sight.device != device), *changed],
                    [turned if number == device else each for number, each in enumerate(found.alone)])
    return f"with {words} they fit to {fitted.rms_px():.2g} px, {cause}" if fitted.excess < AGREED else None

"""Gerber and drill files of printed boards, written by hand from the formats' specifications."""

from collections.abc import Sequence
from pathlib import Path

from tests.scenes.printed_board import PADS, PASTE

HEAD = "%TF.FileFunction,Paste,Top*%\n%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\n"


def place(x: float, y: float) -> str:
    """Coordinates in metres as 4.6 digits of millimetres."""
    return f"X{round(x * 1e9)}Y{round(y * 1e9)}"


def write_layer(path: Path, *, pads: Sequence[tuple[float, float]] = PADS, moved: tuple[float, float] = (0.0, 0.0),
                names: Sequence[str] = ()) -> Path:
    """The paste layer of a printed board: rectangles; `names` as U1,3 are attributes of X2."""
    lines = [f"%ADD10R,{PASTE[0] * 1e3:.6f}X{PASTE[1] * 1e3:.6f}*%", "D10*"]
    for number, (x, y) in enumerate(pads):
        named = [f"%TO.P,{names[number]}*%"] if names else []
        lines += [*named, f"{place(x + moved[0], y + moved[1])}D03*", *(["%TD*%"] if named else [])]
    path.write_text(HEAD + "\n".join([*lines, "M02*", ""]))
    return path


def write_drill(path: Path, holes: Sequence[tuple[float, float]], diameter: float) -> Path:
    """An Excellon file of round holes."""
    lines = ["M48", "METRIC", f"T1C{diameter * 1e3:.3f}", "%", "T1", *(f"X{x * 1e3:.6f}Y{y * 1e3:.6f}" for x, y in holes), "M30", ""]
    path.write_text("\n".join(lines))
    return path

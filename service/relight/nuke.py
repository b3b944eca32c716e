"""A script of Nuke that mixes the lights of relit frames again: a Shuffle and a Grade for each layer of a light, and Merges that add.

A script is text: nodes take their inputs from a stack, the first input from its top, and put themselves there.

Source: Foundry, Nuke User Guide (layers, Shuffle, Grade, Merge and Copy); scripts that Nuke has written. Nuke itself was not at hand.
"""

from collections.abc import Sequence
from pathlib import Path

from stage.files import write_text
from stage.formats import exr

STEP_X, STEP_Y = 110, 80
"""The distance of nodes on the graph, pixels."""


def write_nuke_script(path: Path, pattern: str, frames: Sequence[tuple[int, Path]], layers: Sequence[str], rate: float) -> None:
    """Write the script.
    `pattern`: of the frames' path, with a run of # for the number. `frames`: number and path of each, in their order. `layers`: names of
    the layers of lights. `rate`: frames per second."""
    header = exr.read_header(frames[0][1])
    space = exr.color_space_of(header.metadata)
    first, last = frames[0][0], frames[-1][0]
    file = Path(pattern).resolve().as_posix()
    nodes = [_node("Root", name=_text(path.resolve().as_posix()), first_frame=first, last_frame=last, lock_range="true", fps=f"{rate:g}")]
    nodes += [f"add_layer {{{layer} {' '.join(f'{layer}.{channel}' for channel in ('red', 'green', 'blue'))}}}" for layer in layers]
    nodes += [_node("Read", inputs=0, file_type="exr", file=_text(file), first=first, last=last, origfirst=first, origlast=last,
                    origset="true", raw="true", name="Frames", label=_text(f"scene-linear, {space}"), xpos=0, ypos=-2 * STEP_Y),
              "set Frames [stack 0]"]
    for number, layer in enumerate(layers):
        x = STEP_X * number
        nodes += ["push $Frames",
                  _node("Shuffle", **{"in": layer}, alpha="black", name=f"Layer_{layer}", xpos=x, ypos=-STEP_Y),
                  _node("Grade", multiply="{1 1 1 1}", black_clamp="false", name=layer, label=_text("multiply: brightness and colour"),
                        xpos=x, ypos=0)]
        if number:
            nodes.append(_node("Merge2", inputs=2, operation="plus", name=f"Add{number}", xpos=x, ypos=STEP_Y))
    nodes.append(_node("Copy", inputs=2, from0="rgba.alpha", to0="rgba.alpha", name="Alpha", xpos=STEP_X * (len(layers) - 1),
                       ypos=2 * STEP_Y))
    write_text(path, "\n".join(["version 13.0 v1", *nodes]) + "\n")


def _node(kind: str, **knobs: object) -> str:
    lines = "".join(f" {name} {value}\n" for name, value in knobs.items())
    return f"{kind} {{\n{lines}}}"


def _text(text: str) -> str:
    """Return a text in quotes, in which Tcl finds nothing to replace."""
    for sign in '\\"[]${}':
        text = text.replace(sign, f"\\{sign}")
    return f'"{text}"'

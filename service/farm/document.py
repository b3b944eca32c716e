"""Plain data → YAML that people can read. Every text is quoted as JSON quotes it, so that none is taken for anything else."""

import json
from collections.abc import Mapping, Sequence

LINE = 100
"""Characters of a sequence that is written in one line."""
Plain = Mapping[str, "Plain"] | Sequence["Plain"] | str | int | float | bool


def yaml_text(data: Mapping[str, Plain]) -> str:
    """The text of a YAML document.

    Args:
        data: mappings with keys of letters alone, sequences, texts and numbers.
    """
    return "\n".join(_block(data, "")) + "\n"


def _block(data: Plain, margin: str) -> list[str]:
    lines: list[str] = []
    if isinstance(data, Mapping):
        for key, value in data.items():
            if _is_short(value):
                lines.append(f"{margin}{key}: {_short(value)}")
            else:
                lines += [f"{margin}{key}:", *_block(value, f"{margin}  ")]
    elif isinstance(data, Sequence) and not isinstance(data, str):
        for value in data:
            if _is_short(value):
                lines.append(f"{margin}- {_short(value)}")
            else:
                inner = _block(value, f"{margin}  ")
                lines += [f"{margin}- {inner[0].lstrip()}", *inner[1:]]
    return lines


def _is_short(value: Plain) -> bool:
    """Numbers and texts, and short sequences of them."""
    if isinstance(value, str | int | float):
        return True
    return not isinstance(value, Mapping) and all(isinstance(part, str | int | float) for part in value) and len(_short(value)) <= LINE


def _short(value: Plain) -> str:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(map(_short, value))}]"
    text = json.dumps(value, ensure_ascii=False)
    if isinstance(value, float) and "e" in text and "." not in text:
        return text.replace("e", ".0e")  # else it is a text to readers of YAML 1.1
    return "".join(character if character.isprintable() else json.dumps(character)[1:-1] for character in text)

"""Types of fixtures in the General Device Type Format (GDTF, DIN SPEC 15800) through the package pygdtf: the emitters of a DMX mode."""

from collections import Counter
from io import BytesIO
from typing import Any, NamedTuple
from zipfile import BadZipFile
from zlib import error as ZlibError

import numpy as np
from pygdtf import FixtureType, GeometryReference

from stage.errors import ManifestError

NAMES = {
    "ColorAdd_R": "red", "ColorAdd_G": "green", "ColorAdd_B": "blue", "ColorAdd_C": "cyan", "ColorAdd_M": "magenta", "ColorAdd_Y": "yellow",
    "ColorAdd_RY": "amber", "ColorAdd_A": "amber", "ColorAdd_GY": "lime", "ColorAdd_GC": "blue-green", "ColorAdd_BC": "light-blue",
    "ColorAdd_BM": "purple", "ColorAdd_RM": "pink", "ColorAdd_W": "white", "ColorAdd_WW": "warm-white", "ColorAdd_CW": "cool-white",
}
"""The primaries of the attributes of GDTF, Annex A; ColorAdd_A is not of the standard, but used."""
NOMINAL = {
    "red": (0.64, 0.33, 21.3), "green": (0.3, 0.6, 71.5), "blue": (0.15, 0.06, 7.2), "cyan": (0.225, 0.329, 78.7),
    "magenta": (0.321, 0.154, 28.5), "yellow": (0.419, 0.505, 92.8), "amber": (0.477, 0.460, 57.0), "lime": (0.372, 0.543, 82.1),
    "blue-green": (0.250, 0.419, 75.1), "light-blue": (0.200, 0.239, 43.0), "purple": (0.254, 0.117, 17.9), "pink": (0.403, 0.200, 24.9),
    "white": (0.313, 0.329, 100.0), "warm-white": (0.319, 0.340, 99.3), "cool-white": (0.306, 0.329, 97.9),
}
"""The colours (CIE xyY) that GDTF gives its attributes, for emitters whose own colour is not known."""
REC709_FROM_XYZ = np.linalg.inv([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])
"""ITU-R BT.709 primaries with the white D65."""
LUMINANCE = np.array([0.212671, 0.715160, 0.072169])
"""The luminance of linear red, green and blue of Rec.709."""
OUTSIDE = -1e-3
"""Parts below this, of a colour of luminance 1, lie outside of Rec.709; those above are the rounding of the digits of a file."""


class Emitter(NamedTuple):
    """One primary of a lamp."""

    name: str
    dmx_break: int
    offsets: tuple[int, ...]
    """Its channels, coarse first, from 0 at the address of the fixture."""
    irradiance: np.ndarray
    """[3] linear Rec.709; those of a lamp have the luminance 1 together."""


class Fixed(NamedTuple):
    """A channel that drives no primary, and keeps one value."""

    name: str
    """Its attribute."""
    dmx_break: int
    offsets: tuple[int, ...]
    values: tuple[int, ...]
    """The value of each byte, coarse first."""


class Cell(NamedTuple):
    """One lamp of a fixture: its only one, or a pixel of a bar."""

    name: str
    """The name of its geometry; empty if the fixture has one lamp."""
    place_mm: np.ndarray
    """[3], in the frame of the fixture."""
    emitters: tuple[Emitter, ...]
    fixed: tuple[Fixed, ...]
    """Its own other channels, and those of no pixel."""


class Channel(NamedTuple):
    """One DMX channel of a mode."""

    attribute: str
    part: str
    """The name of its geometry, or of the reference through which the geometry is in the fixture."""
    place_mm: np.ndarray
    """[3], in the frame of the fixture."""
    dmx_break: int
    offsets: tuple[int, ...]
    emitter: Any
    """The emitter of pygdtf that it drives, or None."""
    values: tuple[int, ...]
    """The value of each byte at which the lamp shines, where it drives no primary."""


class Mode(NamedTuple):
    """The channels of a DMX mode of a type of fixtures, and what they drive."""

    cells: list[Cell]
    """Empty if it has no light that Relit can drive."""
    warnings: list[str]


def read_mode(content: bytes, name: str | None, where: str) -> Mode:
    """Return the lamps of a DMX mode.
    `name`: the mode; None: the only one. `where`: the GDTF file in sentences. Raises ManifestError if the file is damaged, or has no such
    mode."""
    try:
        fixture = FixtureType(BytesIO(content))
        names = [mode.name for mode in fixture.dmx_modes]
        broken = fixture.name == "Original File Had Broken XML"  # pygdtf's stand-in
        mode = fixture.dmx_modes[0] if name is None and len(names) == 1 else fixture.dmx_modes.get_mode_by_name(name)
        if mode is not None and not broken:
            return _mode(fixture, mode, where)
    except (BadZipFile, ZlibError, EOFError) as error:
        raise ManifestError(f"{where}: is no GDTF file: it is not a zip archive") from error
    except KeyError as error:
        raise ManifestError(f"{where}: is no GDTF file: it holds no description.xml") from error
    except ManifestError:
        raise
    except (ValueError, IndexError, TypeError, AttributeError, AssertionError, NotImplementedError, RuntimeError) as error:
        # pygdtf checks nothing: what is missing or no number ends in these
        raise ManifestError(f"{where}: its description.xml is damaged: {error}") from error
    if broken:
        raise ManifestError(f"{where}: its description.xml is damaged: it is no XML")
    wrong = f"the mode {name} of the scene" if name else "the scene names no mode"
    raise ManifestError(f"{where}: {wrong}: must be a DMX mode of the file, {', '.join(map(str, names))}")


def _mode(fixture: Any, mode: Any, where: str) -> Mode:
    channels = _channels(fixture, mode)
    # a lamp without colours is driven by its dimmer
    lights = [channel for channel in channels if channel.attribute in NAMES] or [
        channel for channel in channels if channel.attribute == "Dimmer"]
    if not lights:
        return Mode([], [f"{where}: has no emitters that Relit can drive, and is left out"])
    warnings = []
    driven = {channel.attribute for channel in lights}
    others = [channel for channel in channels if channel.attribute not in driven | {"NoFeature", "None"}]
    if others:
        held = {channel.attribute: " ".join(map(str, channel.values)) for channel in others}
        warnings.append(f"{where}: {', '.join(f'{name} {values}' for name, values in sorted(held.items()))}: these channels keep the "
                        "values: check that the lamp is fully lit and still under them")
    pixels = max(Counter(channel.attribute for channel in lights).values()) > 1
    cells = []
    parts = dict.fromkeys(channel.part if pixels else "" for channel in lights)
    for part in parts:
        members = [channel for channel in lights if not pixels or channel.part == part]
        names = [NAMES.get(channel.attribute, "white") for channel in members]
        if len(set(names)) < len(names):
            raise ManifestError(f"{where}: the mode {mode.name} has several channels of one colour in its geometry {part}: choose another "
                                "mode")
        irradiance, outside = _irradiance(members, names)
        if outside:
            warnings.append(f"{where}: {', '.join(outside)}: the colour lies outside of Rec.709, and what was negative is 0")
        cells.append(Cell(part, members[0].place_mm, tuple(
            Emitter(name, channel.dmx_break, channel.offsets, light)
            for name, channel, light in zip(names, members, irradiance, strict=True)), tuple(
            Fixed(channel.attribute, channel.dmx_break, channel.offsets, channel.values)
            for channel in others if channel.part == part or channel.part not in parts)))
    return Mode(cells, list(dict.fromkeys(warnings)))


def _channels(fixture: Any, mode: Any) -> list[Channel]:
    """Return the channels of a mode, those of a referenced geometry once for each reference.

    The channels that pygdtf resolves do not say which reference they belong to where the reference sets their break (Overwrite), so that
    this goes through the geometries and the channels as they stand in the file.
    """
    found: list[Channel] = []

    def visit(geometry: Any, fixture_from_parent: np.ndarray, part: str, breaks: list[Any]) -> None:
        fixture_from_geometry = fixture_from_parent @ np.array(geometry.position.matrix, dtype=np.float64)
        shape = geometry
        if isinstance(geometry, GeometryReference):
            part, breaks, shape = geometry.name, geometry.breaks, fixture.geometries.get_geometry_by_name(geometry.geometry)
        for channel in mode._dmx_channels:
            if channel.geometry != shape.name or not channel.offset:
                continue
            overwrite = channel.dmx_break == "Overwrite"
            given = next((link for link in reversed(breaks) if overwrite or link.dmx_break == channel.dmx_break), None)
            first = 0 if given is None else 512 * (given.dmx_offset.universe - 1) + given.dmx_offset.address - 1
            dmx_break = channel.dmx_break if given is None else given.dmx_break
            found.append(Channel(str(channel.attribute), part or shape.name, 1000 * fixture_from_geometry[:3, 3],
                                 1 if dmx_break == "Overwrite" else dmx_break, tuple(first + offset - 1 for offset in channel.offset),
                                 _emitter(fixture, channel), _lit_values(channel)))
        for child in getattr(shape, "geometries", ()):
            visit(child, fixture_from_geometry, part, breaks)

    root = fixture.geometries.get_geometry_by_name(mode.geometry)
    if root is None:
        raise ValueError(f"it has no geometry {mode.geometry}, which the mode {mode.name} names")
    visit(root, np.eye(4), "", [])
    return found


def _irradiance(channels: list[Channel], names: list[str]) -> tuple[np.ndarray, list[str]]:
    """Return the irradiance [primaries, 3] of the primaries of a lamp, and the names of those outside of Rec.709.

    Their luminous shares are those of the measured intensities if every emitter has one, else those of Y in their colours.
    """
    emitters = [channel.emitter for channel in channels]
    colours = [NOMINAL[name] if emitter is None else (emitter.color.x, emitter.color.y, emitter.color.Y)
               for name, emitter in zip(names, emitters, strict=True)]
    measured = [0.0 if emitter is None else max((point.luminous_intensity for point in emitter.measurements), default=0.0)
                for emitter in emitters]
    shares = np.array(measured if min(measured) > 0 else [colour[2] for colour in colours], dtype=np.float64)
    if not (np.isfinite(shares).all() and (shares > 0).all()):
        shares = np.ones(len(colours))
    rgb = np.empty((len(colours), 3))
    for row, (x, y, _) in zip(rgb, colours, strict=True):
        if not (x > 0 and y > 0 and x + y <= 1):
            raise ValueError(f"the emitter colour {x}, {y} is no CIE xy")
        row[:] = REC709_FROM_XYZ @ (x / y, 1.0, (1 - x - y) / y)
    outside = [name for name, row in zip(names, rgb, strict=True) if row.min() < OUTSIDE]
    rgb = rgb.clip(0)
    return rgb * (shares / shares.sum() / (rgb @ LUMINANCE))[:, None], outside


def _emitter(fixture: Any, channel: Any) -> Any:
    named = {str(function.emitter) for logical in channel.logical_channels for function in logical.channel_functions
             if function.emitter is not None}
    return next((emitter for emitter in fixture.emitters if emitter.name in named), None)


def _lit_values(channel: Any) -> tuple[int, ...]:
    """Return the value of each byte of a channel at which the lamp shines, if the channel drives no primary.

    A dimmer is at full, an emitter that is no primary at 0; others have the value that the file gives for shining at full (Highlight), else
    that of a fixture that nobody touches (the default of its first function). A value of fewer bytes than the channel is repeated (GDTF,
    DMXValue).
    """
    bytes_needed, attribute = len(channel.offset), str(channel.attribute)
    if attribute == "Dimmer" or attribute.startswith("ColorAdd_"):
        return (255 if attribute == "Dimmer" else 0,) * bytes_needed
    functions = channel.logical_channels[0].channel_functions
    given = channel.highlight or channel.default
    if channel.highlight is None and channel.initial_function is None and not channel.default.value and functions:
        given = functions[0].default
    parts = given.get_value(components=True) if given.byte_count > 1 else [given.value & 255]
    return tuple((parts * bytes_needed)[:bytes_needed])

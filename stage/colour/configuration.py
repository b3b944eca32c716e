"""The OpenColorIO configuration: that which $OCIO names, else the newest ACES configuration that is built into the library.

`--ocio` of a command sets $OCIO while the command runs, so that the processes which it starts have the same configuration. Names are those
of colour spaces, their aliases and roles, in any case. The names of the Color Interop Forum that `stage.colour.colour_spaces` lists have
one meaning everywhere: a configuration that lacks one is joined with the built-in configuration at ACES2065-1.
"""

import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from difflib import SequenceMatcher, get_close_matches
from functools import cache
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import PyOpenColorIO as ocio

from stage.colour.colour_spaces import NAMES
from stage.colour.location import BUILT_IN, STUDIO, VARIABLE, location
from stage.errors import ColourError

INTERCHANGE, ACES = "aces_interchange", "lin_ap0_scene"
"""The role by which configurations are joined, and the name of its space, ACES2065-1."""
STANDARD_VIEW = ("sRGB - Display", "ACES 2.0 - SDR 100 nits (Rec.709)")
"""The display and the view of pictures for review, by their names in the built-in configurations."""
FEWEST_LETTERS = 4
"""The letters and digits that a part of a name needs to stand for it: three lie in names by chance."""
NEAREST = 3
"""The most names that an error proposes."""
ROUNDING, CROSSTALK = 1e-5, 1e-4
"""Parts of the largest value by which a channel depends on the others where a space surely has the primaries of another, and where it may:
OpenColorIO rounds to 1e-6, and the primaries of the two most similar cameras differ by 1e-3."""
PROBES = (0.2, 0.4, 0.6)
"""Values of each channel by which the primaries of spaces are compared: every camera's curve keeps them apart."""


class Configuration(NamedTuple):
    """An OpenColorIO configuration that was read without a fault."""

    location: str
    """A file, or ocio:// and the name of a built-in configuration."""
    names: dict[str, str]
    """The names of the spaces by every name, alias and role, in small letters."""
    linear: tuple[str, ...]
    """The spaces whose values are proportional to radiance."""
    data: tuple[str, ...]
    """The spaces that hold no colours."""
    views: dict[str, tuple[str, ...]]
    """The views of each display; the default display and its default view come first."""
    looks: tuple[str, ...]
    """The names of the looks."""
    roles: tuple[str, ...]
    """The names of the roles, in small letters."""
    label: str
    """The name, and the version of the library or the SHA-256 of the files: results carry it."""

    def find(self, name: str) -> str | None:
        """Return the space with a name, an alias or a role; None: the configuration has none."""
        return self.names.get(name.lower())

    def checked(self, name: str) -> str:
        """Return the space with a name, an alias or a role.
        Raises ColourError if there is none, or it holds data; the message proposes names."""
        found = self.find(name)
        if found is None:
            raise ColourError(f"{name} is no colour space of the OpenColorIO configuration {self.name}: {self._proposal(name)}")
        if found in self.data:
            raise ColourError(f"{name} holds data in the OpenColorIO configuration {self.name}: give a space of colours")
        return found

    @property
    def name(self) -> str:
        """The label without the version or the hash."""
        return self.label.split(" ")[0]

    @property
    def cache_id(self) -> str:
        """The cache id that OpenColorIO gives the configuration: a hash of its text, and one of its folder and its variables."""
        return str(loaded(self.location).getCacheID())

    def steps(self, source: str, target: str) -> list[tuple[str, str, str]]:
        """Return the conversions that lead from one space to another: a configuration's location and two names of it each.
        Raises ColourError if a space is missing, or the configuration does not say how it is joined with others."""
        missing = [name for name in (source, target) if self.find(name) is None]
        for name in missing:
            if name not in NAMES:
                self.checked(name)
        if not missing:
            return [(self.location, source, target)]
        if len(missing) == 2:
            return [(BUILT_IN, source, target)]
        aces = self.aces(missing[0])
        return ([(BUILT_IN, source, ACES), (self.location, aces, target)] if missing == [source] else
                [(self.location, source, aces), (BUILT_IN, ACES, target)])

    def aces(self, missing: str) -> str:
        """Return the space by which another one that is missing here is converted in the built-in configuration: ACES2065-1."""
        found = self.find(INTERCHANGE) or self.find(ACES)
        if found is None:
            raise ColourError(f"the OpenColorIO configuration {self.name} has no colour space {missing}, and no role {INTERCHANGE} by "
                              "which it could be converted: add one of them")
        return found

    def view(self, wanted: str | None) -> tuple[str, str] | None:
        """Return a display and a view of it; None: the configuration has no views.
        `wanted`: DISPLAY/VIEW, or a view, of the first display that has it; None: STANDARD_VIEW, else the default one. Raises ColourError
        if there is no such view; the message proposes others."""
        pairs = [(display, view) for display, views in self.views.items() for view in views]
        if wanted is None:
            return STANDARD_VIEW if STANDARD_VIEW in pairs else next(iter(pairs), None)
        names = {name.lower(): pair for pair in reversed(pairs) for name in (pair[1], "/".join(pair))}
        if (found := names.get(wanted.lower())) is None:
            near = {names[name] for name in get_close_matches(wanted.lower(), names, NEAREST, 0.3)} or pairs[:NEAREST]
            raise ColourError(f"{wanted} is no view of the OpenColorIO configuration {self.name}: "
                              f"{'give ' + ' or '.join(sorted(map('/'.join, near))) if near else 'it has none'}")
        return found

    def checked_look(self, wanted: str) -> str:
        """Return looks in OpenColorIO's syntax: names with commas between, each with + or - before it, and | between alternatives.
        Raises ColourError if there is no such look; the message proposes others."""
        names = {look.lower(): look for look in self.looks}
        for look in (part.strip().lstrip("+-").strip() for part in re.split(r"[,:|]", wanted)):
            if look.lower() not in names:
                near = [names[name] for name in get_close_matches(look.lower(), names, NEAREST, 0.3)] or self.looks[:NEAREST]
                raise ColourError(f"{look or wanted} is no look of the OpenColorIO configuration {self.name}: "
                                  f"{'give ' + ' or '.join(near) if near else 'it has none'}")
        return wanted

    def _proposal(self, name: str) -> str:
        """Return what to do about a name that is missing."""
        studio = configuration(STUDIO)
        if self.location != STUDIO and not self._alike(name) and (there := studio.find(name) or next(iter(studio._alike(name)), None)):
            return f"{STUDIO} has {there}: give --ocio {STUDIO}, or set ${VARIABLE} to it"
        close = get_close_matches(name.lower(), self.names, 2 * NEAREST, 0.4)
        by_space = dict.fromkeys(self._alike(name), "")
        for alias in close:
            by_space.setdefault(self.names[alias], alias if alias in self.roles else "")
        near = [f"{role} ({space})" if role else space for space, role in by_space.items()][:NEAREST]
        if near:
            return f"the nearest {'is' if len(near) == 1 else 'are'} {', '.join(near)}"
        return f"it has {', '.join(self.linear[:NEAREST])} and others"

    def _alike(self, name: str) -> list[str]:
        """Return the spaces with a name that has the letters and digits of another within it."""
        plain = re.sub(r"\W|_", "", name.lower())
        within = {alias: re.sub(r"\W|_", "", alias) for alias in self.names} if len(plain) >= FEWEST_LETTERS else {}
        return list(dict.fromkeys(self.names[alias] for alias, letters in within.items() if plain in letters))


def current() -> Configuration:
    """Return the configuration of this process. Raises ColourError if it cannot be read."""
    return configuration(location())


@contextmanager
def used(place: str | None) -> Iterator[None]:
    """Use a configuration within a context; None: that of $OCIO, which is checked too. Raises ColourError if it cannot be read."""
    before = os.environ.get(VARIABLE)
    if place is not None:
        os.environ[VARIABLE] = place
        os.environ[VARIABLE] = location()  # also for processes in other folders
    try:
        current()
        yield
    finally:
        if place is not None:
            os.environ.pop(VARIABLE)
            os.environ.update({} if before is None else {VARIABLE: before})


def configuration(place: str) -> Configuration:
    """Read a configuration; one that was read before and whose file has not changed is not read again.
    Raises ColourError if it cannot be read; the message names it."""
    return _read(place, _changed(place))


def loaded(place: str) -> ocio.Config:
    """Return a configuration as OpenColorIO holds it, which keeps the processors that were asked of it.
    Raises ColourError if it cannot be read; the message names it."""
    return _loaded(place, _changed(place))


def _changed(place: str) -> int:
    """Return when the file of a configuration was changed last, nanoseconds; 0 for a built-in one."""
    if place.startswith("ocio://"):
        return 0
    try:
        return os.stat(place).st_mtime_ns
    except OSError as error:
        raise ColourError(f"--ocio or ${VARIABLE}: {place}: no such OpenColorIO configuration") from error


@cache
def linear_of(place: str, space: str) -> tuple[str, bool]:
    """Return the linear space that belongs to a space of a configuration: that with the same primaries, else the role scene_linear.
    Returns a name that files may declare, and whether the conversion leaves the channels apart. Raises ColourError if the configuration has
    no such space."""
    found = configuration(place)
    name = found.checked(space)
    if name in found.linear:
        return _declared(found, name), True
    colours = np.array(list(product(PROBES, repeat=3)), np.float32)
    crosstalk = {}
    for linear in sorted(found.linear, key=lambda each: -SequenceMatcher(None, each, name).ratio()):  # the likely ones first
        converted = colours.copy()
        try:
            loaded(place).getProcessor(name, linear).getDefaultCPUProcessor().applyRGB(converted)
        except ocio.Exception:  # no transform between the two
            continue
        values = np.moveaxis(converted.reshape(3, 3, 3, 3), -1, 0)
        spread = [np.ptp(np.moveaxis(values[c], c, 0).reshape(3, -1), axis=1).max() for c in range(3)]
        crosstalk[linear] = float(max(spread) / max(np.abs(values).max(), 1e-30))
        if crosstalk[linear] <= ROUNDING:
            break
    best = min(crosstalk, key=lambda each: crosstalk[each], default=None)
    if best is not None and crosstalk[best] <= CROSSTALK:
        return _declared(found, best), True
    working = found.find("scene_linear")
    if working not in found.linear:
        raise ColourError(f"the OpenColorIO configuration {found.name} has no linear space for {space}: give it the role scene_linear")
    return _declared(found, str(working)), False


def _declared(found: Configuration, name: str) -> str:
    """Return a space's name of the Color Interop Forum where the configuration knows the space by it, else the name itself."""
    identifier = loaded(found.location).getColorSpace(name).getInteropID()
    return identifier if identifier and found.find(identifier) == name else name


@cache
def _loaded(place: str, changed: int) -> ocio.Config:
    try:
        return ocio.Config.CreateFromFile(place)
    except ocio.Exception as error:
        reason = re.sub(r"^Error: Loading the OCIO profile .* failed. ", "", " ".join(str(error).split())).rstrip(".")
        raise ColourError(f"--ocio or ${VARIABLE}: {place}: is no OpenColorIO configuration that can be read: {reason}") from error


@cache
def _read(place: str, changed: int) -> Configuration:
    config = _loaded(place, changed)
    spaces = {name: config.getColorSpace(name) for name in config.getColorSpaceNames(ocio.SEARCH_REFERENCE_SPACE_ALL, ocio.COLORSPACE_ALL)}
    names = {alias.lower(): name for name, space in spaces.items() for alias in space.getAliases()}
    roles = {role.lower(): str(config.getRoleColorSpace(role)) for role in config.getRoleNames()}
    names |= roles
    names |= {name.lower(): name for name in spaces}
    displays = sorted(config.getDisplays(), key=lambda display: display != config.getDefaultDisplay())
    views = {display: tuple(sorted(config.getViews(display), key=lambda view: view != config.getDefaultView(display)))
             for display in displays}
    data = tuple(name for name, space in spaces.items() if space.isData())
    linear = tuple(name for name in spaces if name not in data and any(
        config.isColorSpaceLinear(name, kind) for kind in (ocio.REFERENCE_SPACE_SCENE, ocio.REFERENCE_SPACE_DISPLAY)))
    if place.startswith("ocio://"):
        label = f"{place} OpenColorIO {ocio.__version__}"
    else:
        label = f"{Path(place).name.replace(' ', '_')} sha256:{_digest(Path(place))}"
    return Configuration(place, names, linear, data, views, tuple(config.getLookNames()), tuple(roles), label)


def _digest(path: Path) -> str:
    """Return the SHA-256 of a configuration and of the tables that it names, as far as they lie in its folders."""
    content = path.read_bytes()
    digest = hashlib.sha256(content)
    if path.suffix == ".ocioz":  # which holds its tables
        return digest.hexdigest()
    text = content.decode(errors="replace")
    listed = re.search(r"^search_path:(.*(?:\n +- .*)*)", text, re.MULTILINE)
    folders = ["", *(part.strip(" -'\"") for part in re.split(r"[:\n]", listed[1]) if part.strip())] if listed else [""]
    for name in sorted(set(re.findall(r"src: *[\"']?([^,}\"'\n]+)", text))):
        for folder in folders:
            table = path.parent / os.path.expandvars(folder) / os.path.expandvars(name.strip())
            if table.is_file():
                digest.update(table.read_bytes())
                break
    return digest.hexdigest()

"""Scenes in My Virtual Rig (MVR, DIN SPEC 15801) through the package pymvr: fixtures with their places, types and addresses."""

from collections.abc import Iterator
from io import BytesIO
from typing import Any, NamedTuple
from xml.etree.ElementTree import ParseError
from zipfile import BadZipFile, ZipFile
from zlib import error as ZlibError

import numpy as np
from pymvr import GeneralSceneDescription

from stage.errors import ManifestError

CHILD_LISTS = ("scene_objects", "group_objects", "supports", "trusses", "video_screens", "projectors")
"""What may hold fixtures beside the layers; fixtures may, too."""


class Fixture(NamedTuple):
    """One fixture of a scene."""

    name: str
    identity: str
    """The fixture ID, which a person gave it; empty if nobody did."""
    type_file: str | None
    """The name of its GDTF file in the scene."""
    mode: str | None
    """The name of its DMX mode."""
    scene_from_fixture: np.ndarray
    """[4, 4], millimetres, for column vectors."""
    addresses: dict[int, int]
    """For each DMX break of its type the channel at which it begins, counted through all universes from 0."""
    copies: str | None
    """The identifier of the fixture whose channels it shares, or None."""


class Scene(NamedTuple):
    """The fixtures of a scene, and the files in it."""

    fixtures: list[Fixture]
    package: ZipFile
    where: str

    def type_content(self, fixture: Fixture) -> bytes | None:
        """Return the content of the GDTF file of a fixture, or None if the scene does not hold it.
        Raises ManifestError if the archive is damaged there."""
        name = fixture.type_file or ""
        held = set(self.package.namelist())
        # names in an archive without the UTF-8 flag are read as code page 437
        found = [held_name for held_name in (name, name.encode().decode("cp437")) if held_name in held]
        try:
            return self.package.read(found[0]) if found else None
        except (BadZipFile, ZlibError, EOFError, NotImplementedError, RuntimeError) as error:
            raise ManifestError(f"{self.where}: {found[0]} in it is damaged: {error}") from error


def read_scene(content: bytes, where: str) -> Scene:
    """Return the fixtures of a scene. Raises ManifestError if the content is no MVR scene; `where` names it."""
    try:
        description = GeneralSceneDescription(BytesIO(content))
        fixtures = [fixture for layer in description.scene.layers
                    for fixture in _fixtures(layer.child_list, _matrix(layer.matrix))]
        return Scene(fixtures, ZipFile(BytesIO(content)), where)
    except (BadZipFile, ZlibError, EOFError) as error:
        raise ManifestError(f"{where}: is no MVR scene: it is not a zip archive") from error
    except KeyError as error:
        raise ManifestError(f"{where}: is no MVR scene: it holds no GeneralSceneDescription.xml") from error
    except (ParseError, ValueError, IndexError, TypeError, AttributeError, NotImplementedError, RuntimeError) as error:
        # pymvr checks nothing: what is missing or no number ends in these
        raise ManifestError(f"{where}: its GeneralSceneDescription.xml is damaged: {error}") from error


def _fixtures(children: Any, scene_from_parent: np.ndarray) -> Iterator[Fixture]:
    """Yield the fixtures of a list of objects and of the objects in it."""
    if children is None:
        return
    for given in children.fixtures:
        type_file = (given.gdtf_spec or "").encode("cp437").decode()  # pymvr has turned it the other way
        if type_file and not type_file.lower().endswith(".gdtf"):
            type_file += ".gdtf"  # scenes leave it out, and pymvr adds it to long names alone
        scene_from_fixture = scene_from_parent @ _matrix(given.matrix)
        addresses = given.addresses.addresses
        first = 0 if any(address.dmx_break == 0 for address in addresses) else 1  # breaks are numbered from either, those of GDTF from 1
        yield Fixture(
            name=" ".join((given.name or "").split()) or "fixture", identity=(given.fixture_id or "").strip(), type_file=type_file or None,
            mode=given.gdtf_mode, scene_from_fixture=scene_from_fixture, copies=given.multipatch or None,
            addresses={address.dmx_break - first + 1: 512 * (address.universe - 1) + address.address - 1 for address in addresses})
        yield from _fixtures(given.child_list, scene_from_fixture)
    for kind in CHILD_LISTS:
        for holder in getattr(children, kind):
            yield from _fixtures(holder.child_list, scene_from_parent @ _matrix(holder.matrix))


def _matrix(given: Any) -> np.ndarray:
    """Return a matrix of MVR, whose rows are the axes and the place of an object, as [4, 4] for column vectors."""
    rows = np.array(given.matrix, dtype=np.float64)
    if not np.isfinite(rows).all():
        raise ValueError("a matrix holds numbers that are not finite")
    rows[:, 3] = 0, 0, 0, 1
    return rows.T

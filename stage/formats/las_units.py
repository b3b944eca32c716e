"""Units of the coordinate system that a LAS file names, as WKT or as GeoTIFF keys: land is surveyed in feet too."""

import re
from collections.abc import Iterable
from typing import Any

WKT_PARTS = re.compile(r'"(?:[^"]|"")*"|([A-Za-z_0-9]+)\s*[\[(]|[\])]')
"""Texts, which may hold brackets, beginnings of elements, and ends."""
WKT_FACTOR = re.compile(r'\s*"(?:[^"]|"")*"\s*,\s*([-+.\deE]+)')
ACROSS = {"PROJCS", "PROJCRS", "PROJECTEDCRS", "LOCAL_CS", "ENGCRS", "ENGINEERINGCRS", "GEOCCS"}
UP = {"VERT_CS", "VERTCS", "VERTCRS", "VERTICALCRS"}
GEO_KEYS = "GeoKeyDirectoryVlr"
LINEAR_UNITS, VERTICAL_UNITS = 3076, 4099
"""The GeoTIFF keys of the units of x and y, and of z."""
GEO_UNITS_M = {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937}
"""Metres in the metre, the international foot and the US survey foot, by their EPSG codes."""


def units_of(records: Iterable[Any]) -> tuple[float, float, float] | None:
    """Return the metres in one unit of x, y and z by the records of a file as laspy reads them; None: they do not say it.

    A height without a unit of its own is in that of x and y. Codes of whole coordinate systems, which need EPSG's tables, are not read.

    Source:
        ASPRS, "LAS Specification 1.4 - R15", 2019, 3: coordinate reference systems; OGC 01-009 and 18-010r7: WKT; OGC 19-008r4: GeoTIFF.
    """
    across = up = None
    for record in records:
        if type(record).__name__ == "WktCoordinateSystemVlr":
            across, up = _wkt_units(record.string)
            break  # a file with both kinds goes by the WKT
        if type(record).__name__ == GEO_KEYS:
            keys = {key.id: key.value_offset for key in record.geo_keys if key.tiff_tag_location == 0}
            across, up = GEO_UNITS_M.get(keys.get(LINEAR_UNITS, 0)), GEO_UNITS_M.get(keys.get(VERTICAL_UNITS, 0))
    if across is None:
        return None
    return across, across, across if up is None else up


def _wkt_units(text: str) -> tuple[float | None, float | None]:
    """Return the metres in one unit of x and y, and in one of z, of a coordinate system as WKT 1 or 2."""
    found: dict[bool, float] = {}
    inside: list[str] = []
    for part in WKT_PARTS.finditer(text):
        if part[1] is None:
            if part[0] in "])" and inside:
                inside.pop()
            continue
        name = part[1].upper()
        holder = inside[-2:-1] if inside[-1:] == ["AXIS"] else inside[-1:]  # WKT 2 may give a unit for each axis
        if name in ("UNIT", "LENGTHUNIT") and holder and holder[0] in ACROSS | UP and (factor := WKT_FACTOR.match(text, part.end())):
            found.setdefault(holder[0] in UP, float(factor[1]))
        inside.append(name)
    return found.get(False), found.get(True)

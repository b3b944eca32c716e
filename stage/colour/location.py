"""The place of the OpenColorIO configuration of this process; a module that loads no other, for processes that start often."""

import os

VARIABLE = "OCIO"
"""The variable of the environment that names an OpenColorIO configuration, as in other programs."""
BUILT_IN = "ocio://default"
"""The newest ACES configuration for computer graphics that is built into the library."""
STUDIO = "ocio://studio-config-latest"
"""The built-in configuration with the spaces of cameras."""


def location() -> str:
    """Return where the configuration of this process lies: the absolute path of a file, or ocio:// and a built-in name."""
    place = os.environ.get(VARIABLE) or BUILT_IN
    return place if place.startswith("ocio://") else os.path.abspath(place)

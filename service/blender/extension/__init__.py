"""Relit in Blender: solve captures, import their assets, and relight them under the lights of the scene.

It speaks to the program `relit`, or to a service over HTTP; docs/blender.md of Relit tells how it is used.
"""

import bpy

OLDEST = (4, 2, 0)
"""The first Blender with extensions."""


def check_version(version: tuple[int, ...]) -> None:
    """Raise RuntimeError if Blender is too old."""
    if tuple(version) < OLDEST:
        needed, found = (".".join(map(str, each)) for each in (OLDEST[:2], version))
        raise RuntimeError(f"Relit needs Blender {needed} or later, and this is {found}: update Blender")


def register() -> None:
    """Add the classes, and the settings of a scene."""
    check_version(bpy.app.version)
    from . import panel, settings  # here, so that an old Blender reads no more than this file

    for each in panel.CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.relit = bpy.props.PointerProperty(type=settings.Settings)


def unregister() -> None:
    """Cancel work that is under way, and remove everything that `register` added."""
    from . import panel, tasks

    tasks.stop()
    del bpy.types.Scene.relit
    for each in reversed(panel.CLASSES):
        bpy.utils.unregister_class(each)

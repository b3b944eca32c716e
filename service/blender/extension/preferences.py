"""The preferences of the extension: the program `relit`, or a service."""

import functools
import shutil
import urllib.parse

import bpy
from bpy.props import EnumProperty, StringProperty

from .program import Program
from .service import Service
from .tasks import Failure

LOOPBACK = ("127.0.0.1", "::1", "localhost")


class Preferences(bpy.types.AddonPreferences):
    """Who does the work."""

    bl_idname = __package__

    backend: EnumProperty(name="Work is done by", items=[
        ("PROGRAM", "Program", "The program relit on this machine"), ("SERVICE", "Service", "A service that relit serve runs")])
    program: StringProperty(name="Program", subtype="FILE_PATH", default="relit", description="The program relit: its path, or its name")
    url: StringProperty(name="Service", default="http://127.0.0.1:8470", description="Address of the service, as relit serve prints it")
    key: StringProperty(name="Key", subtype="PASSWORD", description="Key that relit keys create printed; empty for an anonymous service")

    def draw(self, context: bpy.types.Context) -> None:
        """Show the choices that count."""
        self.layout.prop(self, "backend", expand=True)
        for name in ("program",) if self.backend == "PROGRAM" else ("url", "key"):
            self.layout.prop(self, name)
        if sentence := problem(self):
            self.layout.label(text=sentence, icon="ERROR")


def preferences(context: bpy.types.Context) -> Preferences:
    """Return the preferences of this extension."""
    return context.preferences.addons[__package__].preferences


@functools.cache
def _found(program: str) -> bool:
    """Return True if a program is there; panels ask at each redraw, and the disk is asked once, and again before work."""
    return shutil.which(program) is not None


def problem(given: Preferences) -> str | None:
    """Return a sentence that says why no work can be done, as far as it is known without trying."""
    if given.backend == "PROGRAM":
        if not _found(bpy.path.abspath(given.program)):
            return f"relit is not found at {given.program!r}: give its path in the preferences of the extension"
        return None
    try:
        host = urllib.parse.urlsplit(given.url).hostname
    except ValueError:
        host = None
    if host is None:
        return f"{given.url!r} is no address of a service: give one such as http://127.0.0.1:8470 in the preferences of the extension"
    if host not in LOOPBACK and not bpy.app.online_access:
        return "Blender is offline: allow online access in its preferences (System), or use the program relit"
    return None


def backend(context: bpy.types.Context) -> Program | Service:
    """Return who does the work; raise Failure where it is known that nobody can."""
    given = preferences(context)
    _found.cache_clear()
    if sentence := problem(given):
        raise Failure(sentence)
    return Program(bpy.path.abspath(given.program)) if given.backend == "PROGRAM" else Service(given.url, given.key)

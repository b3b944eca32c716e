"""The panel of the sidebar, and the list of all classes."""

import textwrap

import bpy

from . import importing, preferences, relighting, settings, solving, tasks

LINE = 44
"""Letters of a line of the sidebar."""


class RELIT_PT_capture(bpy.types.Panel):
    """Solve a capture, import its asset, light and relight it."""

    bl_label = "Relit"
    bl_category = "Relit"
    bl_space_type, bl_region_type = "VIEW_3D", "UI"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the state of the work, and a part for each step."""
        layout, given = self.layout, context.scene.relit
        layout.use_property_split = True
        if sentence := preferences.problem(preferences.preferences(context)):
            _error(layout, sentence)
        _progress(layout)
        _part(layout, "Capture", given, ("capture", "out", "sky", "levels"), (solving.RELIT_OT_solve,))
        _part(layout, "Asset", given, ("asset", "mesh", "look"), (importing.RELIT_OT_import_asset,))
        if given.root is None:
            return
        captured = ("light_index",) if given.light == "CAPTURED" else ()
        _part(layout, "Light", given, ("root", "light", *captured), ())
        guided = ("guided",) if given.method == "RELIGHT" else ()
        _part(layout, "Frames", given, ("method", *guided, "place"),
              (relighting.RELIT_OT_relight, relighting.RELIT_OT_show_frames, relighting.RELIT_OT_compare_render))


def _part(layout: bpy.types.UILayout, title: str, given: settings.Settings, names: tuple[str, ...], operators: tuple[type, ...]) -> None:
    box = layout.box()
    box.label(text=title)
    for name in names:
        box.prop(given, name)
    for each in operators:
        box.operator(each.bl_idname)


def _progress(layout: bpy.types.UILayout) -> None:
    task = tasks.current
    if task is None:
        return
    if not task.ended:
        layout.progress(factor=task.percent / 100, text=f"{task.stage or task.title} {task.percent} %")
        layout.operator(solving.RELIT_OT_cancel.bl_idname, icon="CANCEL")
    elif task.error is not None:
        _error(layout, task.error)


def _error(layout: bpy.types.UILayout, sentence: str) -> None:
    """Draw a sentence in lines that a narrow sidebar shows whole."""
    for number, line in enumerate(textwrap.wrap(sentence, LINE)):
        layout.label(text=line, icon="BLANK1" if number else "ERROR")


CLASSES = (preferences.Preferences, settings.Settings, solving.RELIT_OT_solve, solving.RELIT_OT_cancel, importing.RELIT_OT_import_asset,
           relighting.RELIT_OT_relight, relighting.RELIT_OT_show_frames, relighting.RELIT_OT_compare_render, RELIT_PT_capture)

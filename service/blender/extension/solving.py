"""Solve a capture, export its asset, and import that."""

from pathlib import Path

import bpy

from . import importing, settings, tasks
from .operator import WorkOperator
from .preferences import backend


class RELIT_OT_solve(WorkOperator):
    """Solve the capture, export its asset with its lights, and import it."""

    bl_idname = "relit.solve"
    bl_label = "Solve and Import"

    def act(self, context: bpy.types.Context) -> None:
        """Begin the work."""
        given = context.scene.relit
        settings.manifest(given)
        relit, capture, out = backend(context), settings.capture_folder(given), settings.out_folder(given)
        sky, levels = settings.sky_file(given), given.levels

        def work(task: tasks.Task) -> Path:
            out.mkdir(parents=True, exist_ok=True)
            return relit.solve(capture, out, sky, levels, task)

        def finish(asset: Path) -> None:
            now = bpy.context.scene.relit  # an undo may have replaced what was there when the work began
            now.capture, now.out, now.asset = str(capture), str(out), str(asset)
            importing.bring_in(bpy.context, asset, new_scene=True)

        tasks.start("Solving", work, finish, wait=self.wait)


class RELIT_OT_cancel(bpy.types.Operator):
    """Cancel the work of Relit that is under way."""

    bl_idname = "relit.cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Return True while there is work."""
        return tasks.current is not None and not tasks.current.ended

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Ask the work to end."""
        tasks.current.cancel()
        return {"FINISHED"}

"""The base of the operators: a failure becomes one sentence of Blender, and work waits only where there is no interface."""

import bpy
from bpy.props import BoolProperty

from .tasks import Failure


class RelitOperator(bpy.types.Operator):
    """An operator whose `act` may raise Failure."""

    bl_options = {"REGISTER"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Act, or report why not."""
        try:
            self.act(context)
        except (Failure, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}

    def act(self, context: bpy.types.Context) -> None:
        """Do the work."""
        raise NotImplementedError


class WorkOperator(RelitOperator):
    """An operator that begins work in a thread."""

    wait: BoolProperty(name="Wait", options={"HIDDEN", "SKIP_SAVE"}, default=bpy.app.background,
                       description="Return when the work has ended")

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Begin the work, and return at once."""
        self.wait = False
        return self.execute(context)

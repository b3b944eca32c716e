"""Send a frame range under the scene's world and lights to Relit, and show the frames on a card."""

import shutil
from pathlib import Path

import bpy
from bpy.props import StringProperty

from . import card, environment, lights, settings, tasks
from .operator import RelitOperator, WorkOperator
from .preferences import backend
from .service import Service

KEYS = "relit.keys/1"
REC709 = ("lin_rec709_scene", "srgb_texture", "srgb_rec709_scene", "g22_rec709_scene", "g18_rec709_scene")
"""The colour spaces of a capture whose maps are in the colours of Blender's lights."""


class RELIT_OT_relight(WorkOperator):
    """Relight the frame range of the scene under its world and its lights, and show the frames on a card."""

    bl_idname = "relit.relight"
    bl_label = "Relight Frame Range"

    def act(self, context: bpy.types.Context) -> None:
        """Read world and lights of all frames, and begin the work."""
        tasks.require_free()  # since other work may be reading the files that are written here
        scene, given = context.scene, context.scene.relit
        frames = range(scene.frame_start, scene.frame_end + 1)
        if not frames or frames[0] < 0:
            raise tasks.Failure(f"the frame range is {scene.frame_start} to {scene.frame_end}: Relit takes ranges from 0 on")
        root = _root(given)
        relit, capture = backend(context), settings.capture_folder(given)
        _check_colours(given)
        method, place = given.method, given.place
        out = settings.out_folder(given) / ("relit_frames" if method == "RELIGHT" else "shaded_frames") / "frame.####.exr"
        maps = settings.out_folder(given) / "maps"
        if (method == "SHADE" or given.guided) and not maps.is_dir():
            raise tasks.Failure(f"{maps} is not there: solve the capture first, or relight without its maps")
        guide = maps if given.guided else None
        keys, shades = sampled(context, frames, root, method)
        still = method == "RELIGHT" and isinstance(relit, Service)
        sky = environment.write_world(scene, root, frames, out.parent, still=still)
        if sky is None and not keys["lights"] and not any(shades):
            raise tasks.Failure("the scene has no light: add a light or a world, or choose another light in the panel")

        def work(task: tasks.Task) -> dict[int, Path]:
            out.parent.mkdir(parents=True, exist_ok=True)
            files = {number: out.with_name(f"frame.{number:04d}.exr") for number in frames}
            if method == "RELIGHT":
                relit.relight(capture, guide, keys, sky, frames, out, task)
                return files
            done: dict[str, Path] = {}
            for number, near in zip(frames, shades, strict=True):
                own = None if sky is None else sky.with_name(sky.name.replace("####", f"{number:04d}"))
                if (same := f"{near} {own}") in done:
                    shutil.copyfile(done[same], files[number])
                else:
                    relit.shade(maps, near, own, files[number], task)
                    done[same] = files[number]
            return files

        name = root.name

        def finish(files: dict[int, Path]) -> None:
            now = bpy.data.objects.get(name)  # an undo may have replaced what was there when the work began
            if now is None:
                raise tasks.Failure(f"{name} is gone: the frames are {out}")
            card.show(now, files, place)

        tasks.start("Relighting", work, finish, wait=self.wait)


class RELIT_OT_show_frames(RelitOperator):
    """Show relit frames of the capture on a card behind or beside the object."""

    bl_idname = "relit.show_frames"
    bl_label = "Show Frames"
    bl_options = {"REGISTER", "UNDO"}

    filepath: StringProperty(subtype="FILE_PATH")
    filter_glob: StringProperty(default="*.exr", options={"HIDDEN"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for a frame of the sequence."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def act(self, context: bpy.types.Context) -> None:
        """Add the card."""
        given = context.scene.relit
        card.show(_root(given), card.files_of(Path(bpy.path.abspath(self.filepath))), given.place)


class RELIT_OT_compare_render(RelitOperator):
    """Show relit frames of the capture and Blender's own render side by side."""

    bl_idname = "relit.compare_render"
    bl_label = "Compare with Render"

    def act(self, context: bpy.types.Context) -> None:
        """Fill two Image Editors."""
        card.compare(_root(context.scene.relit), context.window or context.window_manager.windows[0])


def sampled(context: bpy.types.Context, frames: range, root: bpy.types.Object, method: str) -> tuple[dict, list[dict]]:
    """Return the lights of the scene over a frame range: as light keys, or as near lights of each frame."""
    scene = context.scene
    kept = scene.frame_current
    tracks: dict[str, list[dict]] = {}
    shades: list[dict] = []
    try:
        for number in frames:
            scene.frame_set(number)
            graph = context.evaluated_depsgraph_get()
            lights.evaluated(root, graph)
            subject = lights.subject_of(root)
            lamps = lights.shining(context)
            if method == "SHADE":
                shades.append(lights.near(lamps, subject))
                continue
            keys = {lamp.name: lights.distant(lamp, subject) for lamp in lamps}
            for name in {**tracks, **keys}:
                track = tracks.setdefault(name, [])
                if name in keys:
                    track.append({"frame": number, **keys[name]})
                elif track:  # a light that is hidden is dark
                    track.append({**track[-1], "frame": number, "irradiance": [0.0, 0.0, 0.0]})
    finally:
        scene.frame_set(kept)
    found = []
    for name, track in tracks.items():
        if track[0]["frame"] > frames[0]:
            track.insert(0, {**track[0], "frame": track[0]["frame"] - 1, "irradiance": [0.0, 0.0, 0.0]})
        constant = all({**key, "frame": 0} == {**track[0], "frame": 0} for key in track)
        if any(any(key["irradiance"]) for key in track):
            found.append({"name": name, "keys": track[:1] if constant else track})
    rate = scene.render.fps / scene.render.fps_base
    return {"schema": KEYS, "frames_per_second": rate, "lights": found}, shades


def _root(given: settings.Settings) -> bpy.types.Object:
    if given.root is None or "relit_camera" not in given.root:
        raise tasks.Failure("no asset is imported into this scene: solve a capture, or import its asset")
    return given.root


def _check_colours(given: settings.Settings) -> None:
    """Raise Failure where numbers of lights would be of other colours than Relit takes them for."""
    space = getattr(getattr(bpy.data, "colorspace", None), "working_space", "Linear Rec.709")
    if space != "Linear Rec.709":
        raise tasks.Failure(f"Blender works in {space}: choose Linear Rec.709 (Render, Color Management), in which Relit takes lights")
    space = settings.manifest(given).get("color_space", "lin_rec709_scene")
    if given.method == "SHADE" and space not in REC709:
        raise tasks.Failure(f"the capture is in {space}, in whose colours relit shade takes near lights: relight the photographs")

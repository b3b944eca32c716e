"""The options of `relit solve` and `relit join`."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from service.requests.base.base import CAPTURE, Choice, Request, Role, SequenceRequest, Spelling, StackOptions
from stage.model import Fraction, Line, Positive

SVBRDF_LIGHTS = 8
"""From this many lights on svbrdf is the default: it fits six lobes and a direction to each pixel, and what eight lights do not tell it is
unsure, where robust is sure of normals that highlights and bounced light bend (docs/svbrdf.md, Few lights)."""

MAX_SIGMA = 30.0
"""Largest standard error, in degrees, of a normal that counts as solved, unless the request says otherwise: a normal this far off says
little more than that the surface faces the camera."""

BRIGHT_ALBEDO, ALBEDO_PERCENTILE = 0.8, 99.0
"""The albedo, that of white paint, which bright pixels of a capture of relative lights are given, and the percentile that is bright."""


class Method(Choice):
    """The method that solves normals."""

    LAMBERT = "lambert", "least squares on every light that gave a reading"
    ROBUST = "robust", "least squares on the lights that are neither in shadow nor in a highlight at the pixel"
    GRADIENT = "gradient", "diffuse and specular normals from spherical gradient frames"
    REFERENCE = "reference", "from a ball of the object's material, photographed under the same lights"
    SVBRDF = "svbrdf", "normal, diffuse albedo, specular and roughness"


class Intensities(Choice):
    """The intensities of distant lights that a solve uses."""

    CHOSEN = "chosen", "those that the images ask for where they explain left-out pixels much better than those of the manifest"
    DECLARED = "declared", "those of the manifest"


class LightsKnown(Choice):
    """How far a solve trusts the lights of the manifest."""

    DECLARED = "declared", "the lights of the manifest"
    REFINED = "refined", "the lights of the manifest: directions that are only rough, or a rig that stands elsewhere, refined by the images"
    UNKNOWN = "unknown", "distant lights that are found from the images; those of the manifest are placeholders"


class Materials(Choice):
    """The roughness and F0 of each pixel of the maps."""

    COHERENT = "coherent", "by its own evidence and that of neighbours of its colour: borders stay where there is evidence, speckle goes"
    EACH_PIXEL = "each-pixel", "what its own readings say"


class SolveOptions(StackOptions):
    """Options for solving normals, albedo and height."""

    method: Method | None = Field(default=None, description=(
        "How normals are solved; None: gradient where there are gradient frames; else svbrdf where there are extended lights, or "
        f"{SVBRDF_LIGHTS} lights or more; else robust."))
    lights: LightsKnown = LightsKnown.DECLARED
    """How far the lights of the manifest are trusted."""
    intensities: Intensities = Intensities.CHOSEN
    """The intensities of distant lights that are used; the report says what was found."""
    materials: Materials = Materials.COHERENT
    """How roughness and F0 of a pixel are chosen."""
    max_sigma: Positive | None = Field(default=None, description=(
        "Largest standard error, in degrees, of a normal that counts as solved; less certain ones are kept outside the mask, with the "
        f"status unsure. None: {MAX_SIGMA:g}; 180 refuses none."))
    albedo_scale: Positive | None = Field(default=None, description=(
        "Factor of the albedo over that under the lights of the manifest, for captures whose irradiance_scale is relative: 1 keeps it, the "
        "factor of another report makes both alike. None: the one that bounced light tells, else that under which percentile "
        f"{ALBEDO_PERCENTILE:g} of the albedo is {BRIGHT_ALBEDO:g}; a sequence has that of its first step. The report records it."))
    least_confidence: Fraction | None = None
    """Least confidence, 0 to 1, of a normal that counts as solved; less certain ones are kept outside the mask, with the status unsure.
    None: any."""


class SolveRequest(SolveOptions, SequenceRequest):
    """Normals, albedo and height of a light-stage capture."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder with a capture.json; or a sequence: a folder of such folders, one a time step, with a sequence.json or in order of name."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for maps.exr and report.json."""
    device: Annotated[Line | None, Role.MACHINE] = None
    """cpu, cuda:0, …, several of one kind with commas between, which share the work, or all for every CUDA device; None: the first CUDA
    device, else the CPU."""
    reference_ball: Annotated[Path | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """Capture of a ball of the object's material under the same lights, for the method reference."""


class JoinRequest(Request):
    """One surface from solved maps and a depth of the same view: the detail of the normals, and the shape and place of the depth."""

    maps: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="MAPS")]
    """Folder with the maps.exr of `relit solve`, or the file."""
    depth: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="DEPTH")]
    """Folder with the depth.exr of `relit depth` by the same camera from the same place, or the file."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for maps.exr and report.json."""

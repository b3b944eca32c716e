"""Steps of the general solver, `svbrdf`, that can be left out."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MaterialOptions:
    """Steps of the svbrdf solver that can be left out, to measure what each contributes."""

    shadows: bool = True
    """Leave out readings in cast shadow."""
    interreflection: bool = True
    """Subtract the light that the object throws on itself."""
    settling: bool = True
    """Find that light again from the surface without it, or leave it where shadows show none."""
    scale: bool = True
    """Choose the scale of albedo from the images where that of the lights is unknown."""
    intensities: bool = True
    """Refine the intensities of the lights where the object shows that they are wrong."""
    sharing: bool = True
    """Let pixels share materials."""
    mixtures: bool = True
    """Let a pixel have two of the shared materials."""
    parts: bool = True
    """Move parts of the object in depth to where their shadows agree with the images."""
    metals: bool = True
    """Search the normals of metals again under the lobes that they share."""


WHOLE_SOLVER = MaterialOptions()

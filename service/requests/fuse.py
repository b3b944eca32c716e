"""What `relit fuse` takes."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from service.requests.base import Choice, DeviceRequest, Options, Role, Spelling
from stage.model import Positive


class Misplaced(Choice):
    """What becomes of scans that lie beside the surface of the others."""

    LEAVE_OUT = "leave-out", "fuse the others, and say which were left out"
    KEEP = "keep", "fuse them all the same"


class FuseOptions(Options):
    """How scans are fused."""

    voxel_m: Positive | None = None
    """Side of a voxel, metres. None: half the distance between neighbouring pixels, or the noise of a pixel if that is larger."""
    misplaced: Misplaced = Misplaced.LEAVE_OUT
    """What becomes of scans that lie beside the surface of the others by more than their σ explain."""
    join_normals: bool = False
    """Whether vertices are moved until the surface has the photometric normals of the maps of the scans, without their drift."""
    tiles: bool = False
    """Whether the surface is written as tiles (site.usda with payloads, and PLY files) in place of mesh.ply and asset.usdc, so that memory
    does not grow with its size. Tiles have the colours of their vertices and no textures."""
    texture: bool = True
    """Whether asset.usdc is made: a mesh of fewer faces with textures of what the views show."""
    texture_faces: Annotated[int, Field(ge=100, le=2_000_000)] = 30_000
    """Most faces of the mesh of asset.usdc; mesh.ply has all."""
    texture_px: Annotated[int, Field(ge=64, le=16384)] = 2048
    """Side of the texture images in pixels."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.tiles and self.join_normals:
            raise ValueError("join_normals: is given with tiles, which are written one by one: normals are joined on the whole mesh")
        for name in ("texture_faces", "texture_px"):
            if self.tiles and getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(f"{name}: is given with tiles, which have no texture: leave one of them out")
        return self


class FuseRequest(FuseOptions, DeviceRequest):
    """Fuse the scans of a set, whose poses are known, into one surface."""

    scan_set: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="SCAN_SET")]
    """A scan-set.json with poses, as `relit register` writes it, or its folder."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for mesh.ply, asset.usdc and report.json, or site.usda and tiles."""
    threads: Annotated[int | None, Field(ge=1), Role.MACHINE] = None
    """Scans that are read at one time; each takes some 200 bytes a pixel. None: one for each core."""
    cache: Annotated[Path | None, Role.MACHINE] = None
    """Folder for fused bricks, from which a run that was interrupted goes on; it may be deleted afterwards. None: a temporary folder."""

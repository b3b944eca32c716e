"""The options of `relit register`, `relit fuse` and `relit compare`."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from service.requests.base.base import Choice, Commas, DeviceRequest, Options, Role, Spelling
from service.requests.base.option_values import Corners, CornersText
from service.requests.calibrate import Markers
from stage.model import Finite, Fraction, Line, NotNegative, Positive

Unit = Literal["m", "cm", "mm", "um", "in"]


class GivenPoses(Choice):
    """The use of the poses of the scan set."""

    REFINED = "refined", "starts, right to about a sixtieth of the object; pairs that do not overlap there are not tried"
    IGNORED = "ignored", "nothing: all pairs are searched"


class TableUse(Choice):
    """The use of the turntable of the scan set."""

    START = "start", "its angles give the starts of all poses, which then move freely"
    ANGLES = "angles", "the axis is right, and only the angles are found"
    FIXED = "fixed", "axis and angles are right: nothing is moved, and the report says what the surfaces say of it"


class Accepted(Choice):
    """Poses that are taken although the evidence is open."""

    LOOK_ALIKE = "look-alike", "of scans that fit as well when they are turned, the pose that matches most, with a σ up to the turned one"


class RegisterOptions(Options):
    """Options for registering scans."""

    poses: GivenPoses = GivenPoses.REFINED
    """The use of the poses of the scan set."""
    turntable: TableUse = TableUse.START
    """The use of the turntable of the scan set, where it has one."""
    cell_m: Positive | None = None
    """Side of the cells whose points are averaged for the search without starts, metres. None: a sixtieth of the median extent of the
    scans."""
    least_overlap: Annotated[Fraction, Field(gt=0)] = 0.1
    """Least part of the smaller of two scans that must lie on the surface of the other."""
    accept: Accepted | None = None
    """Poses that are taken although the evidence is open. None: they are refused."""
    starts: bool = False
    """Take poses of the file, or of the turntable, where they fit and the surfaces do not decide, as of a vase about its axis: σ there is a
    cell (`cell_m`)."""
    reference: Line | None = None
    """Name of the scan whose pose stays. None: the first with a pose, or the first."""
    markers: Markers | None = None
    """Set of coded markers, printed and stuck around the object, that are looked for in the images of range images and used as targets.
    None: none are looked for."""
    board: Annotated[tuple[Corners, Corners] | None, CornersText, Spelling(metavar="9x6")] = None
    """Inner corners of a chessboard that stands beside the object, across and down, one number odd and one even; it is looked for in the
    images of range images and its corners are used as targets. None: none is looked for."""

    @model_validator(mode="after")
    def _board_has_ends(self) -> Self:
        if self.board is not None and sum(self.board) % 2 == 0:
            raise ValueError(f"board: {self.board[0]}x{self.board[1]} looks the same from both ends: of its inner corners, one number must "
                             "be odd and the other even")
        return self


class RegisterRequest(RegisterOptions):
    """Find the poses of scans of one object by their surfaces, and say how sure each is and which scans could not be joined."""

    scan_set: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="SCAN_SET")]
    """A folder with a scan-set.json, or the file: depth results and PLY files, with or without poses."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for scan-set.json with the poses, and report.json."""
    threads: Annotated[int | None, Field(ge=1), Role.MACHINE] = None
    """Scans that are read, and pairs that are registered, at one time. None: one for each core."""
    memory_gb: Annotated[Positive, Role.MACHINE] = 2.0
    """Memory for scans that are read again, thinned, for further pairs, GB; each thread has two scans beside."""
    cache: Annotated[Path | None, Role.MACHINE] = None
    """Folder for thinned scans and registered pairs, from which a run that was interrupted goes on; it may be deleted afterwards. None: a
    temporary folder."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.turntable is not TableUse.START and self.poses is GivenPoses.IGNORED:
            raise ValueError(f"poses is ignored, but turntable is {self.turntable}: give one of them")
        if self.starts and (self.poses is GivenPoses.IGNORED or self.turntable is TableUse.FIXED):
            other = f"poses is {self.poses}" if self.poses is GivenPoses.IGNORED else f"turntable is {self.turntable}"
            raise ValueError(f"starts: is given, but {other}: give one of them")
        return self


class Misplaced(Choice):
    """The treatment of scans that lie beside the surface of the others."""

    LEAVE_OUT = "leave-out", "fuse the others, and say which were left out"
    KEEP = "keep", "fuse them all the same"


class Closing(Choice):
    """The holes of a fused surface that are closed."""

    NONE = "none", "none: the surface is what was measured"
    PINHOLES = "pinholes", "those of at most two voxels, in which no voxel tells whether there is surface"
    ALL = "all", "all, by membranes whose vertices are marked as invented: the mesh is watertight"


class FuseOptions(Options):
    """Options for fusing scans."""

    voxel_m: Positive | None = None
    """Side of a voxel, metres. None: half the distance between neighbouring pixels, or the noise of a pixel if that is larger."""
    misplaced: Misplaced = Misplaced.LEAVE_OUT
    """The treatment of scans that lie beside the surface of the others by more than their σ explain."""
    close: Closing = Closing.PINHOLES
    """The holes of the mesh that are closed. Tiles keep all of theirs."""
    join_normals: bool = False
    """Move vertices until the surface has the photometric normals of the maps of the scans, without their drift."""
    tiles: bool = False
    """Write the surface as tiles (site.usda with payloads, and PLY files) in place of mesh.ply and asset.usdc, so that memory
    does not grow with its size. Tiles have the colours of their vertices and no textures."""
    texture: bool = True
    """Make asset.usdc: a mesh of fewer faces with textures of what the views show."""
    texture_faces: Annotated[int, Field(ge=100, le=2_000_000)] = 30_000
    """Most faces of the mesh of asset.usdc; mesh.ply has all."""
    texture_px: Annotated[int, Field(ge=64, le=16384)] = 2048
    """Side of the texture images in pixels."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.tiles and self.join_normals:
            raise ValueError("join_normals: is given with tiles, which are written one by one: normals are joined on the whole mesh")
        if self.tiles and self.close is Closing.ALL:
            raise ValueError("close: is all, but tiles are written one by one, and a hole may lie in several: leave one of them out")
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


class Alignment(Choice):
    """The way by which a scan comes to lie on its design."""

    SEARCH = "search", "the pose is searched, whatever it is"
    REFINE = "refine", "the scan lies on the design to about a fiftieth of its size, and is moved the rest of the way"
    NONE = "none", "the scan is in the frame of the design, and stays where it is"


class CompareOptions(Options):
    """Options for the comparison of a scan with its design."""

    align: Alignment = Alignment.SEARCH
    """The way by which the scan comes to lie on the design."""
    scan_unit: Unit = "m"
    """Unit of the coordinates of the scan."""
    design_unit: Unit = "mm"
    """Unit of the coordinates of the design."""
    tolerance_m: Annotated[tuple[Finite, Finite] | None, Commas, Spelling(metavar="LOW,HIGH")] = None
    """Smallest and largest deviation of the whole surface that is allowed, metres; outside of the design is positive. None: the whole
    surface is not judged."""
    sigma_m: Positive | None = None
    """Standard deviation of each point across the surface, metres. None: that of the file (property sigma of a PLY file), else the scatter
    of the points around local planes."""
    shared_sigma_m: NotNegative = 0.0
    """Standard deviation of errors that whole regions of the scan share, such as those of its calibration, metres: no mean makes them
    smaller."""
    smallest_fault_m: Positive | None = None
    """Side of the smallest fault that is looked for, metres: mean deviations of patches of half that side are judged, so that it fills one.
    None: eight times the distance of neighbouring points."""
    reach_m: Positive | None = None
    """Largest deviation that is looked for, metres: points that are farther from the design do not belong to it. None: a fiftieth of its
    size."""
    false_alarm: Annotated[float, Field(gt=0, lt=0.5)] = 0.05
    """Largest probability that any region is judged wrongly, one within its tolerance as outside or one outside as within."""
    least_seen: Fraction = 0.9
    """Least part of a region that the scan must show for it to pass."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.tolerance_m is not None and self.tolerance_m[0] >= self.tolerance_m[1]:
            raise ValueError(f"tolerance_m: is {self.tolerance_m[0]:g},{self.tolerance_m[1]:g}: give the smaller limit first")
        return self


class CompareRequest(CompareOptions, DeviceRequest):
    """Compare a scan with the design of the part: its deviations with their σ, and whether regions are within their tolerances."""

    scan: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="SCAN")]
    """The scan: a PLY, STL or OBJ file, or a folder of `relit fuse`."""
    design: Annotated[Path, Role.INPUT]
    """The surface that was wanted: an STL, OBJ or PLY file of triangles. Programs for design export STEP as STL."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for deviations.ply, regions.csv, comparison.png and report.json."""
    regions: Annotated[Path | None, Role.INPUT] = None
    """Regions of the design with their tolerances (JSON, schema relit.tolerances/1). None: there are none."""

"""The textured asset of a fusion: what its texels show, and whether programs that read USD take it."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from service.requests.register import FuseRequest
from service.scans.fusion.fuse import fuse
from stage.capture.camera import Camera
from stage.formats.images import read_pixels
from stage.results.maps import SurfaceMaps
from tests.clients.validators import findings
from tests.scenes.in_front import gradient, unit
from tests.scenes.statue import colour_of, distance, turntable, write_scans

pytest.importorskip("xatlas", reason="xatlas is not installed")
pytestmark = pytest.mark.long
PX, FACES = 512, 4000
WAVE_M, TILT = 0.02, 0.25
"""Length of the waves of the normals that solved maps show and depth does not, and their largest tilt, radians."""


def fine_normals(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Normals with waves along y, as of a relief far below the noise of the depth."""
    tilted = normals + TILT * np.cos(2 * np.pi * points[..., 1:2] / WAVE_M) * np.array([0.0, 1.0, 0.0])
    return tilted / np.linalg.norm(tilted, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def asset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("textured")
    shots = turntable(9, (200, 150))
    file = write_scans(folder, shots, coloured=True, maps=[_maps(shot) for shot in shots])
    return fuse(FuseRequest(scan_set=file, out=folder / "out", voxel_m=4e-3, texture_px=PX, texture_faces=FACES, device="cpu"))


def _maps(shot) -> SurfaceMaps:
    camera = Camera(projection="perspective", resolution=shot.side[::-1], focal_px=(shot.focal, shot.focal))
    points = camera.points(-shot.true) @ shot.world_from_camera[:3, :3].T + shot.world_from_camera[:3, 3]
    normal = np.zeros((*shot.side, 3), dtype=np.float32)
    normal[shot.mask] = fine_normals(points[shot.mask], unit(gradient(distance, points[shot.mask]))) @ shot.world_from_camera[:3, :3]
    albedo = np.where(shot.mask[..., None], (colour_of(points) / 255.0) ** 2.2, 0).astype(np.float32)
    return SurfaceMaps(camera=camera, mask=shot.mask, normal=normal, diffuse_albedo=albedo,
                       specular=np.where(shot.mask[..., None], np.float32(0.04), 0) * np.ones(3, np.float32),
                       roughness=np.where(shot.mask, np.float32(0.4), 0))


def texel_places(asset):
    """World points, frames and texture places of points within the faces of the mesh."""
    usd_stage = Usd.Stage.Open(str(asset.asset_path))
    mesh = next(UsdGeom.Mesh(prim) for prim in usd_stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    points = np.array(mesh.GetPointsAttr().Get())
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    st = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened())
    normals = np.array(mesh.GetNormalsAttr().Get())
    middle = np.array([0.4, 0.35, 0.25])
    corners = [st.reshape(-1, 3, 2)[:, k].astype(float) for k in range(3)]
    (s1, t1), (s2, t2) = ((corners[k] - corners[0]).T for k in (1, 2))
    p = [points[faces[:, k]].astype(float) for k in range(3)]
    det = s1 * t2 - s2 * t1
    along_s = ((p[1] - p[0]) * t2[:, None] - (p[2] - p[0]) * t1[:, None]) / np.where(det == 0, 1, det)[:, None]
    along_t = ((p[2] - p[0]) * s1[:, None] - (p[1] - p[0]) * s2[:, None]) / np.where(det == 0, 1, det)[:, None]
    place = sum(w * c for w, c in zip(middle, corners, strict=True))
    point = sum(w * c for w, c in zip(middle, p, strict=True))
    normal = sum(w * normals[faces[:, k]] for k, w in enumerate(middle))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    large = np.abs(det) * PX**2 > 8  # texels: the middle of a smaller face is not told from its neighbours
    return point[large], normal[large], along_s[large], along_t[large], place[large]


def test_texels_hold_the_albedo_and_the_normals_of_the_places_that_they_show(asset):
    assert asset.facts["texture"]["faces"] <= FACES
    point, normal, along_s, along_t, place = texel_places(asset)
    col, row = (place[:, 0] * PX).astype(int), ((1 - place[:, 1]) * PX).astype(int)
    folder = asset.asset_path.parent / "asset_textures"
    colour = read_pixels(folder / "base_color.png").astype(float)[row, col]
    colour = colour / (65535.0 if colour.max() > 1.5 else 1.0)
    off = np.abs(colour - colour_of(point) / 255.0).max(axis=1)
    assert np.median(off) < 0.03 and np.percentile(off, 90) < 0.1  # sRGB against a power of 2.2, and texels of 4 mm

    packed = read_pixels(folder / "normal.png").astype(float)[row, col]
    local = 2 * packed / (65535.0 if packed.max() > 1.5 else 1.0) - 1
    tangent = along_s - normal * (along_s * normal).sum(axis=1, keepdims=True)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    bitangent = np.cross(normal, tangent)
    bitangent *= np.sign((bitangent * along_t).sum(axis=1, keepdims=True))
    shown = local[:, :1] * tangent + local[:, 1:2] * bitangent + local[:, 2:] * normal
    true = unit(gradient(distance, point))

    def angle(one, other):
        return np.degrees(np.arccos(np.clip((one * other).sum(axis=1) / np.linalg.norm(one, axis=1), -1, 1)))

    with_waves, without = angle(shown, fine_normals(point, true)), angle(shown, true)
    assert np.median(with_waves) < 0.6 * np.median(without)  # pixels of 5 mm blur waves of 20 mm, which the depth does not show at all
    assert np.median(with_waves) < 4


def test_roughness_and_specular_arrive_as_they_were(asset):
    point, _, _, _, place = texel_places(asset)
    col, row = (place[:, 0] * PX).astype(int), ((1 - place[:, 1]) * PX).astype(int)
    folder = asset.asset_path.parent / "asset_textures"
    rough = read_pixels(folder / "roughness.png").astype(float)[row, col]
    assert np.percentile(np.abs(rough.ravel() / (65535.0 if rough.max() > 1.5 else 1.0) - 0.4), 90) < 0.01
    assert len(point) > FACES / 4


def test_validators_find_nothing(asset):
    assert findings(asset.asset_path) == []

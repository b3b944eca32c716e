"""Texture images, read back and judged by formulas written here again."""

import dataclasses
import struct

import numpy as np
import OpenImageIO as oiio
import pytest

from service.asset.content.mesh import height_mesh
from service.asset.content.metallic import metallic_look
from service.asset.content.textures import bleed, write_textures
from service.errors import AssetError
from service.requests.export import TextureFormat
from stage.formats import exr
from tests.reference.colour import AP1_TO_REC709, srgb_to_linear
from tests.scenes.surfaces import make_ball, make_sheet, make_wave

"""As published for ACEScg with the Bradford adaptation."""

CODE = 0.5 / 65535 * 2.28 + 1.5e-5
"""Half a code of 16 bits, times the steepest slope of the sRGB curve, and the fast powers of OpenColorIO."""


def read_png(path):
    """Codes / top as float64, bits per channel, chunk names."""
    data, chunks, at = path.read_bytes(), [], 8
    while at < len(data):
        length, kind = struct.unpack(">I4s", data[at:at + 8])
        chunks.append(kind.decode())
        at += 12 + length
    bits = data[24]
    codes = oiio.ImageBuf(str(path)).get_pixels(oiio.UINT16 if bits == 16 else oiio.UINT8)
    return codes.astype(np.float64).squeeze() / (2**bits - 1), bits, chunks


def recomposed(mesh, encoded):
    """Camera-frame normals at the vertices, on pixels, from a normal map and the mesh alone: MikkTSpace, face by face."""
    points, st = mesh.points.astype(np.float64), mesh.st.astype(np.float64)
    n = mesh.normals.astype(np.float64)
    tangent, start = np.zeros_like(points), 0
    for count in mesh.face_counts:
        corners = mesh.face_indices[start:start + count]
        start += count
        diagonals = [[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]]
        across = [[np.sum((values[corners[i]] - values[corners[k % count]]) ** 2) for i, k in ((0, 2), (1, 3))] for values in (st, points)]
        first = count == 3 or across[0][0] < across[0][1] or (across[0][0] == across[0][1] and across[1][0] <= across[1][1])
        for face in (corners[diagonal] for diagonal in diagonals[0 if first else 1][:count - 2]):
            # P is a plane over (s, t); the first slope is ∂P/∂s
            slope = np.linalg.solve(np.column_stack([np.ones(3), st[face]]), points[face])[1]
            for k in range(3):
                flat = np.eye(3) - np.outer(n[face[k]], n[face[k]])
                towards, one, two = (flat @ way for way in (slope, points[face[k - 1]] - points[face[k]],
                                                            points[face[(k + 1) % 3]] - points[face[k]]))
                angle = np.arccos(np.clip(one @ two / np.linalg.norm(one) / np.linalg.norm(two), -1, 1))
                tangent[face[k]] += angle * towards / np.linalg.norm(towards)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    x, y, z = (encoded[mesh.rows, mesh.cols] * 2 - 1).T[..., None]
    return (x * tangent + y * np.cross(n, tangent) + z * n)[:mesh.centred]


def solved(maps, mesh):
    """Solved normals at the vertices that lie on pixels."""
    return maps.normal[mesh.rows[:mesh.centred], mesh.cols[:mesh.centred]]


def tilted(maps, seed=5):
    """The maps with normals that the height does not have, as noise and fine relief give."""
    normal = np.random.default_rng(seed).normal(size=(*maps.mask.shape, 3)) * 0.3 + [0, 0, 1]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return dataclasses.replace(maps, normal=normal.astype(np.float32))


@pytest.mark.parametrize("maps", [make_ball(), make_wave("orthographic"), make_wave("perspective")],
                         ids=["ball", "orthographic wave", "perspective wave"])
def test_normal_map_gives_the_solved_normals_back(maps, tmp_path):
    maps = tilted(maps)
    mesh = height_mesh(maps)
    write_textures(maps, mesh, tmp_path)
    encoded, bits, chunks = read_png(tmp_path / "normal.png")
    assert bits == 16 and not {"sRGB", "gAMA", "iCCP"} & set(chunks)  # nothing that could make a reader convert it
    # half a code of 16 bits is 1.5e-5 after scale 2; the mesh frame is float32; three components add up
    np.testing.assert_allclose(recomposed(mesh, encoded), solved(maps, mesh), atol=5e-5)


def test_normal_map_of_a_coarser_mesh(tmp_path):
    maps = tilted(make_ball(48))
    mesh = height_mesh(maps, vertex_budget=200)
    assert mesh.step > 1
    write_textures(maps, mesh, tmp_path)
    encoded, _, _ = read_png(tmp_path / "normal.png")
    np.testing.assert_allclose(recomposed(mesh, encoded), solved(maps, mesh), atol=5e-5)
    between = maps.mask & (np.arange(48) % mesh.step > 0) & (np.arange(48) % mesh.step > 0)[:, None]
    between[:12], between[36:], between[:, :12], between[:, 36:] = False, False, False, False
    decoded = encoded * 2 - 1
    # tangent space keeps lengths and the angle to the frame: on texels between vertices only that is checked here
    np.testing.assert_allclose(np.linalg.norm(decoded, axis=-1)[between], 1, atol=5e-5)


def test_green_is_up_and_red_is_right(tmp_path):
    normal = np.zeros((4, 4, 3), dtype=np.float32)
    normal[...] = [0.6, 0, 0.8]
    normal[:2] = [0, 0.6, 0.8]  # the upper rows face up
    maps = make_sheet(np.ones((4, 4), dtype=bool), normal=normal)
    write_textures(maps, height_mesh(maps), tmp_path)
    encoded, _, _ = read_png(tmp_path / "normal.png")
    np.testing.assert_allclose(encoded[0, 0], [0.5, 0.8, 0.9], atol=1e-5)
    np.testing.assert_allclose(encoded[3, 0], [0.8, 0.5, 0.9], atol=1e-5)


def test_albedo_round_trip(tmp_path):
    rng = np.random.default_rng(3)
    albedo = rng.random((16, 9, 3), dtype=np.float32)
    maps = make_sheet(np.ones((16, 9), dtype=bool), diffuse_albedo=albedo)
    textures = write_textures(maps, height_mesh(maps), tmp_path)
    encoded, bits, chunks = read_png(tmp_path / "diffuse_albedo.png")
    assert bits == 16 and "sRGB" in chunks
    np.testing.assert_allclose(srgb_to_linear(encoded), albedo, atol=CODE)
    assert textures["diffuse_albedo"].clipped_pixels == 0


def test_albedo_is_converted_from_acescg(tmp_path):
    albedo = np.empty((4, 4, 3), dtype=np.float32)
    albedo[...] = [0.5, 0.4, 0.3]
    maps = make_sheet(np.ones((4, 4), dtype=bool), diffuse_albedo=albedo, color_space="lin_ap1_scene")
    write_textures(maps, height_mesh(maps), tmp_path)
    encoded, _, _ = read_png(tmp_path / "diffuse_albedo.png")
    expected = AP1_TO_REC709 @ [0.5, 0.4, 0.3]
    np.testing.assert_allclose(srgb_to_linear(encoded[0, 0]), expected, atol=CODE + 1e-4)  # matrix digits


def test_clipped_pixels_are_counted_where_the_mask_is(tmp_path):
    albedo = np.full((8, 8, 3), 0.5, dtype=np.float32)
    albedo[0, :3, 0] = 1.5
    albedo[1, 0] = -0.2
    albedo[2, 0] = 1.0005  # half rounding of a white: no display shows it
    albedo[7] = 9.0
    mask = np.ones((8, 8), dtype=bool)
    mask[7] = False
    maps = make_sheet(mask, diffuse_albedo=albedo)
    textures = write_textures(maps, height_mesh(maps), tmp_path)
    assert textures["diffuse_albedo"].clipped_pixels == 4
    encoded, _, _ = read_png(tmp_path / "diffuse_albedo.png")
    assert encoded[0, 0, 0] == 1 and (encoded[1, 0] == 0).all()


def test_roughness_is_sixteen_bit_raw(tmp_path):
    roughness = np.linspace(0, 1, 5 * 8, dtype=np.float32).reshape(5, 8)  # not square, not symmetric
    maps = make_sheet(np.ones((5, 8), dtype=bool), roughness=roughness)
    textures = write_textures(maps, height_mesh(maps), tmp_path)
    encoded, bits, chunks = read_png(tmp_path / "roughness.png")
    assert bits == 16 and textures["roughness"].color_space == "data" and "sRGB" not in chunks
    np.testing.assert_allclose(encoded, roughness, atol=0.5 / 65535 + 1e-7)  # half a code


def test_specular_and_roughness_reach_over_the_edge_of_the_mask(ball, tmp_path):
    write_textures(ball, height_mesh(ball), tmp_path)
    assert np.ptp(read_png(tmp_path / "roughness.png")[0]) == 0  # 0.35 in the mask, and bled everywhere else
    f0 = srgb_to_linear(read_png(tmp_path / "specular.png")[0])
    np.testing.assert_allclose(f0, 0.04, atol=CODE)


def test_a_look_adds_its_images_once(ball, tmp_path):
    def names(maps, folder):
        (tmp_path / folder).mkdir()
        return list(write_textures(maps, height_mesh(maps), tmp_path / folder, look=metallic_look(maps)))

    lambertian = dataclasses.replace(ball, specular=None, roughness=None)
    metal = dataclasses.replace(ball, specular=np.full_like(ball.specular, 0.7), diffuse_albedo=np.zeros_like(ball.specular))
    assert names(lambertian, "lambertian") == ["base_color", "normal"]  # its base colour is the albedo
    assert names(ball, "paint") == ["base_color", "roughness", "normal", "diffuse_albedo", "specular"]  # no metal anywhere
    assert names(metal, "metal") == ["base_color", "metallic", "roughness", "normal", "diffuse_albedo", "specular"]
    assert np.ptp(read_png(tmp_path / "metal" / "metallic.png")[0]) == 0


def test_eight_bits_are_for_colours_alone(ball, tmp_path):
    textures = write_textures(ball, height_mesh(ball), tmp_path, storage=TextureFormat.PNG8)
    bits = {name: read_png(tmp_path / texture.file_name)[1] for name, texture in textures.items()}
    assert bits == {"roughness": 16, "normal": 16, "diffuse_albedo": 8, "specular": 8}


def test_exr_keeps_the_values_and_the_colour_space_of_the_maps(ball, tmp_path):
    albedo = ball.diffuse_albedo * np.float32(2)  # more than a PNG can hold
    maps = dataclasses.replace(tilted(ball), diffuse_albedo=albedo, color_space="lin_ap1_scene")
    mesh = height_mesh(maps)
    textures = write_textures(maps, mesh, tmp_path, storage=TextureFormat.EXR)
    assert {name: texture.color_space for name, texture in textures.items()} == {
        "roughness": "data", "normal": "data", "diffuse_albedo": "lin_ap1_scene", "specular": "lin_ap1_scene"}
    channels, metadata = exr.read(tmp_path / "diffuse_albedo.exr")
    stored = np.stack([channels[c] for c in "RGB"], axis=-1)
    assert stored.dtype == np.float16 and exr.color_space_of(metadata) == "lin_ap1_scene"
    np.testing.assert_array_equal(stored[maps.mask], albedo[maps.mask].astype(np.float16))
    assert stored[0, 0].min() > 0 and textures["diffuse_albedo"].clipped_pixels == 0  # bled
    normals, _ = exr.read(tmp_path / "normal.exr")
    encoded = np.stack([normals[c] for c in "RGB"], axis=-1)
    assert encoded.dtype == np.float32
    np.testing.assert_allclose(recomposed(mesh, encoded), solved(maps, mesh), atol=2e-6)  # single precision, three sums


def test_pixels_that_are_not_finite_are_filled_from_their_neighbours(ball, tmp_path):
    albedo, normal = np.full_like(ball.diffuse_albedo, 0.5), ball.normal.copy()
    albedo[12, 12], normal[12, 12] = np.nan, np.inf
    maps = dataclasses.replace(ball, diffuse_albedo=albedo, normal=normal)
    textures = write_textures(maps, height_mesh(maps), tmp_path)
    encoded, _, _ = read_png(tmp_path / "diffuse_albedo.png")
    assert np.ptp(encoded) == 0 and textures["diffuse_albedo"].clipped_pixels == 0
    flat, _, _ = read_png(tmp_path / "normal.png")
    assert abs(flat[12, 12] - flat[12, 13]).max() < 0.1


def test_unknown_colour_space_is_an_error(ball, tmp_path):
    maps = dataclasses.replace(ball, color_space="lin_nowhere")
    with pytest.raises(AssetError, match="lin_nowhere"):
        write_textures(maps, height_mesh(maps), tmp_path)


def test_bleed_averages_the_nearest():
    known = np.array([[True, False, False, True]])
    filled = bleed(np.array([[1.0, 50, np.nan, 3.0]], dtype=np.float32), known, reach=1)
    np.testing.assert_array_equal(filled, [[1, 1, 3, 3]])


def test_bleed_rounds_codes_and_reaches_round_corners():
    codes = np.array([[10, 0, 13], [0, 0, 0], [0, 0, 0]], dtype=np.uint16)
    filled = bleed(codes, codes > 0, reach=1)
    assert filled.dtype == np.uint16
    np.testing.assert_array_equal(filled, [[10, 12, 13], [10, 12, 13], [12, 12, 12]])  # 11.5 is rounded up; the mean beyond


def test_bleed_of_nothing_is_zero():
    assert bleed(np.ones((3, 3, 3), dtype=np.float32), np.zeros((3, 3), dtype=bool), reach=4).max() == 0

"""The metallic look, and its MaterialX document."""

import dataclasses

import MaterialX as mx
import numpy as np
import pytest
from MaterialX.PyMaterialXGenGlsl import GlslShaderGenerator
from MaterialX.PyMaterialXGenMdl import MdlShaderGenerator
from MaterialX.PyMaterialXGenOsl import OslShaderGenerator
from MaterialX.PyMaterialXGenShader import DefaultColorManagementSystem, GenContext, UnitSystem

from kernels.photometric.posterior.sampling import Regime
from service.asset.content.metallic import GLASS_IOR, IOR_LIMITS, MIRROR, dielectric_ior, loss_warnings, metallic_look, specular_of_ior
from service.asset.content.openpbr import DOCUMENT, MATERIAL, openpbr_document, write_openpbr
from service.asset.content.textures import DATA_SPACE, DISPLAY_SPACE, Texture
from tests.scenes.surfaces import make_ball, make_sheet

SEARCHED = 0.004
"""Metallic is searched to 0.002; as much again for single precision, in which a quartic of about one cancels."""

RNG = np.random.default_rng(8)
METAL = {"base_color": Texture("base_color.png", DISPLAY_SPACE, 0), "metallic": Texture("metallic.png", DATA_SPACE, 0),
         "roughness": Texture("roughness.png", DATA_SPACE, 0), "normal": Texture("normal.png", DATA_SPACE, 0)}
PAINT = {name: METAL[name] for name in ("base_color", "roughness", "normal")}
LAMBERTIAN = {name: METAL[name] for name in ("base_color", "normal")}


def sheet(albedo, f0, **layers):
    """Maps of n pixels in four rows with albedo and F0 [n, 3]."""
    shape = (4, -1, 3)
    albedo, f0 = (np.asarray(layer, dtype=np.float32).reshape(shape) for layer in (albedo, f0))
    return make_sheet(np.ones(albedo.shape[:2], dtype=bool), diffuse_albedo=albedo, specular=f0, **layers)


def forward(base_color, metallic, ior):
    """Diffuse albedo and F0 [n, 3] of the metallic workflow, as the specification of UsdPreviewSurface says it."""
    dielectric = ((1 - ior) / (1 + ior)) ** 2
    share = metallic[..., None]
    return base_color * (1 - share), dielectric * (1 - share) + base_color * share


def random_colours(count, low=0.05, high=0.95):
    return RNG.uniform(low, high, (count, 3))


def test_paint_of_glass_stays_paint():
    albedo = random_colours(64)
    look = metallic_look(sheet(albedo, np.full((64, 3), 0.04)))
    assert look.ior == GLASS_IOR and not look.metallic.any()
    np.testing.assert_allclose(look.base_color.reshape(-1, 3), albedo, atol=1e-6)  # single precision
    assert look.lost_albedo < 1e-6 and look.lost_specular < 1e-6


def test_metals_have_their_f0_as_base_colour():
    f0 = random_colours(64, 0.3, 1.0)
    look = metallic_look(sheet(np.zeros((64, 3)), f0))
    assert (look.metallic == 1).all()
    np.testing.assert_allclose(look.base_color.reshape(-1, 3), f0, atol=1e-6)
    assert look.lost_specular < 1e-6


@pytest.mark.parametrize("ior", [1.5, 1.7])
def test_blends_are_inverted(ior):
    base_color, metallic = random_colours(400, 0.2, 0.9), np.repeat([0.0, 0.3, 0.6, 1.0], 100)
    metallic[:100] = 0  # the dielectrics that tell the index of refraction
    albedo, f0 = forward(base_color, metallic, ior)
    look = metallic_look(sheet(albedo, f0))
    assert look.ior == pytest.approx(ior, abs=1e-3)
    np.testing.assert_allclose(look.metallic.reshape(-1), metallic, atol=SEARCHED)
    np.testing.assert_allclose(look.base_color.reshape(-1, 3), base_color, atol=2 * SEARCHED)  # divided by a share of 0.4 or more
    assert look.lost_albedo < SEARCHED and look.lost_specular < SEARCHED


def test_no_other_colour_and_share_fits_better():
    """Over noisy, inconsistent and impossible pixels no value of metallic on a fine grid leaves a smaller misfit."""
    albedo, f0 = RNG.random((500, 3)) * RNG.random((500, 1)), RNG.random((500, 3)) * RNG.random((500, 1)) ** 2
    look = metallic_look(sheet(albedo, f0))
    dielectric = specular_of_ior(look.ior)

    def misfit(colour, share):
        return ((colour * (1 - share) - albedo) ** 2 + (dielectric * (1 - share) + colour * share - f0) ** 2).sum(axis=-1)

    least = np.full(500, np.inf)
    for share in np.linspace(0, 1, 1001):
        colour = ((1 - share) * albedo + share * (f0 - dielectric * (1 - share))) / ((1 - share) ** 2 + share**2)
        least = np.minimum(least, misfit(np.clip(colour, 0, 1), share))
    found = misfit(look.base_color.reshape(-1, 3), look.metallic.reshape(-1, 1))
    assert look.base_color.min() >= 0 and look.base_color.max() <= 1 and look.metallic.min() >= 0 and look.metallic.max() <= 1
    assert (found - least).max() < 1e-4  # what GRID is documented to miss
    lost = np.sqrt(found.mean() / 3)
    assert np.hypot(look.lost_albedo, look.lost_specular) == pytest.approx(lost, rel=1e-4)


def test_what_the_workflow_cannot_hold_is_reported():
    tinted = np.tile([0.07, 0.04, 0.02], (64, 1))  # coloured F0 on white paint
    look = metallic_look(sheet(np.full((64, 3), 0.8), tinted))
    assert 0.01 < look.lost_specular < 0.03 and look.lost_albedo < 0.02 and not list(loss_warnings(look))
    strongly = metallic_look(sheet(np.full((64, 3), 0.8), np.tile([0.45, 0.2, 0.05], (64, 1))))
    assert "F0 by 0.1" in next(loss_warnings(strongly))
    assert metallic_look(sheet(np.full((64, 3), 0.8), np.full((64, 3), 0.04))).lost_specular < 1e-6


def test_index_of_refraction_comes_from_the_dielectrics_alone():
    f0 = np.concatenate([np.full((400, 3), 0.08), np.tile([0.9, 0.6, 0.3], (600, 1))]) * RNG.normal(1, 0.05, (1000, 1))
    assert specular_of_ior(dielectric_ior(f0)) == pytest.approx(0.08, rel=0.01)  # the median of 400 values with 5 % noise


def test_glass_is_kept_where_the_noise_does_not_exclude_it():
    noise = RNG.normal(0, 0.01, (1000, 1)) * np.ones(3)
    assert dielectric_ior(0.045 + noise) == GLASS_IOR
    assert dielectric_ior(0.06 + noise) != GLASS_IOR
    assert dielectric_ior(np.full((500, 3), 0.9)) == GLASS_IOR  # metals alone
    assert dielectric_ior(np.zeros((0, 3))) == GLASS_IOR
    assert dielectric_ior(np.zeros((100, 3))) == IOR_LIMITS[0]


def test_lambertian_maps_reflect_nothing_at_normal_incidence():
    ball = dataclasses.replace(make_ball(), specular=None, roughness=None)
    look = metallic_look(ball)
    assert specular_of_ior(look.ior) == 0 and not look.metallic.any() and look.lost_albedo == 0
    np.testing.assert_array_equal(look.base_color, ball.diffuse_albedo)


def test_mirrors_are_metal():
    assert MIRROR == Regime.MIRROR
    regime = np.full((4, 16), int(Regime.MIXTURE), dtype=np.uint8)
    regime[0] = Regime.MIRROR
    look = metallic_look(sheet(np.full((64, 3), 0.02), np.full((64, 3), 0.05), regime=regime))
    assert (look.metallic[0] == 1).all() and (look.metallic[1:] < 0.5).all()
    np.testing.assert_allclose(look.base_color[0], 0.05, atol=1e-6)


def test_pixels_outside_the_mask_are_zero_and_do_not_count():
    ball = make_ball()
    wild = dataclasses.replace(ball, specular=np.where(ball.mask[..., None], ball.specular, 7).astype(np.float32))
    look, clean = metallic_look(wild), metallic_look(ball)
    assert not look.base_color[~ball.mask].any() and not look.metallic[~ball.mask].any()
    assert look.lost_specular == clean.lost_specular and look.ior == clean.ior
    empty = metallic_look(dataclasses.replace(ball, mask=np.zeros_like(ball.mask)))
    assert empty.lost_albedo == 0 and not empty.base_color.any()


def test_bands_do_not_show():
    base_color, metallic = RNG.uniform(0.1, 0.9, (301, 257, 3)), RNG.random((301, 257))
    metallic[::2] = 0
    albedo, f0 = forward(base_color, metallic, 1.5)
    maps = make_sheet(np.ones(metallic.shape, dtype=bool), diffuse_albedo=albedo.astype(np.float32), specular=f0.astype(np.float32))
    np.testing.assert_allclose(metallic_look(maps).metallic, metallic, atol=SEARCHED)


def reread(document, folder):
    """The document that a reader sees, with the definitions of the nodes."""
    write_openpbr(document, folder)
    library, found = mx.createDocument(), mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    mx.readFromXmlFile(found, str(folder / DOCUMENT))
    found.setDataLibrary(library)
    return found


@pytest.mark.parametrize("textures", [METAL, PAINT, LAMBERTIAN, {"base_color": METAL["base_color"]}], ids=len)
def test_materialx_finds_nothing(textures, tmp_path):
    document = reread(openpbr_document(textures, ior=1.6), tmp_path)
    assert document.validate() == (True, "")
    graph = document.getNodeGraph("Textures")
    nodes = [*graph.getNodes(), document.getNode("OpenPBR")]
    assert len(nodes) > 2
    for node in nodes:
        definition = node.getNodeDef()
        assert definition is not None
        for given in node.getInputs():
            assert given.getType() == definition.getActiveInput(given.getName()).getType()


def test_the_surface_reads_the_textures(tmp_path):
    document = reread(openpbr_document(METAL, ior=1.6), tmp_path)
    surface = document.getNode(MATERIAL).getConnectedNode("surfaceshader")
    assert surface.getCategory() == "open_pbr_surface" and surface.getInputValue("specular_ior") == pytest.approx(1.6)
    graph = document.getNodeGraph("Textures")
    files = {image.getName(): image.getInput("file") for image in graph.getNodes("image")}
    assert {name: (file.getValueString(), file.getColorSpace()) for name, file in files.items()} == {
        "base_color": ("base_color.png", "srgb_texture"), "metallic": ("metallic.png", ""),
        "roughness": ("roughness.png", ""), "normal": ("normal.png", "")}
    read = {given.getName(): graph.getOutput(given.getOutputString()).getConnectedNode().getName()
            for given in surface.getInputs() if given.getOutputString()}
    assert read == {"base_color": "base_color", "base_metalness": "metallic", "specular_roughness": "roughness",
                    "geometry_normal": "tangent_space"}


@pytest.mark.parametrize("kind", [GlslShaderGenerator, OslShaderGenerator, MdlShaderGenerator])
def test_renderers_can_make_a_shader_of_it(kind):
    document, library = openpbr_document(METAL, ior=1.6), mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    generator = kind.create()
    context = GenContext(generator)
    context.registerSourceCodeSearchPath(mx.getDefaultDataSearchPath())
    context.getOptions().targetDistanceUnit = "meter"
    colours, units = DefaultColorManagementSystem.create(generator.getTarget()), UnitSystem.create(generator.getTarget())
    colours.loadLibrary(library)
    units.loadLibrary(library)
    units.setUnitConverterRegistry(mx.UnitConverterRegistry.create())
    generator.setColorManagementSystem(colours)
    generator.setUnitSystem(units)
    source = generator.generate("owl", document.getNode(MATERIAL), context).getSourceCode("pixel")
    assert "srgb_texture_to_lin_rec709" in source and all(f"{name}_file" in source for name in METAL)


def test_a_lambertian_surface_reflects_nothing():
    document = openpbr_document(LAMBERTIAN, ior=1.0)  # elements live no longer than their document
    surface = document.getNode("OpenPBR")
    assert surface.getInputValue("specular_weight") == 0 and surface.getInputValue("specular_roughness") == 1


@pytest.mark.parametrize("space, known", [("lin_ap1_scene", "acescg"), ("lin_rec709_scene", "lin_rec709"),
                                          ("lin_ap0_scene", "lin_ap0_scene")])
def test_linear_colours_have_the_names_of_materialx(space, known):
    textures = {"base_color": Texture("base_color.exr", space, 0)}
    document = openpbr_document(textures, ior=1.5)
    image = document.getNodeGraph("Textures").getNode("base_color")
    assert image.getInput("file").getColorSpace() == known

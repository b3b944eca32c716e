"""The MaterialX document of a look, judged by the MaterialX library."""

import MaterialX as mx
import pytest
from MaterialX.PyMaterialXGenGlsl import GlslShaderGenerator
from MaterialX.PyMaterialXGenMdl import MdlShaderGenerator
from MaterialX.PyMaterialXGenOsl import OslShaderGenerator
from MaterialX.PyMaterialXGenShader import DefaultColorManagementSystem, GenContext, UnitSystem

from service.asset.content.openpbr import DOCUMENT, MATERIAL, openpbr_document, write_openpbr
from service.asset.content.textures import DATA_SPACE, DISPLAY_SPACE, Texture

METAL = {"base_color": Texture("base_color.png", DISPLAY_SPACE, 0), "metallic": Texture("metallic.png", DATA_SPACE, 0),
         "roughness": Texture("roughness.png", DATA_SPACE, 0), "normal": Texture("normal.png", DATA_SPACE, 0)}
PAINT = {name: METAL[name] for name in ("base_color", "roughness", "normal")}
LAMBERTIAN = {name: METAL[name] for name in ("base_color", "normal")}


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

"""MaterialX documents as UsdShade: each node becomes a shader of its definition's name, as the usdMtlx plug-in of OpenUSD does it.

The plug-in is not in OpenUSD's wheels, which cannot open a .mtlx, so that nothing refers to one. They also lack MaterialX's definitions,
and validators there call every such shader unknown. The shaders are therefore abstract prims (`class`), which traversals leave out, and
which UsdShade and Hydra find by the connection of the material. In a build with the plug-in, the same shaders as `def` have no finding.

Source: OpenUSD, usdMtlx (names of definitions, types, render context `mtlx`, MaterialXConfigAPI).
"""

from typing import Any

from pxr import Gf, Sdf, UsdShade

from service.asset.content.openpbr import GRAPH, SURFACE
from service.asset.usd.layers import AssetLayers

RENDER_CONTEXT = "mtlx"

_TYPES = {"float": Sdf.ValueTypeNames.Float, "string": Sdf.ValueTypeNames.String, "filename": Sdf.ValueTypeNames.Asset,
          "color3": Sdf.ValueTypeNames.Color3f, "vector2": Sdf.ValueTypeNames.Float2, "vector3": Sdf.ValueTypeNames.Float3,
          "surfaceshader": Sdf.ValueTypeNames.Token}


def define_materialx_surface(layers: AssetLayers, material: UsdShade.Material, document: Any) -> None:
    """Give a material a MaterialX surface, for renderers that read its render context; others see the material as it is.

    Args:
        document: MaterialX.Document of service.asset.content.openpbr.
    """
    graph, surface = document.getNodeGraph(GRAPH), document.getNode(SURFACE)
    nodes = UsdShade.NodeGraph.Define(layers.materials, material.GetPath().AppendChild(graph.getName()))
    shaders = {node.getName(): _shader(layers, nodes.GetPath(), node) for node in graph.getNodes()}
    for node in graph.getNodes():
        for given in node.getInputs():
            if source := given.getNodeName():
                _input(shaders[node.getName()], given).ConnectToSource(shaders[source].GetOutput("out"))
    for output in graph.getOutputs():
        nodes.CreateOutput(output.getName(), _TYPES[output.getType()]).ConnectToSource(shaders[output.getNodeName()].GetOutput("out"))
    shader = _shader(layers, material.GetPath(), surface)
    for given in surface.getInputs():
        if given.getOutputString():
            _input(shader, given).ConnectToSource(nodes.GetOutput(given.getOutputString()))
    material.CreateSurfaceOutput(RENDER_CONTEXT).ConnectToSource(shader.GetOutput("out"))
    for abstract in (nodes, shader):
        abstract.GetPrim().SetSpecifier(Sdf.SpecifierClass)
    prim = material.GetPrim()
    prim.AddAppliedSchema("MaterialXConfigAPI")  # by name, since the schema comes with the plug-in
    version = ".".join(map(str, document.getVersionIntegers()))
    prim.CreateAttribute("config:mtlx:version", Sdf.ValueTypeNames.String, custom=False).Set(version)


def _shader(layers: AssetLayers, parent: Sdf.Path, node: Any) -> UsdShade.Shader:
    """Define a node with the values of its inputs and its output `out`; connections are made when all nodes are there."""
    shader = UsdShade.Shader.Define(layers.materials, parent.AppendChild(node.getName()))
    shader.CreateIdAttr(node.getNodeDef().getName())
    for given in node.getInputs():
        if not given.getValueString():
            continue
        if given.getType() == "filename":
            file = _input(shader, given)
            file.Set(Sdf.AssetPath(f"{layers.texture_folder}/{given.getValueString()}"))
            if given.getColorSpace():
                file.GetAttr().SetColorSpace(given.getColorSpace())
        else:
            value = given.getValue()
            _input(shader, given).Set(Gf.Vec3f(*value) if given.getType() == "color3" else value)
    shader.CreateOutput("out", _TYPES[node.getType()])
    return shader


def _input(shader: UsdShade.Shader, given: Any) -> UsdShade.Input:
    return shader.CreateInput(given.getName(), _TYPES[given.getType()])

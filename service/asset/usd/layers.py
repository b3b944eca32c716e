"""The layers of an asset while it is written, with its variant sets `geo`, `look` and `light`.

A .usda or .usdc asset is a small interface layer (root prim, variant sets, extents) with a payload: `<stem>_layers/payload.usda`, which
has `geometry.usdc` and `materials.usda` as sublayers. A .usdz is one layer: ARKit takes no package whose root layer refers to others, and
three.js reads neither payloads nor sublayers of binary layers.

The prims of the first variant of `geo` are ordinary prims, and each further variant deactivates them and has prims of its own. Readers that
do not know variants therefore see the first one, and nothing twice. The variants of `look` bind one material each. A variant of `light`
refers to the layer `<stem>_lights/<variant>.usda`, and the default, `off`, to none, so that an asset brings no lights into a scene. ARKit
knows no lights: those of a .usdz are layers beside it alone.

Source: OpenUSD: UsdVariantSet, UsdModelAPI (kind, assetInfo), UsdGeomModelAPI (extentsHint), LIVERPS strength ordering (an opinion in a
variant is weaker than one beside it, so that what variants change is stated in variants alone).
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from anyascii import anyascii
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdLux, UsdShade

from service.asset.usd.files import check_suffix
from service.requests.export import FIRST_VERSION
from stage.capture.camera import Camera

NAMELESS = "Asset"
"""Name of a prim whose text holds no letter and no digit."""


def prim_name(text: str) -> str:
    """Return a valid prim name that keeps the words of a text, which may be in any script.

    Whatever is no letter and no digit separates words, which are joined by _. Only the root prim of an asset is named after a text, so that
    the name needs to differ from no other.
    """
    words = re.findall(r"[A-Za-z0-9_]+", anyascii(text))
    name = "_".join(words).strip("_") or NAMELESS
    return f"_{name}" if name[0].isdigit() else name


GEO, LOOK, LIGHT = "geo", "look", "light"
"""The variant sets."""

CAMERA_FRAME = "Camera frame: +x right, +y up, +z towards the viewer. Where it comes from is in customLayerData."
"""The end of the documentation of layers."""
FRAME_RATE = 24.0
"""Time codes, which are frame numbers, a second."""

PAYLOAD, GEOMETRY, MATERIALS = "payload.usda", "geometry.usdc", "materials.usda"
"""Layers of a .usda or .usdc asset beside its interface: the same files whatever the suffix, so that a .usda and a .usdc can share them."""
LAYER_FILES = (PAYLOAD, GEOMETRY, MATERIALS)
LIGHT_OFF, RIG, ENVIRONMENT = "off", "rig", "environment"
"""The variants of `light`; the layer of each but the first is named after it."""

LPE_TAG = "inputs:karma:light:lpetag"
"""The tag of a light in Karma's light path expressions."""

PURPOSES = [UsdGeom.Tokens.default_, UsdGeom.Tokens.render, UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide]
"""All of them: extents hold the geometry of every purpose."""


class Description(NamedTuple):
    """Metadata that the layers of an asset store."""

    name: str  # free text; the root prim is named after it
    camera: Camera | None  # its world_from_camera becomes the root's transform; None: the asset is in the world frame
    provenance: Mapping[str, str]  # kept in assetInfo, and in customLayerData of every layer, with the camera
    unit_m: float = 1.0  # metres of a scene unit
    version: str = FIRST_VERSION  # of the asset, for assetInfo


class AssetLayers:
    """The USD stages on which an asset is defined; one and the same for a .usdz.

    Attributes:
        geometry: the stage for everything below `geom`, for cameras and lights.
        materials: the stage for everything below `looks`.
        root: path of the root prim, /Name.
        packed: whether the asset becomes a package, a .usdz.
        texture_folder: of the textures, relative to the layer of the materials.
        lights: temporary folder of the layers of lights and their textures.
        light_files: the layers of lights.
    """

    def __init__(self, folder: Path, target: Path, description: Description) -> None:
        """Create empty layers in a temporary folder, which become the target."""
        self._description = description
        self.packed = check_suffix(target) == ".usdz"
        self._interface_file = folder / f"{target.stem}{'.usdc' if self.packed else target.suffix.lower()}"
        self._identifier = target.name
        self.root = Sdf.Path.absoluteRootPath.AppendChild(prim_name(description.name))
        self._interface = self._create(self._interface_file)
        if self.packed:
            self.files: tuple[Path, ...] = (self._interface_file,)
            self.geometry = self.materials = self._interface
        else:
            layers = folder / f"{target.stem}_layers"
            layers.mkdir()
            self.files = (self._interface_file, *(layers / file for file in LAYER_FILES))
            self.geometry, self.materials = self._create(layers / GEOMETRY), self._create(layers / MATERIALS)
        self.texture_folder = f"{'.' if self.packed else '..'}/{texture_folder(target)}"
        self._geometries: list[str] = []
        self._first_prims: list[Sdf.Path] = []
        self._surfaces: list[tuple[str, Sdf.Path]] = []
        self._looks: dict[str, Sdf.Path] = {}
        self._bindings: list[tuple[str, Sdf.Path, Sdf.Path]] = []
        self.lights = folder / light_folder(target)
        self.light_files: list[Path] = []
        self._times: list[float] = []

    @property
    def geom(self) -> Sdf.Path:
        """Path of the scope of the geometry."""
        return self.root.AppendChild("Geom")

    @property
    def looks(self) -> Sdf.Path:
        """Path of the scope of the materials."""
        return self.root.AppendChild("Looks")

    @contextmanager
    def geometry_variant(self, name: str) -> Iterator[Sdf.Path]:
        """Define a variant of `geo` inside the block, on the stage `geometry` and below the yielded path; the first is the default.

        The names of its prims differ from those of other variants.
        """
        UsdGeom.Scope.Define(self.geometry, self.geom)
        self._geometries.append(name)
        if len(self._geometries) == 1:
            yield self.geom
            self._first_prims = [prim.GetPath() for prim in self.geometry.GetPrimAtPath(self.geom).GetAllChildren()]
        else:
            with _in_variant(self.geometry, self.root, GEO, name):
                for path in self._first_prims:
                    self.geometry.OverridePrim(path).SetActive(False)
                yield self.geom

    def add_surface(self, prim: Sdf.Path) -> None:
        """Bind the material of the selected look to a prim; called inside the block of the prim's variant."""
        self._surfaces.append((self._geometries[-1], prim))

    def bind(self, prim: Sdf.Path, material: UsdShade.Material) -> None:
        """Bind a material below `looks` to a prim, whichever look is selected; called inside the block of the prim's variant."""
        self._bindings.append((self._geometries[-1], prim, material.GetPath()))

    def add_look(self, name: str, material: UsdShade.Material) -> None:
        """Make a material, which lies below `looks` on the stage `materials`, a variant of `look`; the first is the default."""
        self._looks[name] = material.GetPath()

    @contextmanager
    def lighting(self, name: str) -> Iterator[Usd.Stage]:
        """Define a variant of `light`, RIG or ENVIRONMENT, inside the block: below `root`, on the yielded stage.

        Its layer lies in `lights` and has the pose of the camera frame, so that it can be opened without the asset.
        """
        self.lights.mkdir(exist_ok=True)
        file = self.lights / f"{name}.usda"
        usd_stage = self._create(file, posed=True)
        yield usd_stage
        describe_lights(usd_stage.GetDefaultPrim())
        usd_stage.Save()
        self.light_files.append(file)

    def set_times(self, usd_stage: Usd.Stage, first: float, last: float) -> None:
        """Let a stage, and the asset that it is a part of, reach from one time code to another, both included."""
        if not self.packed or usd_stage == self._interface:
            self._times += [first, last]
        set_time_range(usd_stage, first, last)

    def save(self) -> None:
        """Bind the looks, write variant sets, extents and times, and save the layers; the object is of no use afterwards."""
        for name, material in self._looks.items():
            for geometry, surface in self._surfaces:
                self._bind(geometry, surface, name, material)
        for geometry, prim, material in self._bindings:
            self._bind(geometry, prim, None, material)
        if not self.packed:
            self._write_payload()
        root = self._interface.GetPrimAtPath(self.root)
        for name in self._geometries:
            with _in_variant(self._interface, self.root, GEO, name):
                set_extents_hint(root)
        for name in self._looks:
            root.GetVariantSets().AddVariantSet(LOOK).AddVariant(name)
        lightings = [LIGHT_OFF] if self.light_files and not self.packed else []
        for file in self.light_files if lightings else ():
            root.GetVariantSets().AddVariantSet(LIGHT).AddVariant(LIGHT_OFF)
            lightings.append(file.stem)
            with _in_variant(self._interface, self.root, LIGHT, file.stem):
                root.GetReferences().AddReference(f"./{file.parent.name}/{file.name}")
        for variant_set, variants in ((GEO, self._geometries), (LOOK, [*self._looks]), (LIGHT, lightings)):
            if variants:
                root.GetVariantSets().GetVariantSet(variant_set).SetVariantSelection(variants[0])
        if self._times:
            set_time_range(self._interface, min(self._times), max(self._times))
        self._interface.Save()
        del self.geometry, self.materials, self._interface

    def _bind(self, geometry: str, surface: Sdf.Path, look: str | None, material: Sdf.Path) -> None:
        """Bind a material, if a look is given in its variant of `look`, which is nested in the variant of `geo` that the surface is in."""
        with ExitStack() as variants:
            if geometry != self._geometries[0]:
                variants.enter_context(_in_variant(self.materials, self.root, GEO, geometry))
            if look is not None:
                variants.enter_context(_in_variant(self.materials, self.root, LOOK, look))
            prim = self.materials.OverridePrim(surface)
            UsdShade.MaterialBindingAPI.Apply(prim).Bind(UsdShade.Material(self.materials.GetPrimAtPath(material)))

    def _write_payload(self) -> None:
        """Save the layers of the payload, and refer to them."""
        self.geometry.Save()
        self.materials.Save()
        payload = self._create(self.files[1 + LAYER_FILES.index(PAYLOAD)])
        payload.GetRootLayer().subLayerPaths = [f"./{MATERIALS}", f"./{GEOMETRY}"]
        payload.Save()
        root = self._interface.GetPrimAtPath(self.root)
        root.GetPayloads().AddPayload(f"./{self.files[1].parent.name}/{PAYLOAD}")

    def _create(self, file: Path, *, posed: bool = False) -> Usd.Stage:
        """Return a new stage with axes, unit, default prim and provenance; the root prim of the interface says what the asset is.

        The root prim of the interface has the pose of the camera frame in any case, others if they are posed.
        """
        description = self._description
        usd_stage: Usd.Stage = Usd.Stage.CreateNew(str(file))
        camera = {} if description.camera is None else {"relit:camera": description.camera.model_dump_json()}
        root = define_root(usd_stage, self.root, unit_m=description.unit_m, provenance={**description.provenance, **camera}, documentation=(
            f"{description.name}: a measured surface, exported by Relit. {CAMERA_FRAME}"))
        if file == self._interface_file:
            describe_root(root, name=description.name, identifier=self._identifier, version=description.version,
                          provenance=description.provenance)
        pose = None if description.camera is None else description.camera.world_from_camera
        if (posed or file == self._interface_file) and pose is not None:
            root.AddTransformOp().Set(pose_matrix(pose, description.unit_m))
        return usd_stage


def define_root(usd_stage: Usd.Stage, path: Sdf.Path, *, unit_m: float = 1.0, provenance: Mapping[str, str] | None = None,
                documentation: str | None = None) -> UsdGeom.Xform:
    """Define the default prim of a layer, and say what the layer's axes and unit are, what it is and where it comes from."""
    UsdGeom.SetStageUpAxis(usd_stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(usd_stage, unit_m)
    root = UsdGeom.Xform.Define(usd_stage, path)
    usd_stage.SetDefaultPrim(root.GetPrim())
    if documentation is not None:
        usd_stage.GetRootLayer().documentation = documentation
    for key, value in sorted((provenance or {}).items()):
        usd_stage.SetMetadataByDictKey("customLayerData", key, value)
    return root


def set_extents_hint(root: Usd.Prim) -> None:
    """Write the bounding boxes of what lies below a prim, so that viewers know them before they load it."""
    model = UsdGeom.ModelAPI.Apply(root)
    model.SetExtentsHint(model.ComputeExtentsHint(UsdGeom.BBoxCache(Usd.TimeCode.Default(), PURPOSES)))


def describe_root(root: UsdGeom.Xform, *, name: str, identifier: str, version: str, provenance: Mapping[str, str]) -> None:
    """Write kind, assetInfo with the provenance, and the name for people on the root prim of an asset; the identifier is its file's name.

    The provenance is kept in assetInfo too, because customLayerData is not seen through a reference.
    """
    model = Usd.ModelAPI(root.GetPrim())
    model.SetKind(Kind.Tokens.component)
    model.SetAssetName(name)
    model.SetAssetIdentifier(Sdf.AssetPath(identifier))
    model.SetAssetVersion(version)
    for key, value in sorted(provenance.items()):
        root.GetPrim().SetAssetInfoByKey(key, value)
    if name and name != root.GetPrim().GetName():
        root.GetPrim().SetDisplayName(name)


def describe_lights(root: Usd.Prim) -> None:
    """Make the layer of a root prim with lights a light library: a component with a list and a collection of its lights, for light mixers.

    Each light has an exposure, which is not animated as its intensity may be, and the tag by which Karma splits the picture into layers.

    Source: OpenUSD, UsdLuxLightListAPI; SideFX, Solaris, Light Mixer and LPE Tag (the attribute's name since Houdini 20).
    """
    lights = [prim for prim in Usd.PrimRange(root) if prim.HasAPI(UsdLux.LightAPI)]
    for prim in lights:
        UsdLux.LightAPI(prim).CreateExposureAttr(0.0)
        prim.CreateAttribute(LPE_TAG, Sdf.ValueTypeNames.String, custom=True).Set(prim.GetName())
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    paths = [prim.GetPath() for prim in lights]
    UsdLux.LightListAPI.Apply(root).StoreLightList(paths)
    collection = Usd.CollectionAPI.Apply(root, "lights")
    collection.CreateExpansionRuleAttr(Usd.Tokens.explicitOnly)
    collection.CreateIncludesRel().SetTargets(paths)


def light_folder(target: Path) -> str:
    """Return the name of the folder beside an asset that holds its lights."""
    return f"{target.stem}_lights"


def texture_folder(target: Path) -> str:
    """Return the name of the folder beside an asset, or in its package, that holds its textures."""
    return f"{target.stem}_textures"


@contextmanager
def _in_variant(usd_stage: Usd.Stage, root: Sdf.Path, variant_set: str, name: str) -> Iterator[None]:
    """Write what is authored inside the block into a variant, which is selected meanwhile; the layer's own selection stays."""
    variants = usd_stage.GetPrimAtPath(root).GetVariantSets().AddVariantSet(variant_set)
    variants.AddVariant(name)
    session = usd_stage.GetSessionLayer()
    with Usd.EditContext(usd_stage, session):
        variants.SetVariantSelection(name)
    with variants.GetVariantEditContext():
        yield
    with Usd.EditContext(usd_stage, session):
        variants.ClearVariantSelection()


def set_time_range(usd_stage: Usd.Stage, first: float, last: float, frames_per_second: float = FRAME_RATE) -> None:
    """Let a stage reach from one time code to another, both included."""
    usd_stage.SetStartTimeCode(first)
    usd_stage.SetEndTimeCode(last)
    usd_stage.SetTimeCodesPerSecond(frames_per_second)
    usd_stage.SetFramesPerSecond(frames_per_second)


def pose_matrix(world_from_camera: tuple[tuple[float, ...], ...], unit_m: float) -> Gf.Matrix4d:
    """Return a column-vector transform in metres as USD's row-vector transform in scene units."""
    matrix = np.array(world_from_camera, dtype=np.float64)
    matrix[:3, 3] /= unit_m
    return Gf.Matrix4d(*matrix.T.ravel().tolist())

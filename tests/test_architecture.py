"""The layers of the packages, read from the imports of every module."""

import ast
import re
import sys
from contextlib import suppress
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

HOME = Path(__file__).resolve().parents[1]
ROOTS = ("stage", "kernels", "service")
PRODUCTS = tuple(f"service.{name}" for name in (
    "solve", "depth", "boards", "relight", "calibrate", "light_estimation", "basis", "captures", "demo", "export", "viewing", "joining",
    "scans", "sequences", "sharing", "play", "twin", "drive", "rigs", "acquisition", "publish", "comparison"))
"""Where stage and kernels meet: captures go in, results come out."""
WRITERS = ("service.asset",)
"""Meshes and textures of solved maps, and the formats that they are written in."""
DOORS = ("service.cli", "service.client", "service.farm", "service.server")


class Import(NamedTuple):
    """One name that one module takes from another."""

    importer: str
    target: str
    """The module, or module.name for `from module import name`."""
    lazy: bool
    """Inside a function: when it is called, not when the module is loaded."""


def module_name(path: Path) -> str:
    parts = path.relative_to(HOME).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imports_of(path: Path) -> list[Import]:
    found = []

    def visit(node: ast.AST, lazy: bool) -> None:
        if isinstance(node, ast.Import):
            found.extend(Import(module_name(path), alias.name, lazy) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.extend(Import(module_name(path), f"{node.module}.{alias.name}", lazy) for alias in node.names)
        inside = lazy or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for field in ("body", "orelse", "handlers", "finalbody", "cases"):  # imports are statements, which stand in no expression
            for child in getattr(node, field, ()) if not isinstance(node, ast.expr) else ():
                visit(child, inside)

    visit(tree_of(path), False)
    return found


IN_BLENDER = HOME / "service" / "blender" / "extension"
"""The modules that run in Blender, as a package of its own: it imports itself relatively, and nothing of Relit."""
FILES = {module_name(path): path for root in ROOTS for path in sorted((HOME / root).rglob("*.py")) if path.parent != IN_BLENDER}


@cache
def imports() -> tuple[Import, ...]:
    """All of them, read when a test asks: every process of a run loads this file, and one runs it."""
    return tuple(found for path in FILES.values() for found in imports_of(path))


def under(name: str, *packages: str) -> bool:
    return any(name == package or name.startswith(f"{package}.") for package in packages)


def top(name: str) -> str:
    return name.partition(".")[0]


def test_the_imports_are_read():
    """If this fails, the others prove nothing."""
    assert len(FILES) > 60
    assert Import("service.solve.solve", "stage.capture.capture.Capture", False) in imports()
    assert Import("service.cli.commands.captures", "service.solve.solve.solve", True) in imports()
    assert any(i.importer == "kernels.device" and i.target == "warp" for i in imports())


@pytest.mark.parametrize(("layer", "allowed"), [
    ("stage", {"stage", "numpy", "scipy", "pydantic", "OpenEXR", "OpenImageIO", "PyOpenColorIO", "cv2", "gerbonara", "laspy", "pye57",
               "rawpy"}),
    ("kernels", {"kernels", "numpy", "warp"}),
])
def test_a_layer_imports_only_its_own_libraries(layer, allowed):
    """So stage and kernels import neither each other nor service, and stage does not import Warp."""
    others = {i for i in imports() if top(i.importer) == layer and top(i.target) not in allowed | sys.stdlib_module_names}
    assert not others


@pytest.mark.parametrize(("library", "homes"), [
    ("pxr", ["service.asset.usd"]), ("pygltflib", ["service.asset.gltf"]), ("typer", ["service.cli"]), ("rich", ["service.cli"]),
    ("fastapi", ["service.server.api", "service.server.pages", "service.twin.twin", "service.acquisition.projector",
                 "service.acquisition.set_routes"]),
    ("sacn", ["service.play.sacn_output"]),
    ("serial", ["service.acquisition.lights.serial_line"]), ("gphoto2", ["service.acquisition.cameras"]),
    ("pygdtf", ["service.rigs.gdtf"]), ("pymvr", ["service.rigs.mvr"]),
    ("stupidArtnet", ["service.play.artnet_output"]), ("jinja2", ["service.server.pages"]), ("dbos", ["service.server.jobs"]),
    ("laspy", ["stage.formats.las"]), ("pye57", ["stage.formats.e57"]),
    ("small_gicp", ["service.scans.points.neighbours"]), ("gerbonara", ["stage.formats.gerber"]), ("rawpy", ["stage.formats.camera_raw"]),
    ("fast_simplification", ["service.asset.content.levels_of_detail", "service.asset.content.uv_unwrap"]),
    ("xatlas", ["service.asset.content.uv_unwrap"]),
    ("MaterialX", ["service.asset.content.openpbr"]),
])
def test_a_library_lives_in_its_places(library, homes):
    assert {i.importer for i in imports() if top(i.target) == library and not under(i.importer, *homes)} == set()


def test_opencv_lives_where_motion_is_tracked_rigs_calibrated_distances_measured_and_avif_camera_raw_and_video_decoded():
    allowed = ("stage.motion", "service.calibrate.solvers", "service.calibrate.stereo", "stage.results.mask_border", "stage.formats.avif",
               "stage.formats.camera_raw", "stage.importers", "service.scans.registration.found_targets",
               "service.acquisition.cameras.video_device", "service.acquisition.cameras.aravis_camera")
    assert {i.importer for i in imports() if top(i.target) == "cv2" and not under(i.importer, *allowed)} == set()


@pytest.mark.parametrize(("package", "forbidden"), [
    *((product, DOORS) for product in (*PRODUCTS, "service.requests", "service.reporting")),
    ("service.requests", (*PRODUCTS, *WRITERS, "service.reporting", "kernels")),
    ("service.asset", (*DOORS, *PRODUCTS, "kernels")),
    ("service.asset.content", ("service.asset.usd", "service.asset.gltf")),
    ("service.asset.usd", ("service.asset.gltf",)),
    ("service.asset.gltf", ("service.asset.usd",)),
    ("service.server.jobs", ("service.cli", "service.client", "service.server.api")),
    ("service.server.database", ("service.server.jobs", "service.server.api", *PRODUCTS, "stage", "kernels")),
    ("service.server.storage", ("service.server.jobs", "service.server.api", *PRODUCTS, "kernels")),
    ("service.server.api", ("service.cli", "service.client", *PRODUCTS, *WRITERS, "kernels")),
    ("service.server.pages", ("service.cli", "service.client", "service.server.api", "service.server.database", "service.server.jobs",
                              "service.server.storage", *PRODUCTS, *WRITERS, "stage", "kernels")),
    ("service.client", ("service.cli", "service.farm", "service.server", *PRODUCTS, *WRITERS, "stage", "kernels")),
    ("service.requests.answers", (*DOORS, *PRODUCTS, *WRITERS, "service.reporting", "stage", "kernels")),
])
def test_what_a_part_of_the_roof_must_not_know(package, forbidden):
    assert {i for i in imports() if under(i.importer, package) and under(i.target, *forbidden)} == set()


def test_stage_and_kernels_meet_in_products_alone():
    """service.errors is the table of what either may raise, and takes no more from kernels than that."""
    of_stage, of_kernels = ({i.importer for i in imports() if top(i.target) == layer} for layer in ("stage", "kernels"))
    assert {name for name in of_stage & of_kernels if not under(name, *PRODUCTS)} <= {"service.errors"}
    taken = {i.target for i in imports() if i.importer == "service.errors" and top(i.target) == "kernels"}
    assert taken == {"kernels.errors.KernelError"}


def test_the_command_line_knows_kernels_and_warp_lightly():
    """relit doctor runs a kernel and relit kernels compiles them, which is the installation and no product, and --device asks which devices
    there are; they may, when they are called."""
    knowing = {i for i in imports() if under(i.importer, "service.cli") and top(i.target) in ("kernels", "warp")}
    assert all(i.lazy for i in knowing)
    assert {i.importer for i in knowing} <= {"service.cli.commands.doctor", "service.cli.request_commands"}


def test_the_roof_outside_the_products_knows_no_warp():
    assert {i for i in imports() if top(i.importer) == "service" and top(i.target) == "warp"
            and not under(i.importer, *PRODUCTS)} == set()


def test_no_module_takes_a_private_name_of_another():
    """Above all no solver another solver's."""
    def private(name: str) -> bool:
        return name.startswith("_") and not name.startswith("__")

    assert {i for i in imports() if top(i.target) in ROOTS and private(i.target.rpartition(".")[2])} == set()
    reached = []
    for name, path in FILES.items():
        text = path.read_text(encoding="utf-8")
        if not re.search(r"\w\._[a-z]", re.sub(r"\b(self|cls)\._", "", text)):  # few files need to be looked through
            continue
        nodes = list(ast.walk(tree_of(path)))
        modules = {alias.asname or alias.name for node in nodes
                   if isinstance(node, ast.ImportFrom) and node.module and top(node.module) in ROOTS
                   for alias in node.names if f"{node.module}.{alias.name}" in FILES}
        reached += [f"{name}: {node.value.id}.{node.attr}" for node in nodes
                    if isinstance(node, ast.Attribute) and private(node.attr)
                    and isinstance(node.value, ast.Name) and node.value.id in modules]
    assert reached == []


def test_nothing_lies_loose_in_the_root_of_the_service():
    assert {path.name for path in (HOME / "service").glob("*.py")} == {"__init__.py", "errors.py"}


def package_of(name: str) -> str:
    """Return the package that a module lies in; a package that is imported by its name is itself."""
    return name if FILES[name].name == "__init__.py" else name.rpartition(".")[0]


def module_of(target: str) -> str | None:
    """Return the module that an import loads, or None for another library's."""
    return next((name for name in (target, target.rpartition(".")[0]) if name in FILES), None)


def check_acyclic(edges):
    """Fail with a circle among these pairs of an importer and what it imports."""
    graph: dict[str, set[str]] = {}
    for one, other in edges:
        if one != other:
            graph.setdefault(one, set()).add(other)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


@pytest.mark.parametrize("depth", [2, 3, 9])
def test_packages_have_no_cycles(depth):
    """Neither products (service.solve …) nor the rooms in them import each other in a circle, not even when a function is called."""
    def room(name):
        return ".".join(package_of(name).split(".")[:depth])

    check_acyclic((room(found.importer), room(target)) for found in imports() if (target := module_of(found.target)) is not None)


def test_no_private_module_is_imported_from_another_package():
    private = {(found.importer, target) for found in imports() if (target := module_of(found.target)) is not None
               and target.rpartition(".")[2].startswith("_") and FILES[target].name != "__init__.py"
               and package_of(target) != package_of(found.importer)}
    assert private == set()


def test_no_folder_holds_more_files_than_a_newcomer_can_scan():
    files: dict[Path, int] = {}
    for path in FILES.values():
        if path.name != "__init__.py" and "migrations" not in path.parts:
            files[path.parent] = files.get(path.parent, 0) + 1
    assert {str(folder.relative_to(HOME)): count for folder, count in files.items() if count > 24} == {}


def test_no_cycles():
    """No module imports itself, by way of others, as it is loaded."""
    check_acyclic((found.importer, target) for found in imports() if not found.lazy and (target := module_of(found.target)) is not None)


def loaded_names(path: Path) -> set[str]:
    """Return what the statements of a module bind when it is loaded."""
    found, left = set(), list(tree_of(path).body)
    while left:
        node = left.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.alias):
            found.add(node.asname or top(node.name))
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
        elif not isinstance(node, ast.Lambda):
            left += ast.iter_child_nodes(node)
    return found


def test_every_import_of_our_own_names_what_is_there():
    """Also those of tests and benchmarks that few runs load, and of programs in strings."""
    own = (*ROOTS, "tests", "benchmarks", "samples")
    homes = "|".join(own)
    files = {module_name(path): path for home in own for path in sorted((HOME / home).rglob("*.py"))}
    texts = {name: path.read_text(encoding="utf-8").replace(r"\n", "\n") for name, path in files.items()}
    modules = {name.rsplit(".", parts)[0] for name in files for parts in range(name.count(".") + 1)} | files.keys()

    @cache
    def there(module: str, name: str) -> bool:
        if f"{module}.{name}" in modules or module not in files:
            return f"{module}.{name}" in modules
        plain = re.search(rf"^(?:(?:async )?def |class )?{name}\b", texts[module], re.MULTILINE)  # few files need to be parsed
        return plain is not None or name in loaded_names(files[module])

    missing = []
    for name, text in texts.items():
        missing += [f"{name}: {place}" for place in re.findall(r'"(service\.[\w.]+:\w+)"', text) if not there(*place.split(":"))]
        for found in re.findall(rf"\b(?:from (?:{homes})\b[\w.]* import (?:\([^)]*\)|[\w ,]+)|import (?:{homes})\b[\w. ,]*)", text):
            with suppress(SyntaxError):  # a sentence
                node, = ast.parse(found).body
                if isinstance(node, ast.ImportFrom):
                    missing += [f"{name}: {node.module}.{one.name}" for one in node.names if not there(str(node.module), one.name)]
                elif isinstance(node, ast.Import):
                    missing += [f"{name}: {one.name}" for one in node.names if top(one.name) in own and one.name not in modules]
    assert missing == []


def test_references_judge_without_what_they_judge():
    for path in sorted((HOME / "tests" / "reference").glob("*.py")):
        assert not {i.target for i in imports_of(path) if top(i.target) in ROOTS}, path.name


def test_a_text_and_a_type_of_fields_stand_in_one_module():
    """No two modules of stage and service give one name the same text, Annotated type or Spelling."""
    found: dict[tuple[str, str], set[str]] = {}
    for name, path in FILES.items():
        for node in tree_of(path).body if top(name) != "kernels" else ():
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and not node.targets[0].id.startswith("__"):
                text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
                annotated = isinstance(node.value, ast.Subscript) and ast.unparse(node.value.value) == "Annotated"
                spelling = isinstance(node.value, ast.Call) and ast.unparse(node.value.func) == "Spelling"
                if text or annotated or spelling:
                    found.setdefault((node.targets[0].id, ast.unparse(node.value)), set()).add(name)
    assert {name: modules for name, modules in found.items() if len(modules) > 1} == {}


def test_arrays_of_devices_are_read_by_to_numpy_alone():
    """Warp's own `numpy()` changes the device's stream for all threads (kernels.device.to_numpy says what comes of it)."""
    found = {str(path.relative_to(HOME)) for root in ("kernels", "service") for path in sorted((HOME / root).rglob("*.py"))
             if ".numpy" in path.read_text(encoding="utf-8")
             for node in ast.walk(tree_of(path)) if isinstance(node, ast.Attribute) and node.attr == "numpy"}
    assert found == {"kernels/device.py", "kernels/images.py"}  # the second reads its own pinned memory of the host

"""Routes of the pages. A page holds nothing of a project: its modules ask the API for that, with the key of the person who looks.

Pages load nothing from another server: the content security policy allows scripts, styles and connections of this origin alone.
"""

import base64
import hashlib
import json
import posixpath
import re
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi import Path as PathParameter
from fastapi.staticfiles import StaticFiles
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from starlette.types import Scope

from service import __version__
from service.requests.base.identifiers import CAPTURE, JOB, CaptureId, JobId, pattern
from service.requests.base.import_choices import Layout
from service.requests.jobs import JOBS
from service.server.pages.forms import CAPTURE_JOBS, FREE_JOBS, MAPS_JOBS, NEXT_STEPS, TITLES, Form, form_of, import_fields

HOME = Path(str(files("service.server.pages")))
SHARED = Path(str(files("service.publish"))) / "static"
"""Modules that published pages have too."""
LOADED = sorted(path for folder in (HOME / "static", SHARED) for path in folder.rglob("*.*") if path.is_file())
VERSION = hashlib.sha256(b"".join(path.read_bytes() for path in LOADED)).hexdigest()[:12]
STATIC = f"/static/v-{VERSION}"
"""The address of the files that pages load. It changes with them, so that a browser keeps them without asking again."""
THREE = f"{STATIC}/vendor/three"
IMPORT_MAP = json.dumps({"imports": {"three": f"{THREE}/three.module.js", "three/addons/": f"{THREE}/addons/"}})
"""The places where modules find three.js, which is vendored."""
IMPORT_MAP_HASH = base64.b64encode(hashlib.sha256(IMPORT_MAP.encode()).digest()).decode()
HEADERS = {
    "Content-Security-Policy": "; ".join([
        "default-src 'none'", f"script-src 'self' 'sha256-{IMPORT_MAP_HASH}'", "style-src 'self'", "img-src 'self' blob: data:",
        "connect-src 'self' blob:", "form-action 'none'", "frame-ancestors 'none'", "base-uri 'none'"]),
    "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-cache",
}
"""Headers of every page. Loaders of three.js read textures through blob: addresses, which they make themselves."""

IMPORT = re.compile(r'^import (?:[^"]* from )?"(\.[^"]+)"', re.MULTILINE)
"""An import of a module by its relative address."""
NAVIGATION = [("/", "Home"), ("/captures", "Captures"), ("/jobs", "Jobs"), ("/machines", "Machines")]
"""Addresses and names of the pages in the header."""

router = APIRouter(include_in_schema=False)
set_router = APIRouter(include_in_schema=False)
"""The page of the stage at this machine, where there is one."""
JobKind = Annotated[str, PathParameter(pattern=f"^({'|'.join(TITLES)})$")]
templates = Environment(loader=FileSystemLoader(HOME / "templates"), autoescape=select_autoescape(), undefined=StrictUndefined,
                        trim_blocks=True, lstrip_blocks=True)
templates.globals.update(version=__version__, static=STATIC, titles=TITLES, import_map=IMPORT_MAP, navigation=NAVIGATION)
templates.globals.update({name: getattr(templates.get_template("parts.html").module, name) for name in ("icon", "skeleton")})


class StaticModules(StaticFiles):
    """The files that pages load; a browser keeps those of this version, and asks about others each time."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return a file, with headers that forbid a guess of its type and say how long it may be used."""
        response = await super().get_response(path, scope)
        kept = "max-age=31536000, immutable" if scope["path_params"].get("version") == VERSION else "no-cache"
        response.headers.update({"Cache-Control": kept, "X-Content-Type-Options": "nosniff"})
        return response


def install(app: FastAPI) -> None:
    """Add the pages and their files to the app."""
    app.include_router(router)
    for address in ("/static/v-{version}", "/static"):  # a page of another version gets what there is now
        for below, folder in (("/publish", SHARED), ("", HOME / "static")):
            app.mount(f"{address}{below}", StaticModules(directory=folder))


@cache
def modules_of(module: str) -> tuple[str, ...]:
    """Return the addresses of a module and of all that it imports at once, which a page names so that a browser asks for them together."""
    found = [f"{STATIC}/{module}"]
    for each in found:  # grows
        below = each.removeprefix(f"{STATIC}/")
        text = (SHARED / below.removeprefix("publish/") if below.startswith("publish/") else HOME / "static" / below).read_text()
        named = (posixpath.normpath(posixpath.join(posixpath.dirname(each), name)) for name in IMPORT.findall(text))
        found += [name for name in dict.fromkeys(named) if name not in found]
    return tuple(found)


templates.globals.update(modules_of=modules_of, next_steps=NEXT_STEPS)


def _add_page(address: str, template: str, *, to: APIRouter = router) -> None:
    """Add a page whose modules ask the API for all that they show."""
    @to.get(address)
    async def page(request: Request) -> Response:
        return _page(request, template)


def _add_page_of(kind: str, prefix: str, address: str, template: str) -> None:
    """Add such a page of one capture or job, whose identifier ends its address; `kind` is the word for it."""
    @router.get(f"{address}/{{{kind}}}")
    async def page(request: Request, identifier: Annotated[str, PathParameter(alias=kind, pattern=pattern(prefix))]) -> Response:
        return _page(request, template, identifier=identifier)


_add_page("/", "home.html")  # captures, assets and environments as cards, and the jobs above them
_add_page("/captures", "captures.html")  # captures and environments, and new ones
_add_page("/machines", "machines.html")  # for an operator: the workers, what waits for them, the space left, and who did what
_add_page("/set", "set.html", to=set_router)  # takes captures at the stage of this machine
_add_page_of("capture", CAPTURE, "/light", "light.html")  # relit live
_add_page_of("capture", CAPTURE, "/object", "object.html")  # what was captured and what was made of it, as modes of one view
_add_page_of("job", JOB, "/maps", "maps.html")  # the maps that it has solved or decoded
_add_page_of("job", JOB, "/asset", "asset.html")  # the asset that it has exported
_add_page_of("job", JOB, "/drive", "drive.html")  # the levels of the lamps that it has driven


@router.get("/captures/{capture}")
async def capture(request: Request, capture: CaptureId) -> Response:
    """Show a capture and its lights, and the forms of the jobs that begin with it."""
    forms: dict[str, list[Form]] = {"Make something else": [], "Calibrate": []}
    for kind, model in CAPTURE_JOBS.items():
        forms["Calibrate" if kind.startswith("calibrate-") else "Make something else"].append(form_of(kind, model))
    return _page(request, "capture.html", identifier=capture, forms=forms)


@router.get("/import-form/{layout}")
async def import_form(request: Request, layout: Layout) -> Response:
    """Return the controls of an import, which the page of captures shows beside what files seem to be."""
    return _page(request, "import_form.html", fields=import_fields(layout))


@router.get("/jobs")
async def jobs(request: Request) -> Response:
    """Show the jobs as they change, and the forms of the jobs that begin with neither a capture nor maps."""
    return _page(request, "jobs.html", forms=[form_of(kind, model) for kind, model in FREE_JOBS.items()])


@router.get("/jobs/{job}")
async def job(request: Request, job: JobId) -> Response:
    """Show a job and its results, and the forms of the jobs that begin with its maps."""
    return _page(request, "job.html", identifier=job, forms=[form_of(kind, model) for kind, model in MAPS_JOBS.items()])


@router.get("/forms/{kind}")
async def form_words(kind: JobKind) -> list[dict[str, Any]]:
    """Return how the form of a kind of job names its fields, for pages that show a request: places in the JSON, label, default as typed."""
    form = form_of(kind, JOBS[kind])
    return [{"paths": field.paths, "label": field.label, "default": field.default} for field in (*form.main, *form.more)]


def wants_page(request: Request) -> bool:
    """Return whether a browser goes to an address, and so is answered with a page; a program names no HTML among what it accepts."""
    return request.method in ("GET", "HEAD") and "text/html" in request.headers.get("Accept", "")


def fault_page(request: Request, status: int, title: str, detail: str) -> Response:
    """Return a page that says in one sentence why there is nothing else to show."""
    sentence = f"{detail[:1].upper()}{detail[1:]}".rstrip(".") + "."
    page = _page(request, "fault.html", title=title, sentence=sentence, status=status, request_id=getattr(request.state, "request_id", ""))
    page.status_code = status
    return page


@router.get("/favicon.ico")
async def icon(request: Request) -> Response:
    """Return the icon, which browsers ask for at this place."""
    return Response((HOME / "static" / "icon.svg").read_bytes(), media_type="image/svg+xml", headers={"X-Content-Type-Options": "nosniff"})


def _page(request: Request, template: str, **values: Any) -> Response:
    text = templates.get_template(template).render(has_stage=request.app.state.has_stage, here=request.url.path, **values)
    return Response(text, media_type="text/html", headers=HEADERS)

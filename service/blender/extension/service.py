"""A service of Relit over HTTP: captures uploaded by tus 1.0, jobs and their events, results; docs/service.md of Relit.

Source: https://tus.io/protocols/resumable-upload; https://html.spec.whatwg.org/multipage/server-sent-events.html
"""

import hashlib
import http.client
import json
import shutil
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from base64 import b64encode
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from .tasks import Cancelled, Failure, Task

TUS = {"Tus-Resumable": "1.0.0"}
PIECE_BYTES = 8 << 20
SILENCE_S = 45
"""A connection without a byte for this long is given up: streams of events have at least a comment every 15 s."""
JOB_FILE = "relit_job.json"
"""Beside the maps that a service has solved: which job they are of."""


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Refuses to be sent elsewhere, where the key would be sent too."""

    def redirect_request(self, *given: object) -> None:
        """Return nothing, with which the answer becomes an error."""


OPENER = urllib.request.build_opener(_NoRedirect)


class Service:
    """What the extension asks of Relit, done by a service."""

    def __init__(self, url: str, key: str) -> None:
        self._url, self._key = url.rstrip("/"), key

    def solve(self, capture: Path, out: Path, environment: Path | None, levels: int, task: Task) -> Path:
        """Solve a capture, export its asset with its rig, and fetch maps and asset into the folder `out`; return the asset."""
        rig = self._upload("captures", capture, task)
        sky = None if environment is None else self._upload("environments", environment, task)
        maps = self._job({"kind": "solve", "capture": rig}, task)
        asset = {"kind": "export", "maps": maps, "rig": rig, "format": "usda", "options": {"levels": levels}}
        job = self._job(asset | ({} if sky is None else {"environment": sky}), task)
        self._download(maps, out / "maps", task)
        (out / "maps" / JOB_FILE).write_text(json.dumps({"service": self._url, "job": maps}), encoding="utf-8")
        self._download(job, out, task)
        return out / "asset.usda"

    def relight(self, capture: Path, maps: Path | None, keys: dict, environment: Path | None, frames: range, out: Path, task: Task) -> None:
        """Relight a frame range; `out` has #### for the number of a frame."""
        request = {"kind": "relight", "capture": self._upload("captures", capture, task), "keys": keys,
                   "options": {"frames": f"{frames[0]}-{frames[-1]}", "color_space": "lin_rec709_scene"}}
        if maps is not None:
            request["maps"] = self._job_of(maps)
        if environment is not None:
            if "#" in environment.name:
                raise Failure("the world is animated, and a service takes one environment for all frames: use the program relit")
            request["environment"] = self._upload("environments", environment, task)
        self._download(self._job(request, task), out.parent, task)

    def shade(self, maps: Path, lights: dict, environment: Path | None, out: Path, task: Task) -> None:
        """Shade solved maps once, under near lights as options of `relit shade` name them."""
        named = {kind: [{name: value[0] if name == "radius_m" else value for name, value in light.items()} for light in several]
                 for kind, several in lights.items()}
        request = {"kind": "shade", "maps": self._job_of(maps), "options": named | {"color_space": "lin_rec709_scene"}}
        if environment is not None:
            request["environment"] = self._upload("environments", environment, task)
        self._download(self._job(request, task), out.parent, task, {"picture.exr": out.name})

    def _job_of(self, maps: Path) -> str:
        """Return the job that solved maps on this service."""
        with suppress(OSError, ValueError, KeyError):
            known = json.loads((maps / JOB_FILE).read_text(encoding="utf-8"))
            if known["service"] == self._url:
                return str(known["job"])
        raise Failure(f"{maps}: this service has not solved these maps: solve the capture with it, or use the program relit")

    def _upload(self, what: str, source: Path, task: Task) -> str:
        """Upload a folder or a file, and wait until it is checked; what the service has already is not sent again."""
        files = [source] if source.is_file() else [
            each for each in sorted(source.rglob("*"))
            if each.is_file() and not any(part.startswith(".") for part in each.relative_to(source).parts)]
        names = [each.name if source.is_file() else each.relative_to(source).as_posix() for each in files]
        sums = []
        for number, each in enumerate(files):
            task.tell(f"reading {source.name}", 100 * number // len(files))
            with open(each, "rb") as opened:
                sums.append(hashlib.file_digest(opened, "sha256").hexdigest())
        token = hashlib.sha256(f"{what}\0{source.name}\0{json.dumps([names, sums])}".encode()).hexdigest()
        found = self._json("POST", f"/v1/{what}", {"name": source.name}, {"Idempotency-Key": token})
        place = f"/v1/{what}/{found['id']}"
        if found["state"] == "receiving":
            for number, (each, name, digest) in enumerate(zip(files, names, sums, strict=True)):
                task.tell(f"sending {source.name}", 100 * number // len(files))
                self._send(place, each, name, digest, task)
            self._json("POST", f"{place}/validate", {})
        while (found := self._json("GET", place))["state"] not in ("ready", "refused"):
            task.tell(f"checking {source.name}", 0)
            time.sleep(0.2)
        if found["state"] == "refused":
            raise Failure(f"{source.name}: {found['problem']}")
        return str(found["id"])

    def _send(self, place: str, path: Path, name: str, digest: str, task: Task) -> None:
        """Send the bytes of a file that the service does not have."""
        metadata = ",".join(f"{word} {b64encode(text.encode()).decode()}" for word, text in (("path", name), ("sha256", digest)))
        size = path.stat().st_size
        token = hashlib.sha256(f"{place}\0{name}\0{digest}".encode()).hexdigest()
        with self._open("POST", f"{place}/files", None, {**TUS, "Upload-Length": str(size), "Upload-Metadata": metadata,
                                                         "Idempotency-Key": token}) as answer:
            upload, offset = urllib.parse.urlsplit(answer.headers["Location"]).path, int(answer.headers["Upload-Offset"])
        with open(path, "rb") as opened:
            while offset < size:
                task.tell(task.stage, task.percent)
                opened.seek(offset)
                with self._open("PATCH", upload, opened.read(PIECE_BYTES), {
                        **TUS, "Upload-Offset": str(offset), "Content-Type": "application/offset+octet-stream"}) as answer:
                    offset = int(answer.headers["Upload-Offset"])

    def _job(self, request: dict, task: Task) -> str:
        """Submit a job, follow its events until it has succeeded, and return its identifier."""
        job = str(self._json("POST", "/v1/jobs", request)["id"])

        def cancel() -> None:
            with suppress(Failure):  # a service that is gone has nothing to cancel
                self._json("POST", f"/v1/jobs/{job}/cancel", {})

        task.stoppable(lambda: threading.Thread(target=cancel, daemon=True).start())
        try:
            for view in self._views(job):
                if view["state"] == "succeeded":
                    return job
                if view["state"] in ("failed", "cancelled"):
                    if task.cancelled:
                        raise Cancelled
                    raise Failure(f"{request['kind']} on the service: {view['error'] or view['state']}")
                if (progress := view["progress"]) and not task.cancelled:
                    task.tell(f"{request['kind']}: {progress['stage']}", 100 * progress["done"] // max(progress["total"], 1))
        finally:
            task.stoppable(None)
        raise AssertionError("views end with the job")

    def _views(self, job: str) -> Iterator[dict]:
        """Yield the job after every change until it has ended, also where its stream of events is cut."""
        while True:
            with suppress(OSError, http.client.HTTPException), self._open("GET", f"/v1/jobs/{job}/events") as stream:
                for line in stream:
                    if line.startswith(b"data:"):
                        yield json.loads(line[5:])
            yield self._json("GET", f"/v1/jobs/{job}")
            time.sleep(0.5)

    def _download(self, job: str, folder: Path, task: Task, names: dict | None = None) -> None:
        """Fetch what a job has made, each file whole or not at all."""
        after = ""
        while after is not None:
            page = self._json("GET", f"/v1/jobs/{job}/results" + (f"?after={urllib.parse.quote(after)}" if after else ""))
            for number, found in enumerate(page["results"]):
                if names is not None and found["name"] not in names:
                    continue
                task.tell("fetching the results", 100 * number // len(page["results"]))
                target = folder / (names[found["name"]] if names is not None else found["name"])
                if not target.resolve().is_relative_to(folder.resolve()):
                    raise Failure(f"the service names a result outside of its folder: {found['name']}")
                target.parent.mkdir(parents=True, exist_ok=True)
                part = target.with_name(f".{target.name}.part")
                try:
                    with self._open("GET", found["url"]) as answer, open(part, "wb") as opened:
                        shutil.copyfileobj(answer, opened)
                    if part.stat().st_size != found["size"]:
                        raise Failure(f"{found['name']}: the service at {self._url} ended in the middle of it: try again")
                    part.replace(target)
                finally:
                    part.unlink(missing_ok=True)
            after = page["next"]

    def _json(self, method: str, path: str, body: dict | None = None, headers: dict | None = None) -> dict:
        data = None if body is None else json.dumps(body).encode()
        with self._open(method, path, data, {"Content-Type": "application/json", **(headers or {})}) as answer:
            return json.load(answer)

    def _open(self, method: str, path: str, data: bytes | None = None, headers: dict | None = None) -> http.client.HTTPResponse:
        key = {"Authorization": f"Bearer {self._key}"} if self._key else {}
        try:
            return OPENER.open(urllib.request.Request(self._url + path, data, {**(headers or {}), **key}, method=method), timeout=SILENCE_S)
        except urllib.error.HTTPError as error:
            try:
                said = json.load(error)
                sentence = said.get("detail") or said["title"]
            except (ValueError, KeyError, AttributeError):
                sentence = f"{error.code} {error.reason}"
            raise Failure(f"the service at {self._url} says: {sentence}") from error
        except (OSError, http.client.HTTPException, ValueError) as error:
            why = getattr(error, "reason", None) or error
            raise Failure(f"the service at {self._url} is not reached ({why}): start it, or correct its address in the preferences of the "
                          "extension") from error

"""A service of Relit over HTTP: captures uploaded by tus 1.0, jobs and their events, results; docs/service.md of Relit.

Source: https://tus.io/protocols/resumable-upload; https://html.spec.whatwg.org/multipage/server-sent-events.html
"""

import hashlib
import http.client
import json
import tempfile
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
import uuid
from base64 import b64encode
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from .tasks import Cancelled, Failure, Task

TUS = {"Tus-Resumable": "1.0.0"}
PIECE_BYTES = 8 << 20
SILENCE_S = 45
"""A connection without a byte for this long is given up: streams of events have at least a comment every 15 s."""
PATIENCE_S = 60
"""A service that does not answer for this long while a job is under way is given up, and the job is cancelled."""
JOB_FILE = "relit_job.json"
"""Beside the maps that a service has solved: which job they are of."""


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Refuses to be sent elsewhere, where the key would be sent too."""

    def redirect_request(self, *given: object) -> None:
        """Return nothing, with which the answer becomes an error."""


OPENER = urllib.request.build_opener(_NoRedirect)


class Unreached(Failure):
    """The service does not answer, or has no time."""


class Missing(Failure):
    """The service does not have what was asked for."""


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
        try:
            found = self._json("POST", f"/v1/{what}", {"name": source.name}, {"Idempotency-Key": token})
        except Missing:  # it was there, and has been deleted since
            found = self._json("POST", f"/v1/{what}", {"name": source.name}, {"Idempotency-Key": uuid.uuid4().hex})
        place = f"/v1/{what}/{found['id']}"
        if found["state"] in ("receiving", "refused"):  # which may be taken now, by another version or with other settings
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
        ended = False
        try:
            for view in self._views(job, task):
                ended = view["state"] in ("succeeded", "failed", "cancelled")
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
            if not ended:
                cancel()
        raise AssertionError("views end with the job")

    def _views(self, job: str, task: Task) -> Iterator[dict]:
        """Yield the job after every change until it has ended, also where its stream of events is cut."""
        silent_since = time.monotonic()
        while True:
            try:
                with suppress(Unreached, OSError, http.client.HTTPException), self._open("GET", f"/v1/jobs/{job}/events") as stream:
                    for line in stream:
                        silent_since = time.monotonic()
                        if line.startswith(b"data:") and line.endswith(b"\n"):  # the last line of a stream that is cut may be a part
                            yield json.loads(line[5:])
                yield self._json("GET", f"/v1/jobs/{job}")
                silent_since = time.monotonic()
            except Unreached:
                if task.cancelled:
                    raise Cancelled from None
                if time.monotonic() - silent_since > PATIENCE_S:
                    raise
            time.sleep(0.5)

    def _download(self, job: str, folder: Path, task: Task, names: dict | None = None) -> None:
        """Fetch what a job has made into a folder, all of it or nothing."""
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".relit_", dir=folder) as name:
            part = Path(name)
            self._fetch(job, part, task, names)
            (folder / JOB_FILE).unlink(missing_ok=True)  # it names the job of the files that go
            for source in [each for each in part.rglob("*") if each.is_file()]:
                target = folder / source.relative_to(part)
                target.parent.mkdir(parents=True, exist_ok=True)
                source.replace(target)

    def _fetch(self, job: str, folder: Path, task: Task, names: dict | None) -> None:
        """Fetch results of a job, by their own names or those that `names` gives them."""
        after = ""
        while after is not None:
            page = self._json("GET", f"/v1/jobs/{job}/results" + (f"?after={urllib.parse.quote(after)}" if after else ""))
            for number, found in enumerate(page["results"]):
                if names is not None and found["name"] not in names:
                    continue
                percent = 100 * number // len(page["results"])
                target = folder / (names[found["name"]] if names is not None else found["name"])
                if not target.resolve().is_relative_to(folder.resolve()):
                    raise Failure(f"the service names a result outside of its folder: {found['name']}")
                target.parent.mkdir(parents=True, exist_ok=True)
                with self._open("GET", found["url"]) as answer, open(target, "wb") as opened:
                    task.tell("fetching the results", percent)
                    while piece := answer.read(PIECE_BYTES):
                        opened.write(piece)
                        task.tell("fetching the results", percent)
                if target.stat().st_size != found["size"]:
                    raise Failure(f"{found['name']}: the service at {self._url} ended in the middle of it: try again")
            after = page["next"]

    def _json(self, method: str, path: str, body: dict | None = None, headers: dict | None = None) -> dict:
        data = None if body is None else json.dumps(body).encode()
        with self._open(method, path, data, {"Content-Type": "application/json", **(headers or {})}) as answer:
            try:
                return json.load(answer)
            except (OSError, http.client.HTTPException, ValueError) as error:
                raise Unreached(f"the service at {self._url} ended in the middle of an answer ({error}): try again") from error

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
            kind = {404: Missing, 429: Unreached, 502: Unreached, 503: Unreached, 504: Unreached}.get(error.code, Failure)
            raise kind(f"the service at {self._url} says: {sentence}") from error
        except (OSError, http.client.HTTPException, ValueError) as error:
            why = getattr(error, "reason", None) or error
            raise Unreached(f"the service at {self._url} is not reached ({why}): start it, or correct its address in the preferences of "
                            "the extension") from error

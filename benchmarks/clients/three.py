"""Opens an asset with three.js in headless Chromium and reads its float picture back.

Chromium renders with SwiftShader, so no GPU is needed. The page three.html is served by a server of this process, which keeps
nothing of an asset for the next; only environments are filtered once.
three.js has no shadows or bounces of environment light: what hides the environment from a point is not seen.

Source: three.js, src/renderers/shaders/ShaderChunk/common.glsl.js, equirectUv, for the axes of lat-long pictures.
"""

import hashlib
import json
import queue
import subprocess
import tempfile
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np

from benchmarks.clients import installed

PAGE = Path(__file__).with_name("three.html")
SAMPLES = 4
"""Samples of a pixel in each direction; three.html has the same number."""
TIME_LIMIT_S = 240
ENDED = b""
"""Instead of a job: there are no more."""
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
         "--ignore-gpu-blocklist", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
         "--disable-sync")
TYPES = {".html": "text/html", ".js": "text/javascript", ".json": "application/json"}


class Browser:
    """Chromium with three.js, which shows one asset after another; to be closed."""

    def __init__(self) -> None:
        """Start it.

        Raises:
            MissingClientError: Chromium or three.js is missing.
        """
        modules, browser = installed.node_modules(), installed.browser()
        self._files: dict[str, bytes] = {}
        self._asset = Path()
        self._jobs: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[tuple[str, bytes]] = queue.SimpleQueue()
        mine = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                path = unquote(urlsplit(self.path).path)
                content = PAGE.read_bytes() if path == "/" else mine._jobs.get() if path == "/job.json" else mine._files.get(path)
                if content is None and path.startswith("/three/") and ".." not in path:
                    content = _read(modules / path[1:])
                elif content is None and path.startswith("/asset/") and ".." not in path:
                    content = _read(mine._asset.parent / path.removeprefix("/asset/"))
                if content == ENDED:
                    return
                self.send_response(404 if content is None else 200)
                self.send_header("Content-Type", TYPES.get(Path(path).suffix or ".html", "application/octet-stream"))
                self.send_header("Cache-Control", "no-store")  # the next asset may have the name of this one
                self.end_headers()
                self.wfile.write(content or b"")

            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                self.send_response(204)
                self.end_headers()
                mine._answers.put((self.path, body))

            def log_message(self, format: str, *args: object) -> None:
                """Keep quiet."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._process = subprocess.Popen([browser, *FLAGS, f"--user-data-dir={self._profile.name}", "--remote-debugging-port=0",
                                          f"http://127.0.0.1:{self._server.server_address[1]}/"],
                                         stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def render(self, job: dict[str, Any], latlong: np.ndarray | None) -> np.ndarray:
        """Return the picture [rows, cols, 4] float32, linear, premultiplied.

        Args:
            job: `asset`, `camera`, and `sun` where there is no environment.
            latlong: [H, 2 H, 3] radiance of the environment, in relit's orientation, or None.

        Raises:
            RuntimeError: the page fails; the text says how.
        """
        width, height = job["camera"]["resolution"]
        self._asset = Path(job["asset"])
        if latlong is not None:
            content = _for_three(latlong).tobytes()
            name = f"/environment/{hashlib.sha256(content).hexdigest()}"
            self._files[name] = content
            job = {**job, "environment": name, "environment_shape": latlong.shape[:2]}
        self._jobs.put(json.dumps(job).encode())
        try:
            kind, said = self._answers.get(timeout=TIME_LIMIT_S)
        except queue.Empty:
            kind, said = "/error", b"it did not answer in time"
        if kind != "/picture":
            raise RuntimeError(f"three.js cannot show {job['asset']}: {said.decode()}")
        fine = np.frombuffer(said, np.float32).reshape(height, SAMPLES, width, SAMPLES, 4)
        return fine.mean(axis=(1, 3))[::-1].astype(np.float32)  # WebGL has the bottom row first

    def close(self) -> None:
        """End it."""
        self._process.terminate()
        self._process.wait(20)
        self._jobs.put(ENDED)  # the page waited for a job
        self._server.shutdown()
        self._server.server_close()
        self._profile.cleanup()


def _for_three(latlong: np.ndarray) -> np.ndarray:
    """Return RGBA with the bottom row first, whose centre looks along +x as three.js has it: a quarter to the right of relit's."""
    turned = np.roll(latlong[::-1], latlong.shape[1] // 4, axis=1).astype(np.float32)
    return np.concatenate([turned, np.ones((*turned.shape[:2], 1), np.float32)], axis=-1)


def _read(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None

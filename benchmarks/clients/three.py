"""Opens an asset with three.js in headless Chromium and reads its float picture back.

Chromium renders with SwiftShader, so no GPU is needed. The page three.html is served by a server of this process for one render.
three.js has no shadows or bounces of environment light: what hides the environment from a point is not seen.

Source: three.js, src/renderers/shaders/ShaderChunk/common.glsl.js, equirectUv, for the axes of lat-long pictures.
"""

import json
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
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
         "--ignore-gpu-blocklist", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
         "--disable-sync")
TYPES = {".html": "text/html", ".js": "text/javascript", ".json": "application/json"}


def render(job: dict[str, Any], latlong: np.ndarray | None) -> np.ndarray:
    """Return the picture [rows, cols, 4] float32, linear, premultiplied.

    Args:
        job: `asset`, `camera`, and `sun` where there is no environment.
        latlong: [H, 2 H, 3] radiance of the environment, in relit's orientation, or None.

    Raises:
        MissingClientError: Chromium or three.js is missing.
        RuntimeError: the page fails; the text says how.
    """
    modules, browser = installed.node_modules(), installed.browser()
    width, height = job["camera"]["resolution"]
    files: dict[str, bytes] = {}
    if latlong is not None:
        job = {**job, "environment_shape": latlong.shape[:2]}
        files["/environment"] = _for_three(latlong).tobytes()
    files |= {"/": PAGE.read_bytes(), "/job.json": json.dumps(job).encode()}
    answer: dict[str, bytes] = {}
    done = threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = unquote(urlsplit(self.path).path)
            content = files.get(path)
            if content is None and path.startswith("/three/") and ".." not in path:
                content = _read(modules / path[1:])
            elif content is None and path.startswith("/asset/") and ".." not in path:
                content = _read(Path(job["asset"]).parent / path.removeprefix("/asset/"))
            self.send_response(404 if content is None else 200)
            self.send_header("Content-Type", TYPES.get(Path(path).suffix or ".html", "application/octet-stream"))
            self.end_headers()
            self.wfile.write(content or b"")

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(204)
            self.end_headers()
            answer[self.path] = body
            done.set()

        def log_message(self, format: str, *args: object) -> None:
            """Keep quiet."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen([browser, *FLAGS, f"--user-data-dir={profile}", "--remote-debugging-port=0",
                                    f"http://127.0.0.1:{server.server_address[1]}/"],
                                   stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            done.wait(TIME_LIMIT_S)
        finally:
            process.terminate()
            process.wait(20)
            server.shutdown()
            server.server_close()
    if "/picture" not in answer:
        said = answer.get("/error", b"it did not answer in time").decode()
        raise RuntimeError(f"three.js cannot show {job['asset']}: {said}")
    fine = np.frombuffer(answer["/picture"], np.float32).reshape(height, SAMPLES, width, SAMPLES, 4)
    return fine.mean(axis=(1, 3))[::-1].astype(np.float32)  # WebGL has the bottom row first


def _for_three(latlong: np.ndarray) -> np.ndarray:
    """Return RGBA with the bottom row first, whose centre looks along +x as three.js has it: a quarter to the right of relit's."""
    turned = np.roll(latlong[::-1], latlong.shape[1] // 4, axis=1).astype(np.float32)
    return np.concatenate([turned, np.ones((*turned.shape[:2], 1), np.float32)], axis=-1)


def _read(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None

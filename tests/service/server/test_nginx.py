"""The nginx sample of docs/service.md runs as it stands: TLS, uploads and events pass, forged headers and endless ones do not.

Without nginx these tests are skipped, unless RELIT_TEST_NGINX is `required`, as .ci/run sets it.
"""

import datetime
import os
import re
import shutil
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import httpx2
import numpy as np
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from service.client import Client
from service.requests.jobs import RelightJob
from service.requests.keys import Scope
from service.requests.relight import RelightOptions
from tests.scenes.captures import write_capture, write_exr
from tests.service.server_process import Server, serving
from tests.service.waiting import PATIENCE_S, free_port, until

pytestmark = pytest.mark.long

NGINX = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
TEXT = (Path(__file__).parents[3] / "docs" / "service.md").read_text(encoding="utf-8")
NAME, HEADER_S = "relit.example", 1.0
"""Host of the sample; the time for a header in these tests, in place of ten seconds."""


class Proxied(NamedTuple):
    """A server behind nginx."""

    server: Server
    port: int
    tls: ssl.SSLContext
    key: str

    def client(self) -> httpx2.Client:
        return httpx2.Client(base_url=f"https://localhost:{self.port}", verify=self.tls, timeout=60)


def write_certificate(folder: Path) -> tuple[Path, Path]:
    """Write a certificate of localhost that nobody but itself has signed, and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "localhost")])
    now = datetime.datetime.now(datetime.UTC)
    made = (x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key()).serial_number(1)
            .not_valid_before(now - datetime.timedelta(days=1)).not_valid_after(now + datetime.timedelta(days=1))
            .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False).sign(key, hashes.SHA256()))
    certificate, secret = folder / "certificate.pem", folder / "key.pem"
    certificate.write_bytes(made.public_bytes(serialization.Encoding.PEM))
    secret.write_bytes(key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()))
    return certificate, secret


def sample(folder: Path, upstream: str, port: int, certificate: Path, key: Path) -> str:
    """Return the sample as a whole configuration: its addresses and files are those of the test, and a header has less time."""
    found = re.search(r"```nginx\n(.*?)```", TEXT, re.DOTALL)
    assert found is not None
    text = found[1]
    for old, new in {"127.0.0.1:8470": upstream, "listen 443 ssl": f"listen 127.0.0.1:{port} ssl",
                     f"server_name {NAME}": "server_name localhost", f"/etc/ssl/{NAME}.pem": str(certificate),
                     f"/etc/ssl/private/{NAME}.key": str(key), "client_header_timeout 10s": f"client_header_timeout {HEADER_S:g}s"}.items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    places = "".join(f"{name}_temp_path {folder}/{name};\n" for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi"))
    return (f"pid {folder}/pid;\ndaemon off;\nerror_log {folder}/error.log;\nevents {{}}\n"
            f"http {{\naccess_log off;\n{places}{text}}}\n{'user root;' if os.getuid() == 0 else ''}\n")


@pytest.fixture(scope="module")
def proxied(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Proxied]:
    if NGINX is None:
        (pytest.fail if os.environ.get("RELIT_TEST_NGINX") == "required" else pytest.skip)("nginx is not installed")
    folder, port = tmp_path_factory.mktemp("nginx"), free_port()
    certificate, key = write_certificate(folder)
    tls = ssl.create_default_context(cafile=str(certificate))
    with serving(folder / "service", "--device", "cpu", trusted_proxies="127.0.0.1", log_format="json") as server:
        (folder / "nginx.conf").write_text(sample(folder, server.url.removeprefix("http://"), port, certificate, key))
        nginx = subprocess.Popen([NGINX, "-c", str(folder / "nginx.conf"), "-p", str(folder), "-e", str(folder / "error.log")])
        try:

            def listens() -> bool:
                with suppress(OSError):
                    socket.create_connection(("127.0.0.1", port), timeout=5).close()
                    return True
                assert nginx.poll() is None, (folder / "error.log").read_text()
                return False

            until(listens, "nginx does not listen")
            yield Proxied(server, port, tls, server.key(scope=Scope.WRITE))
        finally:
            nginx.terminate()
            nginx.wait()


def logged(server: Server, path: str) -> list[str]:
    """Addresses of the clients that asked for a path, as the log has them."""
    return [line["client"] for line in server.lines() if line.get("event") == "request" and line.get("path") == path]


def test_pages_pass_metrics_do_not_and_a_client_cannot_say_where_it_comes_from(proxied: Proxied):
    with proxied.client() as client:
        assert "Content-Security-Policy" in client.get("/").raise_for_status().headers
        assert client.get("/static/base.css").status_code == 200
        assert client.get("/metrics").status_code == 404
    with proxied.server.client() as beside:
        assert beside.get("/metrics").status_code == 200
    forged = {"X-Forwarded-For": "10.9.8.7", "X-Real-IP": "10.9.8.7", "Forwarded": "for=10.9.8.7"}
    with proxied.client() as client:
        client.get("/v1/captures/cap_0123456789abcdefghjk", headers=forged)
    assert until(lambda: logged(proxied.server, "/v1/captures/cap_0123456789abcdefghjk")) == ["127.0.0.1"]


def test_a_header_that_never_ends_is_cut(proxied: Proxied):
    with (socket.create_connection(("127.0.0.1", proxied.port), timeout=PATIENCE_S) as plain,
          proxied.tls.wrap_socket(plain, server_hostname="localhost") as open_one):
        began = time.monotonic()
        open_one.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX: ")
        assert open_one.recv(1 << 12) == b""
        assert time.monotonic() - began >= 0.9 * HEADER_S


def test_the_client_uploads_and_follows_a_job(proxied: Proxied, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A capture of some megabytes, the events of a job, and its frame come through."""
    monkeypatch.setenv("SSL_CERT_FILE", str(Path(proxied.server.log).parents[1] / "certificate.pem"))
    capture = write_capture(tmp_path / "capture")
    sky = write_exr(tmp_path / "sky.exr", np.random.default_rng(0).uniform(size=(512, 1024, 3)).astype(np.float32))
    with Client(f"https://localhost:{proxied.port}", proxied.key) as client:
        uploaded, lit = client.captures.upload(capture), client.environments.upload(sky)
        assert (uploaded.state, lit.state) == ("ready", "ready")
        job = client.jobs.submit(RelightJob(kind="relight", capture=uploaded.id, environment=lit.id, options=RelightOptions(frames="1-2")))
        states = [view.state for view in client.jobs.follow(job.id)]
        assert states[-1] == "succeeded"
        client.jobs.download(job.id, tmp_path / "out")
    assert (tmp_path / "out" / "frame.0002.exr").is_file()

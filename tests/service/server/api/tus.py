"""A tus 1.0 client on the standard library alone, written from the protocol's text: shares nothing with the service or its client."""

import hashlib
import http.client
from base64 import b64encode
from urllib.parse import urlsplit

VERSION = "1.0.0"


def encoded(**words: str) -> str:
    return ",".join(f"{name} {b64encode(word.encode()).decode()}" for name, word in words.items())


def checksum(algorithm: str, body: bytes) -> str:
    return f"{algorithm} {b64encode(hashlib.new(algorithm, body).digest()).decode()}"


class Answer:
    def __init__(self, response: http.client.HTTPResponse) -> None:
        self.status, self.body = response.status, response.read()
        self.headers = {name.lower(): value for name, value in response.getheaders()}

    @property
    def offset(self) -> int:
        return int(self.headers["upload-offset"])


class Tus:
    """One connection a request, so that nothing of one is left to the next."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        self.host, self.port = parts.hostname, parts.port

    def ask(self, method: str, path: str, body: bytes | None = None, version: str | None = VERSION, **headers: str) -> Answer:
        connection = http.client.HTTPConnection(self.host, self.port, timeout=60)
        try:
            named = {name.replace("_", "-"): value for name, value in headers.items()}
            connection.request(method, path, body, {**({} if version is None else {"Tus-Resumable": version}), **named})
            return Answer(connection.getresponse())
        finally:
            connection.close()

    def create(self, place: str, length: int, metadata: str, **headers: str) -> Answer:
        return self.ask("POST", f"{place}/files", b"", Upload_Length=str(length), Upload_Metadata=metadata, **headers)

    def head(self, upload: str) -> Answer:
        return self.ask("HEAD", upload)

    def patch(self, upload: str, offset: int, body: bytes, **headers: str) -> Answer:
        return self.ask("PATCH", upload, body, Upload_Offset=str(offset), Content_Type="application/offset+octet-stream", **headers)

    def send(self, place: str, path: str, content: bytes, piece: int = 1 << 20) -> str:
        """A whole file, as a client does that was told nothing but the protocol; its upload."""
        made = self.create(place, len(content), encoded(path=path))
        assert made.status == 201, made.body
        upload, offset = made.headers["location"], 0
        while offset < len(content):
            body = content[offset : offset + piece]
            answer = self.patch(upload, offset, body, Upload_Checksum=checksum("sha1", body))
            assert answer.status == 204, answer.body
            offset = answer.offset
        return upload

"""Requests to URLs that users of the service chose: never into the networks around the service, unless its operator allows them.

The name of a URL is resolved, all its addresses are checked, and the connection is made to one of those addresses, so that a name that
points elsewhere a moment later (DNS rebinding) leads nowhere. Redirects and proxies of the environment are not followed.
"""

import asyncio
import socket
import ssl
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from functools import cache
from ipaddress import IPv4Address, IPv6Address, ip_address, ip_network
from typing import Any, NamedTuple
from urllib.parse import SplitResult, urlsplit

import httpx2

from service.errors import RequestError
from service.server.base.log import logger

TIMEOUT_S = 10.0
"""Seconds from the look-up of the name to the header of the answer; of its body nothing is read."""
NAT64 = ip_network("64:ff9b::/96")
"""IPv6 addresses whose last 32 bits are the IPv4 address that is meant (RFC 6052)."""
UNICAST = ip_network("2000::/3")
"""The IPv6 addresses that are given to hosts (RFC 4291). Others, such as ::127.0.0.1, can lead to addresses of IPv4."""
NO_ADDRESS = "the host has no address for hooks: it needs a public one and https://, or one in a network of the setting hook_networks"
"""What users read where a name is not found or not allowed, so that nobody learns the names inside; the log of the service says which."""


class Answer(NamedTuple):
    """The outcome of a request."""

    accepted: bool
    """True if the status is 2xx."""
    words: str
    """The status, or why there is none."""


def require_target(url: str, networks: Sequence[str]) -> None:
    """Raise RequestError if a URL has no host, has a password, or has an address to which nothing
    is sent, or is http:// where no network is allowed."""
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname, parts.port
        (host or "").encode("idna")  # as the look-up does
    except ValueError:  # a port that is no number, one bracket, or a part of the name that is empty or longer than 63
        host = None
    if not host or "@" in parts.netloc:
        raise RequestError(f"url: {url[:200]} is not of the form https://host/path")
    try:
        address = ip_address(host)
    except ValueError:  # a name, which is looked up when something is sent
        if parts.scheme != "https" and not networks:
            raise RequestError("url: http:// is for networks of the setting hook_networks, which this service has none of: give https://, "
                               "or set it") from None
        return
    _require_allowed(parts.scheme, address, networks)


def post(url: str, body: bytes, headers: Mapping[str, str], networks: Sequence[str]) -> Answer:
    """Send a body to a URL, to no address but a public one or one of `networks`, and return what came back."""
    deadline = time.monotonic() + TIMEOUT_S
    try:
        addresses = _allowed_addresses(urlsplit(url), networks)
        status = asyncio.run(_post(url, body, headers, addresses, deadline))
    except (RequestError, socket.gaierror) as error:
        logger.info("hook without an address", host=urlsplit(url).hostname, error=str(error))
        return Answer(False, NO_ADDRESS)
    except (TimeoutError, httpx2.TimeoutException):
        return Answer(False, f"no answer within {TIMEOUT_S:g} s")
    except (httpx2.HTTPError, httpx2.InvalidURL, OSError) as error:
        return Answer(False, f"no answer: {' '.join(str(error).split())[:200] or type(error).__name__}")
    words = f"{status}: redirects are not followed" if 300 <= status < 400 else str(status)
    return Answer(200 <= status < 300, words)


def _allowed_addresses(parts: SplitResult, networks: Sequence[str]) -> list[str]:
    """Return the addresses of a host, or raise RequestError if one of them is not allowed.

    A look-up cannot be ended, so that it has a thread, for which nobody waits longer than TIMEOUT_S, nor the end of the process.
    """
    found: Future[list[Any]] = Future()

    def look_up() -> None:
        try:
            found.set_result(socket.getaddrinfo(parts.hostname, parts.port, type=socket.SOCK_STREAM))
        except Exception as error:
            found.set_exception(error)

    threading.Thread(target=look_up, name="relit-look-up", daemon=True).start()
    addresses = list(dict.fromkeys(str(place[0]) for *_, place in found.result(TIMEOUT_S)))
    for address in addresses:
        _require_allowed(parts.scheme, ip_address(address), networks)
    return addresses


async def _post(url: str, body: bytes, headers: Mapping[str, str], addresses: Sequence[str], deadline: float) -> int:
    parts, refused = urlsplit(url), None
    async with asyncio.timeout(deadline - time.monotonic()), httpx2.AsyncClient(trust_env=False, verify=_certificates()) as client:
        for address in addresses:
            request = client.build_request("POST", httpx2.URL(url).copy_with(host=address), content=body, timeout=TIMEOUT_S,
                                           headers={**headers, "Host": parts.netloc}, extensions={"sni_hostname": parts.hostname})
            try:
                answer = await client.send(request, stream=True, follow_redirects=False)
            except httpx2.ConnectError as error:  # the next address may answer
                refused = error
                continue
            await answer.aclose()
            return answer.status_code
    raise refused or OSError("the host has no address")


@cache
def _certificates() -> ssl.SSLContext:
    """Return the certificates that the machine trusts, or those of SSL_CERT_FILE; reading them takes some hundredths of a second."""
    return ssl.create_default_context()


def _require_allowed(scheme: str, address: IPv4Address | IPv6Address, networks: Sequence[str]) -> None:
    meant = _meant(address)
    if any(meant in ip_network(network) for network in networks):
        return
    if not meant.is_global or meant.is_multicast or (meant.version == 6 and meant not in UNICAST):
        raise RequestError(f"url: {address} is not a public address, and no network of the setting hook_networks has it")
    if scheme != "https":
        raise RequestError(f"url: http:// is for networks of the setting hook_networks, and {address} is in none: give https://")


def _meant(address: IPv4Address | IPv6Address) -> IPv4Address | IPv6Address:
    """Return the IPv4 address that an IPv6 address stands for, where it does."""
    if isinstance(address, IPv4Address):
        return address
    if address in NAT64:
        return IPv4Address(int(address) & 0xFFFFFFFF)
    return address.ipv4_mapped or address.sixtofour or (address.teredo[1] if address.teredo else address)

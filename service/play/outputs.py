"""The interface that every protocol has; each is a module of its own, which is loaded when it is needed."""

from collections.abc import Mapping
from importlib import import_module
from typing import NamedTuple, Protocol

from service.errors import RequestError
from service.play.datagrams import Datagrams, address_of
from service.requests.play import PlayRequest

ADAPTERS = {"sacn": "sacn_output", "artnet": "artnet_output"}
"""The module of each protocol. A new protocol is a module with a function `open_output(nodes, datagrams, request)`, and an entry here."""


class Node(NamedTuple):
    """A universe and who receives it."""

    universe: int
    address: str | None
    """The IPv4 address of the host; None: all that listen."""


class Output(Protocol):
    """Sends the universes of one protocol."""

    def set(self, values: Mapping[int, bytes]) -> None:
        """Prepare the next frame: 512 values by the number of the universe."""

    def send(self) -> None:
        """Send the prepared frame at this moment.

        Raises:
            RequestError: the network refuses it.
        """

    def end(self) -> None:
        """Tell the fixtures that nothing more comes, where the protocol can, and close."""


def open_output(protocol: str, hosts: Mapping[int, str | None], request: PlayRequest) -> Output:
    """Return the output of a protocol; nothing is sent yet.

    Args:
        hosts: of each universe by its number; None: all that listen.

    Raises:
        RequestError: the package of the protocol is missing, or a host or the interface is not known.
    """
    try:
        adapter = import_module(f"service.play.{ADAPTERS[protocol]}")
    except ModuleNotFoundError as error:
        raise RequestError(f"{protocol} is sent with the package {error.name}, which is not installed: pip install 'relit[set]'") from error
    where = "--host" if request.host is not None else "lights[].address.host"
    known = {host: address_of(host, where) for host in hosts.values() if host is not None}
    nodes = [Node(universe, None if host is None else known[host]) for universe, host in hosts.items()]
    output: Output = adapter.open_output(nodes, Datagrams(request.interface), request)
    return output

"""The interface of every protocol, each a module of its own that is loaded when it is needed, and the UDP socket that all send with."""

import socket
from collections.abc import Mapping
from importlib import import_module
from ipaddress import IPv4Address
from typing import NamedTuple, Protocol

from service.errors import RequestError
from service.requests.play import PlayRequest

ADAPTERS = {"sacn": "sacn_output", "artnet": "artnet_output"}
"""The module of each protocol. A new protocol is a module with a function `open_output(nodes, datagrams, request)`, and an entry here."""
HOPS = 8
"""The most routers that a multicast packet passes."""
BROADCAST = IPv4Address("255.255.255.255")


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
        """Send the prepared frame at this moment. Raises RequestError if the network refuses it."""

    def end(self) -> None:
        """Tell the fixtures that nothing more comes, where the protocol can, and close."""


def open_output(protocol: str, hosts: Mapping[int, str | None], request: PlayRequest) -> Output:
    """Return the output of a protocol; nothing is sent yet.
    `hosts`: of each universe by its number; None: all that listen. Raises RequestError if the package of the protocol is missing, or a host
    or the interface is not known."""
    try:
        adapter = import_module(f"service.play.{ADAPTERS[protocol]}")
    except ModuleNotFoundError as error:
        raise RequestError(f"{protocol} is sent with the package {error.name}, which is not installed: pip install 'relit[set]'") from error
    where = "--host" if request.host is not None else "lights[].address.host"
    known = {host: address_of(host, where) for host in hosts.values() if host is not None}
    nodes = [Node(universe, None if host is None else known[host]) for universe, host in hosts.items()]
    output: Output = adapter.open_output(nodes, Datagrams(request.interface), request)
    return output


class Datagrams:
    """A socket for IPv4 datagrams to one host, to all (broadcast) or to those that listen to a group (multicast)."""

    def __init__(self, interface: str | None) -> None:
        """Open the socket; `interface` is the address of the network interface that sends, None: the system chooses.
        Raises RequestError if this machine has no such interface."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, HOPS)
        if interface is None:
            return
        try:
            self._socket.bind((address_of(interface, "--interface"), 0))
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(self._socket.getsockname()[0]))
        except OSError as error:
            self._socket.close()
            raise RequestError(f"--interface {interface}: {reason(error)}: give the address of a network interface of this machine"
                               ) from error

    def sendto(self, data: bytes | bytearray, address: tuple[str, int]) -> None:
        """Send a packet at once. Raises RequestError if the network refuses it."""
        try:
            self._socket.sendto(data, address)
        except OSError as error:
            to, port = IPv4Address(address[0]), address[1]
            if to.is_multicast or to == BROADCAST:
                kind = "multicast" if to.is_multicast else "broadcast"
                raise RequestError(f"the network refuses {kind} to {to}, port {port}: {reason(error)}: give the node's address as "
                                   "lights[].address.host of the rig, or as --host; or name an interface, --interface") from error
            raise RequestError(f"cannot send to {to}, port {port}: {reason(error)}") from error

    def close(self) -> None:
        """Close the socket; again does nothing."""
        self._socket.close()


def address_of(host: str, where: str) -> str:
    """Return the IPv4 address of a host.
    `where`: the option or field that names it, for the message. Raises RequestError if nobody knows the host."""
    try:
        return str(socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_DGRAM)[0][4][0])
    except (OSError, UnicodeError) as error:  # of a name that no host can have
        raise RequestError(f"{where}: the host {host} cannot be resolved: give the IPv4 address of the node, or a name that this machine "
                           "knows") from error


def reason(error: OSError) -> str:
    """Return why the system refuses, in its words."""
    return (error.strerror or str(error)).lower()

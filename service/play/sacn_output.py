"""sACN (ANSI E1.31-2018) through the package sacn: priority, source name, universe synchronisation and stream termination.

The package's own thread sends when it comes round to it, 1/fps late at worst. Its `flush` sends on the caller's thread; together with a
socket of our own, which its constructor takes, packets leave at the moment of the call. The socket also sends the synchronisation to
unicast hosts, for which the package has multicast alone.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from sacn import sACNsender
from sacn.messages.sync_packet import SyncPacket
from sacn.sending.sender_socket_base import DEFAULT_PORT, SenderSocketBase

from service.errors import RequestError
from service.play.outputs import Datagrams, Node
from service.requests.play import PlayRequest

SYNC_UNIVERSE = 63999
"""The universe of synchronisation packets; E1.31 lets a source choose it."""


class SacnOutput:
    """Sends sACN universes."""

    def __init__(self, nodes: Sequence[Node], datagrams: Datagrams, request: PlayRequest) -> None:
        """Open the stream of every universe, with dark lamps; nothing is sent yet."""
        hosts = {node.address for node in nodes}
        self._sender = sACNsender(source_name=request.source_name, universeDiscovery=False, sync_universe=SYNC_UNIVERSE,
                                  socket=_SenderSocket(datagrams, hosts, synchronise=request.universe_sync))
        for node in nodes:
            self._sender.activate_output(node.universe)
            output = self._sender[node.universe]
            output.priority, output.multicast = request.priority, node.address is None
            if node.address is not None:
                output.destination = node.address

    def set(self, values: Mapping[int, bytes]) -> None:
        """Prepare the next frame."""
        for universe, channels in values.items():
            self._sender[universe].dmx_data = tuple(channels)

    def send(self) -> None:
        """Send the prepared frame, then the packet at which fixtures show it."""
        self._sender.flush()

    def end(self) -> None:
        """Terminate the stream of every universe, in three packets each (E1.31-2018, section 6.2.6), and close."""
        try:
            for universe in self._sender.get_active_outputs():
                self._sender.deactivate_output(universe)
        finally:
            self._sender.stop()


class _SenderSocket(SenderSocketBase):  # type: ignore[misc]
    """Sends the packets of the package at once, on the thread of the caller."""

    def __init__(self, datagrams: Datagrams, hosts: set[str | None], *, synchronise: bool) -> None:
        super().__init__(None)
        self._datagrams, self._hosts, self._synchronise = datagrams, hosts, synchronise

    def start(self) -> None:
        """Begin no thread."""

    def stop(self) -> None:
        """Close the socket."""
        self._datagrams.close()

    def send_unicast(self, data: Any, destination: str) -> None:
        """Send a packet to one host."""
        if not self._synchronise:
            data.syncAddr = 0  # `flush` has set it
        self._datagrams.sendto(bytes(data.getBytes()), (destination, DEFAULT_PORT))

    def send_multicast(self, data: Any, destination: str, ttl: int) -> None:
        """Send a packet to a multicast group, a synchronisation packet to every host that has a universe."""
        if not isinstance(data, SyncPacket):
            self.send_unicast(data, destination)
        elif self._synchronise:
            for host in self._hosts:
                self.send_unicast(data, destination if host is None else host)

    def send_broadcast(self, data: Any) -> None:
        """Send nothing: what the package broadcasts is the discovery of universes, which is switched off."""


def open_output(nodes: Sequence[Node], datagrams: Datagrams, request: PlayRequest) -> SacnOutput:
    """Return the output of sACN. Raises RequestError if the name of the source is too long."""
    if len(request.source_name.encode()) > 63:
        raise RequestError(f"--source-name {request.source_name}: takes {len(request.source_name.encode())} bytes of UTF-8: sACN has 63")
    return SacnOutput(nodes, datagrams, request)

"""Art-Net 4 through the package stupidArtnet, with ArtSync.

The package's own thread sleeps between packets without regard to a clock, so `show` and `send_artsync` are called, which send at once. Both
print what the network refuses and go on; they catch OSError alone, so the sentence of our socket, which takes the place of theirs, reaches
the caller. The package writes the sequence number into the header once: the header is made anew for each packet.
"""

from collections.abc import Mapping, Sequence

from stupidArtnet import StupidArtnet

from service.play.outputs import BROADCAST, Datagrams, Node
from service.requests.play import PlayRequest
from stage.rig.rig import CHANNELS

LAST_SEQUENCE = 255
"""Sequence numbers go from 1 to 255; 0 would say that there are none."""


class ArtnetOutput:
    """Sends Art-Net universes."""

    def __init__(self, nodes: Sequence[Node], datagrams: Datagrams, *, synchronise: bool) -> None:
        """Make a client for each universe, with dark lamps; nothing is sent yet."""
        self._datagrams, self._sequence = datagrams, 0
        self._clients = {}
        for node in nodes:
            client = StupidArtnet(node.address or str(BROADCAST), node.universe, CHANNELS)
            client.socket_client.close()
            client.socket_client = datagrams
            self._clients[node.universe] = client
        hosts = {client.target_ip: client for client in self._clients.values()}
        self._synchronisers = list(hosts.values()) if synchronise else []

    def set(self, values: Mapping[int, bytes]) -> None:
        """Prepare the next frame."""
        for universe, channels in values.items():
            self._clients[universe].set(bytearray(channels))

    def send(self) -> None:
        """Send the prepared frame, then the packet at which fixtures show it."""
        self._sequence = self._sequence % LAST_SEQUENCE + 1
        for client in self._clients.values():
            client.sequence = self._sequence
            client.make_artdmx_header()
            client.show()
        for client in self._synchronisers:
            client.send_artsync()

    def end(self) -> None:
        """Close: Art-Net has no word for the end of a stream."""
        self._datagrams.close()


def open_output(nodes: Sequence[Node], datagrams: Datagrams, request: PlayRequest) -> ArtnetOutput:
    """Return the output of Art-Net."""
    return ArtnetOutput(nodes, datagrams, synchronise=request.universe_sync)

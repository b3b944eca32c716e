"""The options of `relit play` and `relit twin`."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from service.requests.base.base import Choice, Commas, Options, PixelOptions, Request, Role, Spelling
from service.requests.base.review import ReviewOptions
from service.requests.drive import RIG
from stage.model import Count, Finite, Line, NotNegative, NotNegativeCount, Positive


class Protocol(Choice):
    """The protocol that carries DMX universes."""

    SACN = "sacn", "streaming ACN, ANSI E1.31"
    ARTNET = "artnet", "Art-Net 4"


class DrivenOptions(Options):
    """The way to the lamps of a rig."""

    protocol: Protocol | None = None
    """The protocol of all universes, with the numbers that they have; None: those of the rig's addresses."""


class PlayRequest(DrivenOptions):
    """Send cues to the lamps of a rig over sACN or Art-Net, and turn the lamps dark at the end."""

    cues: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="CUES")]
    """The cues.json that relit drive wrote, or its folder."""
    rig: Annotated[Path, Role.INPUT, RIG]
    """The rig that the cues were made for (relit.rig/1)."""
    frames_per_second: Annotated[float | None, Field(gt=0, le=1000, allow_inf_nan=False), Spelling(flag="--fps")] = None
    """Frames per second; None: the rate of the cues."""
    loop: bool = False
    """Begin again after the last frame, until the program is interrupted."""
    hold: NotNegativeCount | None = None
    """Send the frame of this number alone, until the program is interrupted."""
    universe_sync: bool = True
    """Let fixtures show all universes of a frame at one moment: E1.31 synchronisation, or ArtSync."""
    priority: Annotated[int, Field(ge=0, le=200)] = 100
    """The priority of the source in sACN, 0 to 200: fixtures follow the source with the highest."""
    source_name: Annotated[Line, Field(min_length=1, max_length=63)] = "Relit"
    """The name of the source, which other sACN devices show; 63 bytes of UTF-8 at most."""
    host: Line | None = None
    """Send all universes to this host, such as 127.0.0.1 where relit twin listens; None: to the hosts of the rig's addresses, by multicast
    (sACN) or broadcast (Art-Net) where an address has none."""
    interface: Line | None = None
    """The address of the network interface of this machine that sends; None: the system chooses."""


class PictureFormat(Choice):
    """The format of the pictures of the twin's camera."""

    EXR = "exr", "scene-linear floating point"
    PNG = "png", "8 bits, sRGB"
    CARD = "card", "one JPEG that shows the lamps as they are now: the card of libgphoto2's virtual camera"


class PictureFault(Choice):
    """What goes wrong with a picture of the twin's camera."""

    DEAD = "dead", "no lamp shines"
    WRONG = "wrong", "the next lamp of the rig shines in place of each"
    DOUBLED = "doubled", "the picture before comes again"
    DROPPED = "dropped", "no picture comes"
    LATE = "late", "the picture comes 2 s later"
    MOVED = "moved", "everything is 3 pixels further right"
    CLIPPED = "clipped", "the exposure is 16 times as long"
    AMBIENT = "ambient", "light that is not the rig's is on"
    FOCUS = "focus", "the picture is blurred"


class TwinRequest(ReviewOptions, DrivenOptions, PixelOptions, Request):
    """A stage that is not there: receive what is sent to the lamps of a rig, and show what a camera would see."""

    rig: Annotated[Path, Role.INPUT, RIG]
    """The rig that is driven (relit.rig/1)."""
    capture: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="CAPTURE")]
    """Folder with a capture.json: images under single lights from where the lamps of the rig stand."""
    interface: Line = "127.0.0.1"
    """The address of this machine to listen on; 0.0.0.0: all of them, and multicast."""
    play: Annotated[Path | None, Role.INPUT, Spelling(metavar="CUES")] = None
    """Send these cues (cues.json or its folder) to the twin, over and over, as `relit play --loop` in another terminal does."""
    port: Annotated[int, Field(ge=0, le=65535)] = 8571
    """The port of the page on this machine; 0: any free one."""
    exposure: Finite = 0.0
    """Stops by which pictures on the page and PNG files are brighter."""
    snapshot: Annotated[Path | None, Role.FILE, Spelling(metavar="FILE")] = None
    """Write the picture of the last frame that is received, .exr or .png; without `frames` and `after`, of the first one. There is no page
    then."""
    record: Annotated[Path | None, Role.FILE, Spelling(metavar="FILE.csv")] = None
    """Write the levels of all frames that are received, a line for each."""
    pictures: Annotated[Path | None, Role.OUTPUT, Spelling(metavar="FOLDER")] = None
    """Be a camera too: write a picture into this folder at each POST to /release of the page, which may have ?exposure_s=; with the format
    `card`, whenever a frame comes."""
    picture_format: PictureFormat = PictureFormat.EXR
    """The format of these pictures."""
    noise: NotNegative = 0.0
    """The noise of these pictures: its standard deviation at half of full scale."""
    faults: Annotated[tuple[Line, ...], Commas, Spelling(metavar="KIND@N,…")] = ()
    """What goes wrong at which release, counted from 1: dead@17, or ambient@17- from release 17 on; with the format `card`, which sees no
    release, under which lamps, in the order in which they are lit."""
    seed: NotNegativeCount = 0
    """The seed of the noise."""
    frames: Count | None = None
    """End when so many whole frames have been received."""
    after: Positive | None = None
    """End after so many seconds."""

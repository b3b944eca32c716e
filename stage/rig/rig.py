"""The file of a rig, rig.json with schema relit.rig/1: the lamps of a light stage, what each gives at the subject, and how it is addressed.

Places and directions stand in one frame, the camera frame of the captures that are taken with the rig: x to the right, y up, z towards the
viewer.
"""

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from stage.capture.camera import Camera
from stage.colour.colour_spaces import LightSpaceName
from stage.files import write_text
from stage.model import Direction, FirstFault, Fraction, LitRgb, NotNegative, Positive, Strict, Text, Vector
from stage.records import faults_of_each, read_record, record_text
from stage.rig.controllers import Controllers

RIG_SCHEMA = "relit.rig/1"
CHANNELS = 512
"""The channels of a DMX universe."""
DMX = ("sacn", "artnet")
"""The protocols that carry DMX universes."""
UNIVERSES = {"sacn": (1, 63999), "artnet": (0, 32767)}
"""The first and the last universe of each: ANSI E1.31-2018, section 6.2.7, and Art-Net 4, port-address."""

ResponsePoint = tuple[Fraction, Fraction]


class Spectrum(Strict):
    """A measured spectrum, linear between its samples and 0 outside of them."""

    wavelength_nm: Annotated[tuple[Positive, ...], Field(min_length=2), FirstFault]
    """The wavelengths of the samples, rising."""
    power: Annotated[tuple[NotNegative, ...], Field(min_length=2), FirstFault]
    """The spectral irradiance of each, in any unit that the primaries of the rig share."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.power) != len(self.wavelength_nm):
            raise ValueError(f"has {len(self.wavelength_nm)} wavelength_nm and {len(self.power)} power entries: give one each")
        if any(b <= a for a, b in pairwise(self.wavelength_nm)):
            raise ValueError("wavelength_nm must rise")
        return self


class Primary(Strict):
    """One colour of emitters of a lamp, which is driven by itself."""

    name: Text
    """The name of the primary, such as red, white or amber: primaries of one name stand in for each other on neighbouring lamps."""
    irradiance: LitRgb
    """The irradiance at the subject at normal incidence at full level, in the `color_space` of the rig."""
    spectrum: Spectrum | None = None
    """The spectrum at full level; None: it is not known."""
    response: Annotated[tuple[ResponsePoint, ...] | None, Field(min_length=2), FirstFault] = None
    """The light for each drive, pairs of drive and light from [0, 0] to [1, 1], linear between them; None: linear."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.response is not None:
            if self.response[0] != (0.0, 0.0) or self.response[-1] != (1.0, 1.0):
                raise ValueError("response must begin with [0, 0] and end with [1, 1]")
            if any(after[0] <= before[0] or after[1] < before[1] for before, after in pairwise(self.response)):
                raise ValueError("response must rise: each drive above the one before, its light not below")
        return self


class FixedChannel(Strict):
    """A channel of a lamp that keeps one value while the lamp is driven, such as that of a dimmer, a shutter or a colour wheel."""

    name: Text
    """What the channel drives, such as Dimmer."""
    channel: Annotated[int, Field(ge=1, le=CHANNELS)]
    """The channel, 1 to 512, in the universe of the lamp."""
    value: Annotated[int, Field(ge=0, le=255)]
    """The value that it keeps; when the stage is turned dark it is 0, as all channels are."""


class Address(Strict):
    """The way a lamp is driven."""

    protocol: Literal["sacn", "artnet", "serial", "http", "manual"]
    """`sacn` and `artnet` carry DMX; `serial` and `http` lamps are only switched; `manual`: a person holds the lamp."""
    universe: int | None = None
    """The DMX universe: 1 to 63999 for sacn, 0 to 32767 for artnet."""
    channels: dict[Text, Annotated[int, Field(ge=1, le=CHANNELS)]] = Field(default_factory=dict)
    """The channel of each primary by its name, 1 to 512; with 16 bits the coarse one, and the fine one follows it."""
    fixed: Annotated[tuple[FixedChannel, ...], FirstFault] = ()
    """The other channels of the lamp. Lamps may share one, such as a master dimmer; the light of the primaries is that at these values."""
    host: Text | None = None
    """The address of the node that the universe is sent to; None: multicast for sacn, broadcast for artnet."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.protocol in DMX:
            first, last = UNIVERSES[self.protocol]
            if self.universe is None:
                raise ValueError(f"universe is missing: {self.protocol} needs it")
            if not first <= self.universe <= last:
                raise ValueError(f"universe is {self.universe}: {self.protocol} has {first} to {last}")
        elif self.fixed:
            raise ValueError(f"fixed is for {' and '.join(DMX)}, not for {self.protocol}")
        return self


class Lamp(Strict):
    """One lamp: a place, its primaries, and its address."""

    name: Text
    """The name of the lamp, unlike the others."""
    type: Literal["distant", "point"]
    """`distant` for a lamp whose direction alone is known, `point` for one whose place is known."""
    direction: Direction | None = None
    """The unit vector from the subject to a distant lamp."""
    position_m: Vector | None = None
    """The place of a point lamp in metres."""
    aim: Direction | None = None
    """The direction in which the lamp shines most, from the lamp outwards; None: towards the subject."""
    size_m: Positive | None = None
    """The diameter of what shines, in metres; None: it is not known."""
    primaries: Annotated[tuple[Primary, ...], Field(min_length=1), FirstFault]
    """The colours of emitters, each driven by itself."""
    bits: Literal[8, 16] = 8
    """The bits of a level: 8, or 16 on two channels, coarse and fine."""
    least: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """The least level above 0 that the lamp holds, a fraction of its light at full level; below it the lamp is dark."""
    pwm_hz: Positive | None = None
    """The rate at which the lamp flickers or is pulsed; None: it is steady, or the rate is not known."""
    address: Address | None = None
    """The way the lamp is driven; None: nobody has patched it."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        given, other = ("direction", "position_m") if self.type == "distant" else ("position_m", "direction")
        if getattr(self, given) is None:
            raise ValueError(f"{given} is missing: a {self.type} lamp needs it")
        if getattr(self, other) is not None:
            raise ValueError(f"{other} is not for a {self.type} lamp")
        names = [primary.name for primary in self.primaries]
        for index, name in enumerate(names):
            if name in names[:index]:
                raise ValueError(f"primaries[{index}].name: {name} is already the name of primaries[{names.index(name)}]")
        for name in () if self.address is None else self.address.channels:
            if name not in names:
                raise ValueError(f"address.channels: {name} is no primary of the lamp, which has {', '.join(names)}")
        return self


class Rig(Strict):
    """The content of a rig file."""

    schema_: Literal["relit.rig/1"] = Field(alias="schema")
    """The kind and version of the file."""
    name: Text
    """The name of the rig."""
    color_space: LightSpaceName = "lin_rec709_scene"
    """The scene-linear colour space of the irradiances."""
    subject_m: Vector = (0.0, 0.0, 0.0)
    """The place of the subject, in metres."""
    controllers: Controllers = Controllers()
    """The controllers of lamps that are switched over a serial port or by HTTP."""
    camera: Camera | None = None
    """The camera at the rig, as in capture.json; None: it is not known."""
    lights: Annotated[tuple[Lamp, ...], Field(min_length=1), FirstFault]
    """The lamps."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        protocols = {lamp.address.protocol for lamp in self.lights if lamp.address is not None}
        for protocol in ("serial", "http"):
            if protocol in protocols and getattr(self.controllers, protocol) is None:
                raise ValueError(f"controllers.{protocol} is missing: lamps have the protocol {protocol}")
        first: dict[str, int] = {}
        for index, lamp in enumerate(self.lights):
            if first.setdefault(lamp.name, index) != index:
                raise ValueError(f"lights[{index}].name: {lamp.name} is already the name of lights[{first[lamp.name]}]")
            if lamp.position_m == self.subject_m:
                raise ValueError(f"lights[{index}].position_m: the lamp {lamp.name} stands at the subject")
        return self

    @property
    def directions(self) -> np.ndarray:
        """Return the unit vectors [lights, 3] from the subject to the lamps, float64."""
        found = np.array([lamp.direction if lamp.position_m is None else np.subtract(lamp.position_m, self.subject_m)
                          for lamp in self.lights], dtype=np.float64).reshape(-1, 3)
        return found / np.linalg.norm(found, axis=1, keepdims=True)

    @property
    def emitters(self) -> list[tuple[int, Primary]]:
        """Return every primary of every lamp with the index of its lamp, in the order of the file: the columns of all levels."""
        return [(index, primary) for index, lamp in enumerate(self.lights) for primary in lamp.primaries]


def read_rig(path: str | Path) -> Rig:
    """Read and check a rig file."""
    return read_record(path, Rig, lambda data: faults_of_each(data, "lights", Lamp))


def write_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig file whole or not at all, a line for each lamp; keys that have their default are left out."""
    write_text(path, record_text(rig, "lights", color_space=rig.color_space))

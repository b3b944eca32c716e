"""The pictures of a capture, judged as they come and once more when all are there.

A picture is compared with what it should be, which `expectation` says. Lamps that light next to nothing of the object, as those behind it,
show no fault and are not judged.
"""

from collections.abc import Collection, Iterator, Sequence

import numpy as np

from service.acquisition.checks.expectation import (
    LEAST_LAMPS,
    SHADE_PART,
    Expectation,
    Fault,
    FaultKind,
    Seen,
    added_part,
    comparable,
    expected_bands,
    expected_blocks,
    lower_quartile,
    same_kind,
    unit_root,
)
from service.acquisition.checks.motion import Bands, bands_of, motion_between, shift_between
from service.acquisition.checks.picture_sample import place_of_tile, sample_of
from service.acquisition.checks.unreached import glows, shows, unreached_faults
from service.acquisition.checks.wrong_lamps import exchanged_faults, twin_of
from service.acquisition.plans.shots import Shot
from stage.rig.rig import Rig

FULL_SCALE = 0.995
"""A reading above this part of full scale is clipped."""
CLIPPED_SHARE = 0.03
"""The largest share of the pixels that are not dark that may be clipped: highlights of a glossy object are."""
LEAST_BRIGHT = 0.03
"""The least that the brightest thousandth of a picture reads under several lamps, as a part of full scale."""
LEAST_LIGHT = 0.05
"""A lamp is judged if it gives, or should give, this part of the light that lamps give on the average."""
UNLIT_PART = 0.03
"""A picture with less than this part of the light that it should have was not lit: predictions are wrong by a few times, not by thirty."""
BRIGHT_GAIN = 2.0
"""A picture is too bright if it has more than this factor of the light of its prediction and of every picture that this rests on."""
LEAST_BRIGHT_WEIGHT, BRIGHT_CLIPPED_SHARE = 0.05, 0.001
"""The weight from which it rests on one, and the share of the lit pixels from which a picture that is too bright is called clipped."""
COMPARED = 5
"""The most pictures whose details are looked at before it is said that one has moved."""
BLURRED_CONTRAST, BLURRED_MATCH = 0.75, 0.5
"""A picture is out of focus if its details have less contrast, and match the expected ones by less: other light lowers one alone."""
AMBIENT_PART = 0.1
"""The part of the mean picture under one lamp that may be added to a prediction before light that is not the rig's is on."""
INSIDE_GAIN, BORDER_AMBIENT_PART = 1.3, 0.3
"""The same part where lamps are on one side only: the sum of the sizes of weights, 1 within them, grows with the extrapolation."""
AMBIENT_GAIN = 1.1
"""Pictures of equal levels may have this factor of the light of the others."""
SHADE_QUANTILE, DARK_PART = 0.1, 0.1
"""What a dark picture may read above the darkest tenth of the readings under lamps, as a part of their mean."""
PREDICTED = (FaultKind.MOVED, FaultKind.UNSHARP, FaultKind.AMBIENT, FaultKind.BRIGHT)
"""What only a good prediction shows: while pictures come, it is named where lamps all around have theirs."""
CERTAIN = (FaultKind.DOUBLED, FaultKind.CLIPPED, FaultKind.DARK)
"""What a picture shows by itself."""


class Judge:
    """Judges pictures against those that were taken before."""

    def __init__(self, rig: Rig) -> None:
        light = [np.sum([primary.irradiance for primary in lamp.primaries]) for lamp in rig.lights]
        self._expectation = Expectation(rig.directions, np.array(light))
        self._held = {index for index, lamp in enumerate(rig.lights) if lamp.address is not None and lamp.address.protocol == "manual"}
        self._place: tuple[int, int] | None = None
        self._seen: dict[str, Seen] = {}
        self._digests: dict[bytes, str] = {}
        self._latest: tuple[np.ndarray, Seen] | None = None

    def judge(self, shot: Shot, pixels: np.ndarray, space: str, full_scale: float) -> list[Fault]:
        """Return the faults of a picture that has just come.
        `pixels`: [rows, cols, 3] recorded values, integers as fractions of full scale. `full_scale`: the recorded value from which readings
        are clipped."""
        seen = self._look(shot, pixels, space, full_scale)
        doubled = None if seen.sample.digest is None else self._digests.get(seen.sample.digest)
        if doubled is not None:
            return [Fault(shot.key, FaultKind.DOUBLED, f"is the picture of {doubled} again")]
        if seen.sample.digest is not None:
            self._digests[seen.sample.digest] = shot.key
        found = list(self._exposure_faults(seen))
        if not found and shot.lamp is not None and shot.exposure_s is None:  # of several exposures, short ones may show no lamp
            every = [*self._seen.values(), seen]
            found = [fault for fault in unreached_faults(every, self._expectation.directions, self._dark) if fault.shot == shot.key]
        found = [*found, *self._faults(seen, self._others(seen, self._sound()))][:1]
        if found and found[0].kind is FaultKind.UNLIT and glows(seen, self._dark(shot)):
            return []  # as behind the object: all pictures together tell such a lamp from one that failed
        if found and found[0].kind in PREDICTED and shot.lamp is not None and not self._surrounded(seen, self._others(seen, self._sound())):
            return []
        return found

    def accept(self, shot: Shot, pixels: np.ndarray, space: str, full_scale: float, faults: Sequence[Fault] = ()) -> None:
        """Take note of the picture that a shot has from now on, with the faults that were found when it came."""
        seen = self._look(shot, pixels, space, full_scale)
        if seen.sample.digest is not None:
            self._digests.setdefault(seen.sample.digest, shot.key)
        self._seen[shot.key] = seen._replace(faults=tuple(faults))
        self._latest = None

    def forget(self, shot: Shot) -> None:
        """Take note that a shot has no picture any more."""
        self._seen.pop(shot.key, None)

    def light(self, shot: Shot) -> float:
        """Return the mean reading of the picture that a shot has, scene-linear."""
        return float(self._seen[shot.key].sample.blocks.mean())

    def compare(self, shot: Shot, earlier: np.ndarray, pixels: np.ndarray, space: str, full_scale: float) -> Fault | None:
        """Return what moved between two pictures of one shot, or None."""
        before, after = (self._look(shot, picture, space, full_scale) for picture in (earlier, pixels))
        return _moved(after, before.bands, float(before.sample.blocks.mean()))

    def review(self) -> list[Fault]:
        """Return the faults that all pictures together show, one for a picture, the worst first.

        Pictures with faults mislead what is expected of others, so the worst is left out first, and the others are judged anew; at the end
        each that was left out is judged against those that are sound, which also clears what was suspected before all pictures were there.
        """
        certain = {key: each.faults[0] for key, each in self._seen.items() if each.faults and each.faults[0].kind in CERTAIN}
        found: dict[str, Fault] = {}
        left = [each for key, each in self._seen.items() if key not in certain]
        certain |= {fault.shot: fault for fault in unreached_faults(left, self._expectation.directions, self._dark)}
        sound = [each for each in left if each.shot.key not in certain and each.shot.lamp not in self._held]
        certain |= {fault.shot: fault for fault in exchanged_faults(sound, self._expectation)}
        keys = [key for key in self._seen if key not in certain]
        for key in keys:
            if faults := self._dark_faults(self._seen[key], [self._seen[other] for other in keys if other not in found]):
                found[key] = faults[0]
        doubtful: dict[str, tuple[float, Fault]] = {}
        affected = [key for key in keys if key not in found]
        while True:
            kept = [key for key in keys if key not in found]
            for key in affected:
                seen = self._seen[key]
                others = self._others(seen, kept)
                doubtful.pop(key, None)
                if faults := self._faults(seen, others):
                    doubtful[key] = self._expectation.misfit(seen, others), faults[0]
            if not doubtful:
                break
            worst = max(doubtful, key=lambda key: doubtful[key][0])
            found[worst] = doubtful.pop(worst)[1]
            affected = [key for key in kept if key != worst and self._leans_on(key, worst, kept)]
        for key in list(found):
            seen = self._seen[key]
            if seen.shot.levels.any() or seen.shot.projected:
                others = self._others(seen, [other for other in keys if other not in found])
                if faults := self._faults(seen, others):
                    found[key] = faults[0]
                elif self._expectation.weights(seen, others) is not None:
                    del found[key]
        return [*certain.values(), *found.values()]

    def _look(self, shot: Shot, pixels: np.ndarray, space: str, full_scale: float) -> Seen:
        """Return a picture as it is judged."""
        if self._latest is not None and self._latest[0] is pixels and self._latest[1].shot is shot:
            return self._latest[1]
        place = self._place
        if place is None:
            place = place_of_tile(pixels)
            if pixels.max() > LEAST_BRIGHT * full_scale:  # of a dark picture the place of detail is that of noise
                self._place = place
        sample = sample_of(pixels, place, space, full_scale)
        seen = Seen(shot, sample, unit_root(sample.blocks), bands_of(sample.tile), ())
        self._latest = pixels, seen
        return seen

    def _exposure_faults(self, seen: Seen) -> Iterator[Fault]:
        shot, sample = seen.shot, seen.sample
        if sample.clipped > CLIPPED_SHARE and not shot.may_clip:
            yield Fault(shot.key, FaultKind.CLIPPED, f"{100 * sample.clipped:.3g} % of the lit pixels are clipped")
        if shot.lamp is None and shot.levels.any() and sample.bright < LEAST_BRIGHT:
            dark = [each.sample.bright for each in self._seen.values() if _is_dark(each.shot)]
            kind = FaultKind.UNLIT if dark and sample.bright < 2 * max(dark) else FaultKind.DARK
            yield Fault(shot.key, kind, f"the brightest readings are {100 * sample.bright:.2g} % of full scale: check the lamps, or expose "
                        "longer")

    def _dark_faults(self, seen: Seen, others: list[Seen]) -> list[Fault]:
        """Return the faults of a picture without any lamp: it can read no more anywhere than the others do."""
        lamps = [each.sample.blocks for each in others if each.shot.lamp is not None and comparable(each.shot, seen.shot)]
        if not _is_dark(seen.shot) or len(lamps) < LEAST_LAMPS:
            return []
        usual = np.mean(lamps, axis=0)
        lit = usual > 2 * SHADE_PART * usual.mean()
        above = float((seen.sample.blocks - np.quantile(lamps, SHADE_QUANTILE, axis=0))[lit].mean() / max(float(usual[lit].mean()), 1e-30))
        return [Fault(seen.shot.key, FaultKind.AMBIENT, f"reads {100 * above:.0f} % of the light of a lamp more than pictures under lamps "
                      "do in the shade")] if above > DARK_PART else []

    def _faults(self, seen: Seen, others: list[Seen]) -> list[Fault]:
        """Return the fault that a picture shows against others, if it shows one."""
        shot, sample = seen.shot, seen.sample
        if not (shot.levels.any() or shot.projected) or not others:
            return []
        used = self._expectation.weights(seen, others)
        usual = np.mean([each.sample.blocks for each in others], axis=0)
        dark = self._dark(shot)
        if used is None:
            return self._few_faults(seen, others, dark) if len(others) + 1 < LEAST_LAMPS else []
        expected = expected_blocks(used)
        light, should = float((sample.blocks - dark).mean()), float((expected - dark).mean())
        least = LEAST_LIGHT * float((usual - dark).mean())
        if shot.lamp is not None:
            if not isinstance(dark, float) and not glows(seen, dark) and shows(seen, dark, UNLIT_PART * float((expected - dark).max())):
                return [Fault(shot.key, FaultKind.UNLIT, "shows no sign of the lamp")]
            should = min(should, lower_quartile([(abs(weight), float((each.sample.blocks - dark).mean())) for weight, each in used]))
        faint = should < least
        if faint and (shot.lamp is None or light < least):
            return []
        if light < UNLIT_PART * should:
            return [Fault(shot.key, FaultKind.UNLIT, f"has {max(0.0, 100 * light / should):.2g} % of the light that the others predict")]
        held = shot.lamp in self._held  # by a person, so that it stands about where the rig says: shading tells no more than that it is on
        if shot.lamp is not None and not held and (twin := twin_of(seen, others, self._expectation)) is not None:
            return [Fault(shot.key, FaultKind.WRONG_LIGHT, f"is lit as {twin} is")]
        if shot.lamp is not None and (bright := self._bright_fault(seen, used, usual, dark, max(should, least))) is not None:
            return [bright]
        moved = None if held or light < least else _moved(seen, expected_bands(used), float(usual.mean()))
        if moved is not None and self._details_stay(used, others):
            return [moved]
        if faint:
            return [] if held else self._ambient_faults(seen, others, used, BORDER_AMBIENT_PART)
        if light < least:
            return []
        motion = motion_between(seen.bands, expected_bands(used), float(usual.mean()))
        if motion is not None and motion.contrast < BLURRED_CONTRAST and motion.match < BLURRED_MATCH:
            return [Fault(shot.key, FaultKind.UNSHARP, f"details have {100 * motion.contrast:.0f} % of the contrast that they should have")]
        if shot.lamp is not None:
            return [] if held else self._ambient_faults(seen, others, used, AMBIENT_PART)
        return [] if light <= AMBIENT_GAIN * should else [_ambient(shot, light / should - 1)]

    def _ambient_faults(self, seen: Seen, others: list[Seen], used: list[tuple[np.float32, Seen]], part: float) -> list[Fault]:
        """Return the fault of a picture under one lamp that more than a part of the usual picture is added to what is expected of it."""
        if len(others) < LEAST_LAMPS:  # a mean of so few may be darker everywhere than the lamp between them
            return []
        more = added_part(seen.sample.blocks, expected_blocks(used), np.mean([each.sample.blocks for each in others], axis=0))
        if not self._surrounded(seen, others):
            part = BORDER_AMBIENT_PART
        return [_ambient(seen.shot, more)] if more > part else []

    def _surrounded(self, seen: Seen, others: list[Seen]) -> bool:
        """Return whether lamps all around that of a picture say what it should be."""
        shares = self._expectation.shares(seen, others)
        return shares is not None and float(np.abs(shares).sum()) < INSIDE_GAIN and self._expectation.interpolated(seen, others)

    def _bright_fault(self, seen: Seen, used: list[tuple[np.float32, Seen]], usual: np.ndarray, dark: np.ndarray | float, should: float
                      ) -> Fault | None:
        """Return the fault of a picture of far more light than it should have, shaded as under its lamp and not as usual."""
        most = max([should, *(float((each.sample.blocks - dark).mean()) for weight, each in used if abs(weight) > LEAST_BRIGHT_WEIGHT)])
        gain = float((seen.sample.blocks - dark).mean()) / max(most, 1e-30)
        if gain < BRIGHT_GAIN or seen.root @ unit_root(expected_blocks(used)) < seen.root @ unit_root(usual):
            return None
        kind = FaultKind.CLIPPED if seen.sample.clipped > BRIGHT_CLIPPED_SHARE else FaultKind.BRIGHT
        return Fault(seen.shot.key, kind, f"has {gain:.3g} times the light of the others, {100 * seen.sample.clipped:.3g} % of it clipped")

    def _few_faults(self, seen: Seen, others: list[Seen], dark: np.ndarray | float) -> list[Fault]:
        """Return the fault of a picture under one of a few lamps, of which none is predicted."""
        light = float((seen.sample.blocks - dark).mean())
        usual = float(np.median([(each.sample.blocks - dark).mean() for each in others]))
        if light < UNLIT_PART * LEAST_LIGHT * usual:
            return [Fault(seen.shot.key, FaultKind.UNLIT, f"has {max(0.0, 100 * light / usual):.2g} % of the light of the others")]
        return []

    def _details_stay(self, used: list[tuple[np.float32, Seen]], others: list[Seen]) -> bool:
        """Return whether the pictures from which another is predicted fit their own predictions where they are.

        Where most do not, details move with the lamps, as the highlight of a glossy object without texture does.
        """
        stay, usual = [], float(np.mean([each.sample.blocks.mean() for each in others]))
        for _, each in sorted(used, key=lambda one: -abs(one[0]))[:COMPARED]:
            weights = self._expectation.weights(each, [other for other in others if other is not each])
            if weights is not None:
                stay.append(_moved(each, expected_bands(weights), usual) is None)
        return 2 * sum(stay) >= len(stay)

    def _sound(self) -> list[str]:
        return [key for key, each in self._seen.items() if not each.faults]

    def _others(self, seen: Seen, keys: Collection[str]) -> list[Seen]:
        """Return the pictures that say what another one should be: of other lamps, or of the same levels."""
        return [each for key in keys if key != seen.shot.key and same_kind((each := self._seen[key]).shot, seen.shot)]

    def _leans_on(self, key: str, other: str, keys: Collection[str]) -> bool:
        """Return whether what is expected of a picture depends on another one."""
        seen = self._seen[key]
        if not same_kind(seen.shot, self._seen[other].shot):
            return False
        used = self._expectation.weights(seen, self._others(seen, keys))
        return used is None or any(each.shot.key == other for _, each in used)

    def _dark(self, shot: Shot) -> np.ndarray | float:
        """Return the mean picture without any lamp, [blocks]; 0 where there is none."""
        dark = [each.sample.blocks for each in self._seen.values()
                if not each.faults and _is_dark(each.shot) and comparable(each.shot, shot)]
        found: np.ndarray | float = np.mean(dark, axis=0) if dark else 0.0
        return found


def _is_dark(shot: Shot) -> bool:
    return not shot.projected and not shot.levels.any()


def _ambient(shot: Shot, more: float) -> Fault:
    return Fault(shot.key, FaultKind.AMBIENT, f"has {100 * more:.0f} % of the light of a usual picture more than it should")


def _moved(seen: Seen, expected: Bands, usual: float) -> Fault | None:
    shift = shift_between(seen.bands, expected, usual)
    return None if shift is None else Fault(seen.shot.key, FaultKind.MOVED, "everything is shifted by {:.0f}, {:.0f} pixels".format(*shift))

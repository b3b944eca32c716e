"""Why a scan could not be joined, in words."""

from collections.abc import Iterable, Mapping, Sequence

from service.scans.points.scan import Target
from service.scans.registration.pair_tasks import NOT_THERE
from service.scans.registration.pairs import Pair, PairState


def refusal(number: int, names: Sequence[str], pairs: Iterable[Pair], may_decide: bool) -> str:
    """Return why a scan could not be joined, by the pair that came nearest to it; `may_decide`: it has a start, which does not."""
    own = [pair for pair in pairs if number in (pair.a, pair.b)]
    tried = [pair for pair in own if pair.state is not PairState.NO_POSE]
    if own and all(pair.reason == NOT_THERE for pair in own):
        return "does not overlap the others at the poses that are given"
    if not tried:
        return ("no surface was found that it has in common with the others: it shows another part, too little of the same, or a pattern "
                "that repeats, or its noise is too large")
    ambiguous = [pair for pair in tried if pair.state is PairState.AMBIGUOUS]
    joined = [pair for pair in tried if pair.state is PairState.JOINED]
    best = max(ambiguous or joined or tried, key=lambda pair: pair.overlap)
    other = names[best.b if best.a == number else best.a]
    if best.state is PairState.JOINED:
        return f"is joined with {other} alone, and neither with the largest group of scans"
    advice = {PairState.AMBIGUOUS: ": give its turntable or pose and keep that fixed",
              PairState.CONTRADICTED: ": --starts joins it if its start is right" if may_decide else ""}
    return f"against {other}, {best.reason}{advice.get(best.state, '')}"


def refused_targets(number: int, names: Sequence[str], shown: Mapping[int, Sequence[Target]], pairs: Iterable[Pair]) -> str:
    """Return why the targets of a scan that could not be joined place it against no other, to go behind the reason of its surfaces."""
    tried = [pair for pair in pairs if number in (pair.a, pair.b)]
    if not tried:
        return "; no other scan shows any of its targets" if number in shown else ""
    best = max(tried, key=lambda pair: (pair.fit is not None, pair.overlap))
    return f"; against {names[best.b if best.a == number else best.a]}, {best.reason}" if best.reason else ""

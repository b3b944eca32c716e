"""Reduce a capture to a few coefficient images: for a browser (svd), or for viewers of relightable images (ptm, lrgb-ptm, hsh)."""

from pathlib import Path

from kernels import device as devices
from service.basis.capture import BasisResult, open_capture
from service.basis.rti import make_rti
from service.basis.svd import make_svd
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.requests.basis import BasisKind, BasisRequest

SUFFIXES = {BasisKind.SVD: ".exr", BasisKind.PTM: ".ptm", BasisKind.LRGB_PTM: ".ptm", BasisKind.HSH: ".rti"}
"""The suffix of each kind's file; where no kind is named, the first one with the suffix is made."""


def make_basis(request: BasisRequest, progress: Progress | None = None) -> BasisResult:
    """Reduce a capture to a basis and write it, whole or not at all.

    Raises:
        RequestError: a suffix or a count that the kind does not have, or a result that would replace an input.
    """
    kind = resolve_kind(request.kind, request.out)
    device = devices.resolve(request.device)
    timings = Timings(progress)
    source = open_capture(request, timings)
    if kind == BasisKind.SVD:
        return make_svd(request, source, device, timings)
    return make_rti(request, kind, source, device, timings)


def resolve_kind(kind: BasisKind | None, out: Path) -> BasisKind:
    """Return the kind that is asked for, by name or by the suffix of the file, which must be that of the kind."""
    suffix = out.suffix.lower()
    if kind is None:
        kind = next((k for k, s in SUFFIXES.items() if s == suffix), None)
        if kind is None:
            raise RequestError(f"--out {out}: end the name in .exr (coefficient images), .ptm (polynomial texture map) or .rti "
                               "(hemispherical harmonics)")
    elif suffix != SUFFIXES[kind]:
        raise RequestError(f"--out {out}: end the name in {SUFFIXES[kind]} for --kind {kind}")
    return kind

"""Turn the shots of a scanner on a platform that may move into one cloud in the world: points.ply, .usdc, .las and report.json."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import device as devices
from kernels.device import to_numpy
from kernels.status import SOLVED
from kernels.tof.histogram.pileup import checked
from kernels.tof.histogram.returns import find_returns
from service.asset.usd.depth_asset import write_points
from service.depth.base.solution import srgb_bytes, white_of
from service.depth.passes import compare_passes
from service.depth.tof.count_scale import estimate_count_scale
from service.depth.tof.histograms import live_photons, scale_warnings
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, metadata, report
from service.requests.depth import ScanRequest
from stage.files import write_text
from stage.formats.las import LAS_FILE, las_is_installed, write_las
from stage.formats.ply import POINTS_FILE, PointCloud, write_ply
from stage.stack.fingerprint import Fingerprints
from stage.tof.calibration import TofCalibration
from stage.tof.light_time import range_of_delay_m
from stage.tof.raw_frames import Histograms
from stage.tof.scan import FILE_NAME, Shots, read_scan, world_points

USD_FILE = "points.usdc"
MOST_RETURNS = 4
"""Returns that are looked for in a waveform."""
MOST_STEP_M = 1e-3
"""Distance between floats of 32 bits, metres, above which points are counted from among them: scanners measure to millimetres. It is
reached 16 km from the origin, as on a map."""


class ScanResult(NamedTuple):
    """The files and numbers of a scan that was written."""

    cloud: PointCloud
    points_path: Path
    usd_path: Path
    las_path: Path | None
    """The points.las; None if it was not asked for."""
    report_path: Path
    counts: dict[str, int]
    """Number of shots and points, and of those left out, by reason."""
    warnings: tuple[str, ...]
    """A sentence for each thing that does not fit on the whole scan."""


def scan(request: ScanRequest, progress: Progress | None = None) -> ScanResult:
    """Turn a scan into a point cloud.
    Raises StageError, KernelError: bad input; nothing is written. Raises RequestError: no shot gives a point, or LAS is asked for
    without laspy. Raises StorageError: the results cannot be written."""
    if request.las and not las_is_installed():
        raise RequestError(f"{LAS_FILE} is written with laspy, which is not installed: pip install 'relit[las]'")
    timings = Timings(progress)
    device = devices.resolve(request.device)
    timings.stage("read", 1)
    shots = read_scan(request.scan)
    timings.stage("returns", 1)
    index, range_m, intensity, facts, warnings = _returns(shots, device)
    near, far = request.near_m or 0.0, request.far_m or np.inf
    inside = (range_m >= near) & (range_m <= far) & (range_m > 0)
    timings.stage("place", 1)
    points, covered = world_points(shots, index[inside], range_m[inside])
    index, range_m, intensity, points = index[inside][covered], range_m[inside][covered], intensity[inside][covered], points[covered]
    if len(points) == 0:
        raise RequestError(f"{shots.folder / FILE_NAME}: no shot gives a point: {int((~covered).sum())} lie outside the track in time, "
                           f"{int((~inside).sum())} outside the span of ranges")
    timings.stage("passes", 1)
    passes = compare_passes(shots, index, range_m)
    if passes is not None:
        facts["passes"] = {"apart_m": float(f"{passes.apart_m:.3g}"), "within_m": float(f"{passes.within_m:.3g}")}
        warnings += [sentence for sentence in (passes.warning(),) if sentence]
    shots_used = len(np.unique(index))
    counts = {"shots": len(shots.time_s), "with_points": shots_used, "points": len(points),
              "out_of_range": int((~inside).sum()), "outside_track": int((~covered).sum())}
    colours = srgb_bytes(np.repeat(intensity[None, :, None], 3, axis=2), white_of(intensity), "lin_rec709_scene")[0]
    step = float(np.spacing(np.float32(np.abs(points).max())))
    origin = np.rint(points.mean(axis=0)) if step > MOST_STEP_M else np.zeros(3)
    cloud = PointCloud((points - origin).astype(np.float32), colours, intensity=intensity.astype(np.float32))
    place = ",".join(f"{x:.0f}" for x in origin)
    if origin.any():
        facts["origin_m"] = origin.tolist()
        warnings.append(f"the track lies so far from its origin that floats of 32 bits hold points to {step:.2g} m only: {POINTS_FILE} and "
                        f"{USD_FILE} are counted from {place}{f', {LAS_FILE} is not' if request.las else ''}")
    timings.stage("write", 1)
    names = [FILE_NAME, shots.scan.shots, *(() if shots.scan.waveforms is None else (shots.scan.waveforms.file,))]
    hashes = Fingerprints(shots.folder, request.out / "files.json").of(names)
    sources = metadata(request, capture=shots.scan.name, inputs=" ".join(hashes[name] for name in names), method="scan")
    counted = sources | ({"relit:origin_m": place} if origin.any() else {})
    points_path, usd_path, report_path = (request.out / name for name in (POINTS_FILE, USD_FILE, REPORT_FILE))
    write_ply(cloud, points_path, comments=tuple(f"{key} {value}" for key, value in counted.items()))
    write_points(cloud, usd_path, name=shots.scan.name, provenance=counted)
    las_path = None
    if request.las:
        las_path = request.out / LAS_FILE
        scales = write_las(points, intensity, shots.time_s[index], index, range_m, las_path, provenance=sources)
        facts["las"] = scales._asdict()
    write_text(report_path, report(
        request,
        inputs={"scan": str(request.scan), "name": shots.scan.name, "content": hashes, "poses": len(shots.scan.track)},
        method="scan", found=facts, warnings=warnings,
        device=devices.describe(device), timings_s=timings.close(), shots=counts,
        extent_m={"low": points.min(axis=0).tolist(), "high": points.max(axis=0).tolist()}))
    return ScanResult(cloud, points_path, usd_path, las_path, report_path, counts, tuple(warnings))


def _returns(shots: Shots, device: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, Any], list[str]]:
    """Return shot, range and intensity of each return, facts about them for the report, and a sentence for each thing that does not fit."""
    if shots.waveforms is None:
        assert shots.range_m is not None and shots.intensity is not None  # the reader gives either these or waveforms
        index = np.nonzero(np.isfinite(shots.range_m) & np.isfinite(shots.intensity))[0]
        return index, shots.range_m[index], shots.intensity[index], {"ranges": "as recorded"}, []
    waveforms = shots.scan.waveforms
    assert waveforms is not None
    checked(shots.waveforms)  # faults of the counts come before those of what is estimated from them
    scale = estimate_count_scale(shots.waveforms)
    warnings = scale_warnings(scale)
    photons = (shots.waveforms / np.float32(scale.units)).astype(np.float32)
    recorded = Histograms(shots.waveforms, waveforms.bin_s, waveforms.start_s, waveforms.pulses if waveforms.first_photon_only else None,
                          waveforms.first_photon_only)
    count, bins = photons.shape
    histograms, shape, _ = live_photons(recorded, photons, TofCalibration(), np.zeros(bins, bool), np.ones(count, bool), device, warnings)
    found = find_returns(histograms, shape.pulse, most=MOST_RETURNS)
    there = (to_numpy(found.photons) > 0) & np.isin(to_numpy(found.status), SOLVED)
    number, index = np.nonzero(there)
    time_s = waveforms.start_s + to_numpy(found.position)[number, index].astype(np.float64) * waveforms.bin_s
    facts = {"ranges": "from waveforms", "pulse_sigma_s": float(f"{shape.sigma * waveforms.bin_s:.4g}"),
             "shots_with_several_returns": int(there[1].sum())}
    return index, range_of_delay_m(time_s), to_numpy(found.photons)[number, index], facts, warnings

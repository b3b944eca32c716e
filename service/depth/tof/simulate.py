"""Simulate the capture that a time-of-flight camera would make of a depth, to plan with: simulate, solve, compare."""

from pathlib import Path

import numpy as np

from service.depth.tof.tof import z_per_range
from service.requests.depth import SimulateCwRequest, SimulatePulsedRequest, SimulateRequest
from stage.results.depth_maps import DEPTH_FILE, DepthMaps
from stage.results.depth_normals import depth_normals
from stage.tof.simulate import (
    CorrelationCamera,
    HistogramCamera,
    TofScene,
    correlation_images,
    histograms,
    write_correlations,
    write_histograms,
)
from stage.tof.source import SourcePath
from stage.transforms import pixel_centres


def simulate_tof(request: SimulateCwRequest | SimulatePulsedRequest) -> Path:
    """Write a simulated capture, and return its capture.json."""
    maps = DepthMaps.read(request.depth / DEPTH_FILE if request.depth.is_dir() else request.depth)
    scene, camera = _scene(maps, request), maps.camera
    random = np.random.default_rng(request.seed) if request.noise else None
    name = maps.provenance.get("relit:capture", request.depth.stem)
    if isinstance(request, SimulateCwRequest):
        sensor = CorrelationCamera(modulation_hz=request.modulation_hz, phases=request.phases, signal_electrons=request.signal_electrons,
                                   ambient_electrons=request.ambient_electrons, read_noise_electrons=request.read_noise_electrons,
                                   full_well=request.full_well)
        return write_correlations(request.out, name, correlation_images(scene, sensor, random), camera, sensor, request.source_m)
    counter = HistogramCamera(bins=request.bins, bin_s=request.bin_s, pulse_sigma_s=request.pulse_sigma_s,
                              signal_photons=request.signal_photons, background=request.background, pulses=request.pulses)
    return write_histograms(request.out, name, histograms(scene, counter, random), camera, counter, request.source_m)


def _scene(maps: DepthMaps, request: SimulateRequest) -> TofScene:
    """Return ranges, and cosines from the normals of the depth; pixels without a depth are black, unknown normals face the camera."""
    range_m = np.where(maps.mask, maps.depth / z_per_range(maps.camera), 1.0)
    origins, rays = maps.camera.lines_of_sight(*pixel_centres(maps.camera.width, maps.camera.height))
    normal = depth_normals(maps.depth, maps.mask, maps.camera, sigma=maps.sigma).astype(np.float64)
    known = np.linalg.norm(normal, axis=-1) > 0.5
    path = SourcePath.of(maps.camera, request.source_m)
    if path is None or request.source_m is None:
        to_source, source_range = -rays, None
    else:
        source_range = path.source_range_m(range_m)
        to_source = (np.array(request.source_m) - origins - rays * range_m[..., None]) / source_range[..., None]
    cosine = np.where(known, np.clip((normal * to_source).sum(axis=-1), 0, 1), 1.0)
    return TofScene(range_m=range_m, albedo=np.where(maps.mask, request.albedo, 0.0), cosine=cosine, source_range_m=source_range)

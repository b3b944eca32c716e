"""The general solver on surfaces rendered by an independent float64 model, and its parts against that model."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from kernels import packs
from kernels.errors import ArrayError
from kernels.microfacet import diffuse, ggx, schlick
from kernels.photometric.lambertian.readings import grey_factors, pad_lights
from kernels.photometric.material.material import fit_material
from kernels.photometric.model.candidates import rings
from kernels.photometric.model.samples import gather, host_values, to_host
from kernels.photometric.search.hypotheses import LobeShape, search_normals
from kernels.photometric.search.lobe_shape import FACET_STEP, ROUGH_STEP, SLOPE_STEP, ShapeSpread, choose_lobe_shape
from kernels.photometric.search.normal_search import find_normals
from kernels.photometric.svbrdf import average_normals, doubt_of_shape, nearby_shapes, solve_svbrdf
from tests.kernels.scenes import GREY, bits, store
from tests.reference import hypotheses
from tests.reference import microfacet as twin
from tests.reference.sampling import lattice

LIGHTS = lattice(48, 70.0)
VIEW = np.array([0.0, 0.0, 1.0])
COLOUR = np.array([0.6, 0.35, 0.2])


def tilted(count: int, largest_degrees: float = 50.0) -> np.ndarray:
    """[count, 3] normals, evenly over a cap."""
    return lattice(count, largest_degrees)


def render(normal: np.ndarray, *, albedo=COLOUR, alpha=0.16, f0=0.04, rough=None, slope=0.0, facets=0.0, gamma=twin.GGX,
           lights=LIGHTS) -> np.ndarray:
    """[3, light, pixel] float64 radiance under unit irradiance."""
    n, light = normal[None], lights[:, None]
    shine = twin.specular(n, light, VIEW, alpha, f0, gamma) if f0 is not None else 0.0
    matt = twin.diffuse(n, light, VIEW, rough, slope, facets)
    return np.stack([channel * matt + shine for channel in albedo])


def sample(radiance: np.ndarray, device: str, *, lights=LIGHTS, view=None, saturated=None, field=None):
    """Everything as samples."""
    count, pixels = radiance.shape[1:]
    padded = pad_lights(lights, np.ones((count, 3)))
    band = packs.upload(store(radiance), None if saturated is None else bits(saturated), device=device)
    toward = np.tile(VIEW, (pixels, 1)) if view is None else view
    return gather(band, np.arange(pixels), toward, padded, grey_factors(padded, GREY), count, field), band


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)))


def test_model_agrees_with_the_papers(device):
    """The Warp functions against the float64 twin, over random directions and widths; tolerance: float32 rounding of 1 - a²."""
    rng = np.random.default_rng(3)
    normal = np.array([0.0, 0.0, 1.0])
    light, view = (twin.unit(rng.normal(size=(500, 3)) * [1, 1, 0.4] + [0, 0, 0.8]) for _ in range(2))
    light[:, 2], view[:, 2] = np.abs(light[:, 2]) + 0.02, np.abs(view[:, 2]) + 0.02
    light, view = twin.unit(light), twin.unit(view)
    half = twin.unit(light + view)
    alpha, rough, slope = rng.uniform(0.05, 1, 500), rng.uniform(0, 1, 500), rng.uniform(-0.3, 0.2, 500)
    facets = rng.uniform(0, 0.7, 500)
    rise = (1 - (half * view).sum(-1)) ** 5

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(nl: wp.array(dtype=float), nv: wp.array(dtype=float), nh: wp.array(dtype=float), hv: wp.array(dtype=float),
                 a: wp.array(dtype=float), r: wp.array(dtype=float), s: wp.array(dtype=float),
                 f: wp.array(dtype=float), out: wp.array2d(dtype=float)):
        i = wp.tid()
        out[0, i] = ggx(nl[i], nv[i], nh[i], a[i])
        out[1, i] = diffuse(nl[i], nv[i], hv[i] * hv[i], wp.vec4(r[i], s[i], 0.0, f[i]))
        out[2, i] = schlick(hv[i])
        out[3, i] = diffuse(nl[i], nv[i], hv[i] * hv[i], wp.vec4(-1.0, 0.0, 0.0, 0.0))

    inputs = [light[:, 2], view[:, 2], half[:, 2], (half * view).sum(-1), alpha, rough, slope, facets]
    out = wp.zeros((4, 500), dtype=float, device=device)
    wp.launch(evaluate, dim=500, inputs=[wp.array(v, dtype=float, device=device) for v in inputs], outputs=[out], device=device)
    got = out.numpy()
    lobe = np.array([twin.specular(normal, li, vi, ai, 1.0) for li, vi, ai in zip(light, view, alpha, strict=True)])
    np.testing.assert_allclose(got[0], lobe, rtol=2e-3)
    matt = [twin.diffuse(normal, *each) for each in zip(light, view, rough, slope, facets, strict=True)]
    np.testing.assert_allclose(got[1] / np.pi, matt, rtol=1e-5)
    np.testing.assert_allclose(got[2], rise, atol=1e-6)
    np.testing.assert_allclose(got[3], light[:, 2], rtol=1e-6)


@pytest.mark.parametrize("gamma", [twin.GGX, 18.0, twin.BECKMANN])
@pytest.mark.parametrize("alpha", [0.1, 0.3, 0.8])
def test_distribution_is_normalised(alpha, gamma):
    """∫ D n·h dω = 1 over the hemisphere: the twin itself, by the midpoint rule (tolerance: its step)."""
    angle = (np.arange(20000) + 0.5) / 20000 * np.pi / 2
    total = (twin.distribution(np.cos(angle), alpha, gamma) * np.cos(angle) * np.sin(angle)).sum() * 2 * np.pi * np.pi / 2 / 20000
    assert total == pytest.approx(1, abs=1e-4)


def test_gathered_readings(device):
    """Gathered grey and colour readings are radiance / irradiance; saturated ones are marked, padded lanes repeat the last pixel."""
    normal = tilted(37)
    radiance = render(normal)
    saturated = np.zeros(radiance.shape[1:], dtype=bool)
    saturated[3, 5] = True
    samples, _ = sample(radiance, device, saturated=saturated)
    grey, red = (host_values(samples, values).T for values in (samples.grey, samples.colour[0]))
    level = to_host(samples, samples.level)
    stored = store(radiance)[:, :len(LIGHTS)].astype(np.float64)
    expected = np.einsum("c,clp->lp", GREY, stored)
    keep = ~saturated
    np.testing.assert_allclose((grey * level)[keep], expected[keep], rtol=1e-5)  # float32
    assert grey[3, 5] < 0
    np.testing.assert_allclose(red[keep], stored[0][keep], rtol=1e-5)
    assert red[3, 5] < 0
    assert (level > 0).all()


def test_gather_refuses(device):
    samples, band = sample(render(tilted(4)), device)
    lights = pad_lights(LIGHTS, np.ones((48, 3)))
    factors = grey_factors(lights, GREY)
    for pixels in (np.array([], dtype=int), np.array([-1]), np.array([band.pixel_count])):
        with pytest.raises(ArrayError, match="pixels must be"):
            gather(band, pixels, np.tile(VIEW, (len(pixels), 1)), lights, factors, 48)
    with pytest.raises(ArrayError, match="view is"):
        gather(band, np.arange(3), np.tile(VIEW, (2, 1)), lights, factors, 48)
    with pytest.raises(ArrayError, match="start is"):
        find_normals(samples, np.tile(VIEW, (3, 1)), shape=LobeShape())


def test_rings_lie_at_their_angles():
    offsets = rings((2.0, 5.0), 12)
    assert offsets[0].tolist() == [0, 1, 1, 0]
    np.testing.assert_allclose(np.hypot(offsets[:, 0], offsets[:, 1]), 1, atol=1e-6)
    angles = np.degrees(np.arctan2(offsets[:, 0], offsets[:, 1]))
    assert sorted({round(float(a), 3) for a in angles}) == [0.0, 2.0, 5.0]


@pytest.mark.parametrize(("surface", "blocked", "median", "largest"), [
    ({"alpha": 0.1}, 0.0, 0.25, 1.0), ({"alpha": 0.25}, 0.0, 0.25, 1.0), ({"alpha": 0.5, "f0": 0.08}, 0.0, 0.25, 1.0),
    ({"alpha": 0.25, "f0": None}, 0.0, 0.25, 1.0), ({"alpha": 0.25, "f0": 0.7, "albedo": np.zeros(3)}, 0.0, 0.4, 180),
    ({"alpha": 0.25}, 0.33, 0.3, 180)], ids=["gloss", "satin", "rough", "matt", "metal", "cast shadows"])
def test_normals_of_every_surface(device, surface, blocked, median, largest):
    """Closed-form pixels: the normal is found to the last ring of 0.2°, for lobes between the mixture's widths too, which are a mixture of
    both, not quite of their shape. On a metal the lobe alone says it; a third of the lights, at random, hardly matters, because what a
    shadow costs is the same for every candidate. A start 12° off is far from the answer and well inside the first rings."""
    normal = tilted(150)
    radiance = render(normal, **surface)
    radiance = radiance * (np.random.default_rng(5).random(radiance.shape[1:]) >= blocked)
    start = twin.unit(normal + 0.21 * np.array([0.6, -0.8, 0.0]))
    error = degrees(find_normals(sample(radiance, device)[0], start, shape=LobeShape()).best.normal, normal)
    assert np.median(error) < median and error.max() < largest


def test_saturated_readings_take_no_part(device):
    """Readings cut off by the sensor and marked as such change nothing, whatever they say."""
    normal = tilted(64)
    radiance = render(normal, alpha=0.12, f0=0.3)
    saturated = radiance[1] > np.quantile(radiance[1], 0.95, axis=0)
    spoiled = np.where(saturated, 0.7 * radiance, radiance)
    start = twin.unit(normal + [0.05, 0.05, 0])
    clean = find_normals(sample(radiance, device, saturated=saturated)[0], start, shape=LobeShape()).best
    cut = find_normals(sample(spoiled, device, saturated=saturated)[0], start, shape=LobeShape()).best
    np.testing.assert_array_equal(clean.normal, cut.normal)


def test_perspective_views(device):
    """Each pixel has a view of its own; the highlight moves with it."""
    rng = np.random.default_rng(8)
    normal = tilted(80, 30.0)
    view = twin.unit(np.array([0, 0, 1.0]) + rng.uniform(-0.3, 0.3, (80, 3)) * [1, 1, 0])
    radiance = np.stack([c * twin.diffuse(normal[None], LIGHTS[:, None], view[None])
                         + twin.specular(normal[None], LIGHTS[:, None], view[None], 0.15, 0.3) for c in COLOUR])
    found = find_normals(sample(radiance, device, view=view)[0], twin.unit(normal + [0.1, 0, 0]), shape=LobeShape()).best
    assert np.median(degrees(found.normal, normal)) < 0.3
    wrong = find_normals(sample(radiance, device)[0], twin.unit(normal + [0.1, 0, 0]), shape=LobeShape()).best
    assert np.median(degrees(wrong.normal, normal)) > 0.5  # it matters


@pytest.mark.parametrize(("rough", "slope", "facets"), [(None, 0.0, 0.0), (0.5, 0.0, 0.0), (0.1, -0.2, 0.0), (None, 0.0, 0.44)])
def test_the_lobe_shape_is_recovered(device, rough, slope, facets):
    """The object as a whole says which diffuse lobe it has; normals gain by it. Half a degree: the shapes tried are 0.075 in
    roughness, 0.05 in slope and 0.1 in facets apart."""
    normal = tilted(200, 65.0)
    samples, _ = sample(render(normal, alpha=0.25, rough=rough, slope=slope, facets=facets), device)
    shape, _, _, tried = choose_lobe_shape(samples, twin.unit(normal + [0.03, 0.02, 0]))
    assert tried[shape] == min(tried.values())
    chosen = degrees(find_normals(samples, normal, shape=shape).best.normal, normal)
    assert np.median(chosen) < 0.5
    assert shape.facets == pytest.approx(facets, abs=FACET_STEP)
    if rough is None and not facets:
        assert shape == LobeShape()
    else:
        lambert = degrees(find_normals(samples, normal, shape=LobeShape()).best.normal, normal)
        assert np.median(chosen) < 0.5 * np.median(lambert)


@pytest.mark.parametrize("slope", [-0.13, 0.025])
def test_a_slope_between_those_tried_is_found(device, slope):
    """Halving the step thrice finds it to a sixteenth of a step of .05. The nearest slope of the grid is .4 and .5 steps off, and turns
    normals by .2 degrees in place of .02."""
    normal = tilted(200, 65.0)
    samples, _ = sample(render(normal, f0=None, slope=slope), device)
    _, mean, spread, _ = choose_lobe_shape(samples, twin.unit(normal + [0.03, 0.02, 0]))
    assert abs(mean.slope - slope) < SLOPE_STEP / 5
    assert spread.errors(0.0)[1] < SLOPE_STEP / 5
    assert np.median(degrees(find_normals(samples, normal, shape=mean).best.normal, normal)) < 0.05


@pytest.mark.parametrize("surface", [{"alpha": 0.2, "f0": 0.05}, {"albedo": (0, 0, 0), "alpha": 0.3, "f0": 0.8}], ids=["paint", "metal"])
def test_highlights_without_tails_are_recognised(device, surface):
    """Under Beckmann's distribution the lobes with short tails are chosen. Measured are .27° for .48° of GGX's lobes, and 1.7° for 3.6°."""
    normal = tilted(200, 45.0)
    samples, _ = sample(render(normal, gamma=twin.BECKMANN, **surface), device)
    shape = choose_lobe_shape(samples, twin.unit(normal + [0.03, 0.02, 0])).mean
    assert shape.short_tails
    error, under_ggx = (degrees(find_normals(samples, normal, shape=each).best.normal, normal).mean()
                        for each in (shape, replace(shape, short_tails=False)))
    assert error < 0.7 * under_ggx


GOLD = np.array([0.9, 0.7, 0.3])


@pytest.mark.parametrize(("albedo", "f0", "roughness", "within"), [
    (COLOUR, 0.04, 0.3, (0.01, 0, 0.06)), (COLOUR, 0.06, 0.5, (0.01, 0, 0.06)), (COLOUR, 0.04, 0.7, (0.01, 0, 0.06)),
    (0 * COLOUR, GOLD, 0.5, (0, 0.01, 0.02)), (COLOUR, None, None, (0.03, 0, 0.02))], ids=["smooth", "satin", "rough", "metal", "matt"])
def test_material_under_known_normals(device, albedo, f0, roughness, within):
    """Albedo, F0 and roughness come back; tolerance: the roughness resolution of 0.01 and half rounding. Without a highlight F0 is near
    zero; Schlick's rise stays, as in every renderer, so a trace of it may be taken from the albedo."""
    normal = tilted(64, 45.0)
    radiance = np.concatenate([render(normal, albedo=[matt], alpha=(roughness or 1) ** 2, f0=shine)
                               for matt, shine in zip(albedo, np.broadcast_to(f0, 3), strict=True)])
    material = fit_material(sample(radiance, device)[0], normal, shape=LobeShape())
    relative, absolute, of_f0 = within
    np.testing.assert_allclose(np.median(material.diffuse_albedo, axis=0), albedo, rtol=relative, atol=absolute)
    np.testing.assert_allclose(np.median(material.specular, axis=0), 0 if f0 is None else f0, rtol=of_f0, atol=0.02 * (f0 is None))
    if roughness is not None:
        np.testing.assert_allclose(np.median(material.roughness), roughness, atol=0.012)


def test_whole_solve_scales_and_never_gives_nan(device):
    """Doubling the light doubles the albedo and leaves normal, F0's share and roughness; dark and odd pixels stay finite."""
    normal = tilted(40)
    radiance = render(normal, alpha=0.2)
    radiance[:, :, 7] = 0.0
    radiance[:, :, 8] *= np.arange(48)[:, None].T.reshape(-1) == 3  # a single lit reading
    start = twin.unit(normal + [0.05, 0, 0])
    once = solve_svbrdf(sample(radiance, device)[0], start, shape=LobeShape())
    for values in once:
        assert np.isfinite(values).all()
    good = np.setdiff1d(np.arange(40), [7, 8])
    assert np.median(degrees(once.normal, normal)[good]) < 0.3
    assert (once.sigma > 0).all()
    half = solve_svbrdf(sample(0.5 * radiance, device)[0], start, shape=LobeShape())
    np.testing.assert_allclose(half.normal[good], once.normal[good], atol=2e-3)
    np.testing.assert_allclose(np.median(half.diffuse_albedo[good] / once.diffuse_albedo[good]), 0.5, rtol=0.02)


def test_average_of_normals():
    """Equal costs give the mean direction; a shape that costs far more has no say."""
    a, b = np.array([[0.0, 0.0, 1.0]]), twin.unit(np.array([[0.1, 0.0, 1.0]]))
    mean, spread = average_normals(np.stack([a, b]), np.array([[0.1], [0.1]]), temperature=0.4)
    np.testing.assert_allclose(mean, twin.unit(a + b), atol=1e-6)
    assert spread[0] == pytest.approx(np.degrees(np.arctan(0.1)) / 2, rel=1e-2)
    alone, none = average_normals(np.stack([a, b]), np.array([[0.1], [10.0]]), temperature=0.4)
    np.testing.assert_allclose(alone, a, atol=1e-6)
    assert none[0] < 0.05


def test_a_doubtful_shape_turns_normals_by_its_errors():
    """One pixel is turned by 3 and 5° where the slope is a tenth less and more, and by 6° where the lobe is rougher by 0.15: errors of
    0.05 and 0.1 are worth half of the RMS of the former and two thirds of the latter."""
    turned = np.radians([[0.0, 3.0, -5.0, 6.0]])
    normals = np.stack([np.sin(turned), np.zeros_like(turned), np.cos(turned)], axis=-1).swapaxes(0, 1)
    found = doubt_of_shape(normals, [(0.0, -0.1, 0.0), (0.0, 0.1, 0.0), (0.15, 0.0, 0.0)], (0.1, 0.05, 0.1))
    np.testing.assert_allclose(found, np.hypot(np.sqrt(17) / 2, 4), rtol=1e-5)


def test_the_error_of_a_mean_shape_is_its_spread_where_misfit_is_shared():
    """Noise that no neighbours share leaves half a step of the search."""
    spread, steps = ShapeSpread(0.3, 0.2, 0.1), np.array([ROUGH_STEP, SLOPE_STEP, FACET_STEP])
    np.testing.assert_allclose(spread.errors(1.0), np.hypot(spread[:3], steps / np.sqrt(12)))
    assert (np.array(spread.errors(0.0)) < steps / 2).all()


def test_nearby_shapes_are_lobes():
    """Lambert's lobe varies in slope alone, with facets in these too, and no roughness is below 0."""
    assert nearby_shapes(LobeShape(slope=-0.1)) == [LobeShape(slope=-0.2), LobeShape(slope=0.0)]
    assert sorted(shape.rough for shape in nearby_shapes(LobeShape(rough=0.1))) == [0.1, 0.1, 0.25]
    assert len(nearby_shapes(LobeShape(rough=0.5))) == 4
    assert sorted(shape.facets for shape in nearby_shapes(LobeShape(facets=0.1))) == [0.0, 0.1, 0.1, 0.25]


@pytest.mark.parametrize(("rough", "slope"), [(None, 0.0), (0.4, -0.1)])
def test_cost_agrees_with_the_twin(device, rough, slope):
    """One candidate, judged by the kernel and by NumPy in float64, on noisy, shadowed, partly saturated readings of wrong normals.

    Tolerance: float32 sums through five rounds of re-weighting; a reading at the very edge of being a shadow may fall either way.
    """
    rng = np.random.default_rng(4)
    normal = tilted(120)
    radiance = render(normal, alpha=0.2, f0=0.1, rough=rough, slope=slope)
    radiance = radiance * rng.lognormal(0, 0.05, radiance.shape[1:]) * (rng.random(radiance.shape[1:]) > 0.1)
    saturated = rng.random(radiance.shape[1:]) < 0.02
    samples, _ = sample(radiance, device, saturated=saturated)
    candidate = twin.unit(normal + rng.normal(0, 0.1, normal.shape)).astype(np.float32)
    shape = LobeShape(rough=-1.0 if rough is None else rough, slope=slope)
    found = search_normals(samples, candidate, shape=shape, wide=((), 1), fine=())
    np.testing.assert_allclose(found.normal, candidate, atol=1e-6)
    readings = host_values(samples, samples.grey).astype(np.float64)
    assert (readings < 0).sum() == saturated.sum()
    expected = hypotheses.cost(readings, candidate.astype(np.float64), LIGHTS, np.tile(VIEW, (120, 1)), rough=rough, slope=slope)
    close = np.abs(found.cost - expected) < 1e-3 * (expected + 0.01)
    assert close.mean() > 0.97
    assert np.median(expected) > 0.02  # the data is not trivial

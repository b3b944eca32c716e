"""Normals from spherical gradients: Lambertian and GGX surfaces integrated numerically, separation, unsolvable pixels."""

import numpy as np
import pytest

from kernels import packs
from kernels.errors import ArrayError
from kernels.photometric.gradient.gradient import diffuse_normals
from kernels.photometric.gradient.highlight import fit_highlights, specular_normals
from kernels.photometric.gradient.moments import fit_moments
from kernels.photometric.gradient.separation import HIDDEN_TILT, separate_by_colour, separate_polarised
from kernels.status import Status
from tests.kernels.scenes import GREY, HALF_ROUNDING, angle_degrees, bits, colours, store
from tests.marks import first_short
from tests.reference import gradient as reference
from tests.reference.sampling import lattice

PAIRS = tuple((axis, sign) for axis in "xyz" for sign in (1, -1))
THREE_AND_FULL = (("x", 1), ("y", 1), ("z", 1), ("full", 1))
MIXTURE = (("x", 1), ("y", -1), ("z", 1), ("z", -1), ("full", 1), ("x", 1))
SETS = {"pairs": PAIRS, "three and full": THREE_AND_FULL, "mixture": MIXTURE}
VIEW = np.array([0.0, 0.0, 1.0])
TO_CAMERA = VIEW.astype(np.float32)[:, None]


def rows_of(frames, before: int = 0) -> np.ndarray:
    """[lights padded, 4] for frames that follow `before` others in the stack."""
    rows = np.zeros((-(-(before + len(frames)) // 8) * 8, 4))
    for index, (axis, sign) in enumerate(frames):
        rows[before + index, 0] = 1 if axis == "full" else 0.5
        if axis != "full":
            rows[before + index, 1 + "xyz".index(axis)] = sign / 2
    return rows


def lambert_shading(normal: np.ndarray, frames) -> np.ndarray:
    """[frame, pixel] radiance of albedo one, by quadrature."""
    return np.array([[reference.lambert(n, axis, sign) for n in normal] for axis, sign in frames])


def lobe_shading(normal: np.ndarray, frames, *, roughness: float, f0: float) -> np.ndarray:
    """[frame, pixel] radiance of a GGX lobe, by quadrature."""
    return np.array([[reference.ggx(n, VIEW, axis, sign, alpha=roughness**2, f0=f0, nodes=30, turns=48) for n in normal]
                     for axis, sign in frames])


def tinted(shading: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """[3, frame, pixel] of shading [frame, pixel] and colour [pixel, 3]."""
    return np.einsum("fp,pc->cfp", shading, colour)


def upload(radiance: np.ndarray, device: str, saturated=None) -> packs.Band:
    return packs.upload(store(radiance), None if saturated is None else bits(saturated), device=device)


def moments(band: packs.Band, frames, before: int = 0):
    rows = np.zeros((band.frame_count, 4))
    part = rows_of(frames, before)
    rows[: len(part)] = part
    return fit_moments(band, rows, np.ones(band.frame_count), GREY)


def diffuse(band: packs.Band, responses, gain: float = 1.0):
    """The fit as arrays without padding."""
    count = band.pixel_count
    fit = diffuse_normals(responses, GREY, gain=gain, pixel_count=count, device=band.device)
    return type(fit)(*(array.numpy()[..., :count].T for array in fit))


def specular(band: packs.Band, parts, gain: float = 1.0, view: np.ndarray = TO_CAMERA) -> np.ndarray:
    normal = specular_normals(parts, GREY, view, gain=gain, pixel_count=band.pixel_count, device=band.device)
    return normal.numpy()[:, : band.pixel_count].T


def rounding_bound(shading: np.ndarray, frames) -> np.ndarray:
    """[pixel] degrees that half rounding can turn a normal by: readings by 2⁻¹¹ of themselves, through the inverse, over |M|."""
    inverse = np.linalg.pinv(rows_of(frames)[: len(frames)])
    return np.degrees(1.5 * HALF_ROUNDING * np.linalg.norm(np.abs(inverse[1:]) @ shading, axis=0))


@first_short("name", SETS)
def test_a_lambertian_surface_is_exact(device, name):
    """Integrated over the sphere of light; the bound is half rounding alone and 0.01 degrees for the rest."""
    frames, normal = SETS[name], lattice(70, 90)
    shading = lambert_shading(normal, frames)
    albedo = colours(len(normal))
    band = upload(tinted(shading, albedo), device)
    fit = diffuse(band, moments(band, frames))
    assert (fit.status == Status.OK).all()
    assert (angle_degrees(fit.normal, normal) < rounding_bound(shading, frames) + 0.01).all()
    assert np.allclose(fit.albedo, albedo, rtol=4 * HALF_ROUNDING)  # M₀ of a fit to four readings takes up three of their errors
    assert np.allclose(fit.length, 1, atol=0.01)
    assert (fit.sigma < 4).all()


def test_the_fit_is_that_of_least_squares_in_float64(device):
    """On readings that no surface gives, so that the residual counts too."""
    radiance = np.random.default_rng(3).uniform(0.1, 1, (3, len(MIXTURE), 40)).astype(np.float16).astype(np.float64)
    band = upload(radiance, device)
    got = moments(band, MIXTURE)
    truth = np.array([[reference.fit(radiance[c, :, p], MIXTURE) for p in range(40)] for c in range(3)])
    assert np.allclose(got.values.numpy()[:, :40].reshape(3, 4, 40).transpose(0, 2, 1), truth, atol=1e-5)
    grey = np.einsum("c,cfp->fp", GREY, radiance)
    grey_truth = np.array([reference.fit(grey[:, p], MIXTURE) for p in range(40)])
    off = grey - rows_of(MIXTURE)[: len(MIXTURE)] @ grey_truth.T
    assert np.allclose(got.residual.numpy()[:40], np.sqrt((off**2).mean(axis=0)) / grey_truth[:, 0], rtol=1e-3, atol=1e-5)
    assert (got.spare.numpy()[:40] == 2).all()
    covariance = np.linalg.inv(rows_of(MIXTURE).T @ rows_of(MIXTURE))
    assert np.allclose(got.variance.numpy()[:40], np.trace(covariance[1:, 1:]) / 3)


def test_contradiction_and_occlusion_raise_the_standard_error(device):
    normal = np.tile(lattice(1, 40), (3, 1))
    shading = lambert_shading(normal, PAIRS)
    shading[0, 1] *= 1.1  # one frame of a pair too bright
    shading[:, 2] = shading[:, 2] * 0.9 + 0.05  # a tenth of the light comes from neighbours, from every side alike
    band = upload(tinted(shading, np.full((3, 3), 0.5)), device)
    fit = diffuse(band, moments(band, PAIRS))
    assert fit.sigma[0] < 1.5 and (1 + fit.sigma[1:] > (1 + fit.sigma[0]) / 0.6).all()
    assert fit.length[2] == pytest.approx(0.9, abs=2e-3)


@first_short("f0", [0.04, 0.6])
@first_short(("roughness", "lean"), [
    (0.1, (0.04, 0.03)), (0.3, (0.38, 1.37)), (0.7, (9.9, 16.2)),
])
def test_polarisation_tells_diffuse_and_specular_apart(device, roughness, lean, f0):
    """Up to 60 degrees from the view. The halfway vector is off by the lean of the lobe (docs/methods.md); a lobe fitted to the
    responses is off by half rounding of parallel - cross, of which a dielectric's highlight is a tenth, and by table steps."""
    normal = lattice(30, 60)
    cross = tinted(lambert_shading(normal, PAIRS), 0.5 * colours(30))
    parallel = cross + lobe_shading(normal, PAIRS, roughness=roughness, f0=f0)
    band = upload(np.concatenate([cross, parallel], axis=1), device)
    half_diffuse, half_and_highlight = moments(band, PAIRS), moments(band, PAIRS, before=len(PAIRS))
    parts = separate_polarised(half_diffuse, half_and_highlight, GREY, pixel_count=30, device=device)
    fit = diffuse(band, parts.diffuse, gain=2.0)
    assert angle_degrees(fit.normal, normal).max() < 0.1  # half rounding
    assert np.allclose(fit.albedo, colours(30), rtol=4 * HALF_ROUNDING)
    assert angle_degrees(specular(band, parts, gain=2.0), normal).max() < lean[f0 > 0.5] + 0.2
    lobe = fit_highlights(parts, GREY, TO_CAMERA, gain=2.0, pixel_count=30, device=device)
    assert angle_degrees(lobe.normal.numpy()[:, :30].T, normal).max() < 0.4
    assert np.allclose(lobe.f0.numpy()[:, :30], f0, atol=0.002, rtol=0.005)
    # |M|/M0 is flat near a mirror: 0.002 of it are 0.05 of roughness there
    assert np.allclose(lobe.roughness.numpy()[:30], roughness, atol=0.05 if roughness < 0.2 else 0.02)


def test_metal_keeps_its_colour_and_no_highlight_is_no_specular(device):
    normal = lattice(20, 50)
    lobe = lobe_shading(normal, PAIRS, roughness=0.3, f0=0.5)
    cross = np.full((3, 6, 20), 0.2) * (0.5 + normal[:, 2])
    red = lobe_shading(normal, PAIRS, roughness=0.3, f0=0.9)
    band = upload(np.concatenate([cross, cross + np.stack([red, lobe, lobe]), cross], axis=1), device)
    dull, shiny = moments(band, PAIRS), moments(band, PAIRS, before=6)
    parts = separate_polarised(dull, shiny, GREY, pixel_count=20, device=device)
    found = fit_highlights(parts, GREY, TO_CAMERA, gain=2.0, pixel_count=20, device=device)
    assert np.allclose(found.f0.numpy()[:, :20], [[0.9], [0.5], [0.5]], atol=0.01)
    none = separate_polarised(dull, moments(band, PAIRS, before=12), GREY, pixel_count=20, device=device)
    found = fit_highlights(none, GREY, TO_CAMERA, gain=2.0, pixel_count=20, device=device)
    assert not found.normal.numpy().any() and not found.f0.numpy().any() and (found.roughness.numpy()[:20] == 1).all()


def test_a_perspective_mirror_shows_its_normal(device):
    """A mirror reads the gradient at its mirror direction: the halfway vector is exact, whatever the view."""
    normal = lattice(40, 50)
    view = -np.random.default_rng(1).normal([0, 0, -4], 0.5, (40, 3))
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    mirror = 2 * (normal * view).sum(axis=1, keepdims=True) * normal - view
    lobe = np.array([reference.radiance_of(mirror, axis, sign) for axis, sign in PAIRS])
    cross = np.full((3, 6, 40), 2.0**-6)
    band = upload(np.concatenate([cross, cross + lobe], axis=1), device)
    parts = separate_polarised(moments(band, PAIRS), moments(band, PAIRS, before=6), GREY, pixel_count=40, device=device)
    assert angle_degrees(specular(band, parts, 2.0, view.T.astype(np.float32)), normal).max() < 0.1  # half rounding


def test_a_rough_lobe_seen_in_perspective(device):
    """The lobe is fitted about each pixel's own line of sight, whatever its plane of incidence."""
    normal = lattice(20, 40)
    view = -np.random.default_rng(2).normal([0, 0, -4], 0.8, (20, 3))
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    lobe = np.array([[reference.ggx(n, v, axis, sign, alpha=0.16, f0=0.3, nodes=60, turns=90)
                      for n, v in zip(normal, view, strict=True)] for axis, sign in PAIRS])
    cross = np.full((3, 6, 20), 2.0**-6)
    band = upload(np.concatenate([cross, cross + lobe], axis=1), device)
    parts = separate_polarised(moments(band, PAIRS), moments(band, PAIRS, before=6), GREY, pixel_count=20, device=device)
    found = fit_highlights(parts, GREY, view.T.astype(np.float32), gain=2.0, pixel_count=20, device=device)
    assert angle_degrees(found.normal.numpy()[:, :20].T, normal).max() < 0.2  # half rounding, and the steps of the table
    assert np.allclose(found.f0.numpy()[:, :20], 0.3, rtol=0.01) and np.allclose(found.roughness.numpy()[:20], 0.4, atol=0.01)


@pytest.mark.long
def test_colour_tells_them_apart_on_a_dielectric(device):
    """Without separation the highlight tilts the normal towards the mirror direction; the chromatic part does not know it."""
    normal = lattice(40, 60)
    albedo = np.random.default_rng(5).permuted(np.tile([0.7, 0.4, 0.15], (40, 1)), axis=1)
    shading = tinted(lambert_shading(normal, PAIRS), albedo) + lobe_shading(normal, PAIRS, roughness=0.2, f0=0.04)
    band = upload(shading, device)
    mixed = moments(band, PAIRS)
    parts = separate_by_colour(mixed, TO_CAMERA, pixel_count=40, device=device)
    fit = diffuse(band, parts.diffuse)
    chroma = 0.4  # of these albedos: rounding of a half reading is multiplied by its inverse
    assert angle_degrees(fit.normal, normal).max() < 0.1 / chroma
    assert angle_degrees(diffuse(band, mixed).normal, normal).max() > 3
    # what the lobe, 0.98 concentrated, still gives where the gradient is dark: 2 % of 0.07, over 1 - 2/3
    assert np.allclose(fit.albedo, albedo, atol=0.006)
    assert np.median(angle_degrees(specular(band, parts), normal)) < 0.5  # that light, taken for diffuse, leans the rest too
    assert angle_degrees(specular(band, parts), normal).max() < 1.0


def test_grey_is_ambiguous_and_says_so(device):
    normal = lattice(10, 40)
    shading = tinted(lambert_shading(normal, PAIRS), np.full((10, 3), 0.5))
    band = upload(shading, device)
    mixed = moments(band, PAIRS)
    parts = separate_by_colour(mixed, TO_CAMERA, pixel_count=10, device=device)
    assert np.array_equal(parts.diffuse.values.numpy(), mixed.values.numpy())
    assert (parts.diffuse.tilt.numpy()[:10] == np.float32(HIDDEN_TILT)).all()
    assert not parts.specular.numpy().any() and not specular(band, parts).any()
    assert (diffuse(band, parts.diffuse).sigma > 5.2).all()


def test_pixels_that_cannot_be_solved_say_why(device):
    normal = np.tile([[0.6, 0.0, 0.8]], (7, 1))
    radiance = tinted(lambert_shading(normal, PAIRS), np.full((7, 3), 0.5))
    radiance[:, :, 1] = 0
    radiance[:, :, 2] = 0.3  # as bright from every side
    radiance[:, :, 3] = -0.1
    radiance[1, 0, 4] = np.nan
    radiance[:, :, 5] = np.inf
    saturated = np.zeros((6, 7), bool)
    saturated[2:4, 6] = True  # both signs of y
    band = upload(radiance, device, saturated)
    responses = moments(band, PAIRS)
    fit = diffuse(band, responses)
    expected = ["OK", "DARK", "ILL_POSED", "DARK", "OK", "TOO_FEW_LIGHTS", "TOO_FEW_LIGHTS"]
    assert [Status(code).name for code in fit.status] == expected
    unsolved = fit.status != Status.OK
    for array in (*responses, *fit):
        values = array if isinstance(array, np.ndarray) else array.numpy()
        assert np.isfinite(values).all()
    assert not fit.normal[unsolved].any() and not fit.albedo[unsolved].any() and not fit.sigma[unsolved].any()
    # one saturated or missing frame of a pair costs nothing but certainty
    assert angle_degrees(fit.normal, normal)[[0, 4]].max() < 0.1
    parts = separate_polarised(responses, responses, GREY, pixel_count=7, device=device)
    assert not specular(band, parts).any()
    by_colour = separate_by_colour(responses, TO_CAMERA, pixel_count=7, device=device)
    assert all(np.isfinite(array.numpy()).all() for array in (*by_colour.diffuse, by_colour.specular))


def test_calls_that_do_not_fit(device):
    band = upload(np.ones((3, 6, 4)), device)
    good = rows_of(PAIRS)
    with pytest.raises(ArrayError, match="the band has 8 lights: give one for each"):
        fit_moments(band, good[:6], np.ones(6), GREY)
    with pytest.raises(ArrayError, match="rows are all zero"):
        fit_moments(band, 0 * good, np.ones(8), GREY)
    with pytest.raises(ArrayError, match="several axes"):
        fit_moments(band, good + np.array([0, 1, 1, 0]), np.ones(8), GREY)
    with pytest.raises(ArrayError, match=r"view is \(3, 2\), the band has 4 pixels"):
        separate_by_colour(moments(band, PAIRS), np.ones((3, 2), np.float32), pixel_count=4, device=device)

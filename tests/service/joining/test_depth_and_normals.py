"""Depth and normals joined."""


import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from benchmarks.trials.declared import surface
from kernels.errors import ArrayError
from service.joining.depth_and_normals import Joined, join_depth
from service.light_estimation.lambertian import degrees_between
from tests.marks import first_short
from tests.scenes.joined import MM, View, drifting, see

LEAST_RATIO, NORMAL_RATIO = 0.5, 1.1
"""Largest error of the joined height over that of the depth (0.06 to 0.35 in all cases here), and of its normals over those given."""
SIGMA, NOISE, SIZE = 0.4 * MM, 0.5, 96


def join(view: View, *, noise: float, drift: float, sigma: float, device: str, seen: np.ndarray | None = None, seed: int = 0,
         depth: np.ndarray | None = None) -> tuple[Joined, np.ndarray]:
    given = drifting(view.normal, noise=noise, drift=drift, seed=seed)
    everywhere = np.ones(view.z.shape, dtype=bool)
    if depth is None:
        depth = -view.z + sigma * np.random.default_rng(seed + 1).standard_normal(view.z.shape)
    joined = join_depth(given, np.full(view.z.shape, np.radians(noise)), everywhere, depth, np.full(view.z.shape, sigma),
                        everywhere if seen is None else seen, view.x, view.y, perspective=view.perspective, device=device)
    return joined, given


@first_short("perspective", [False, True])
@first_short(("noise", "drift", "sigma"), [(2, 3, 0.1 * MM), (0.5, 2, 0.5 * MM), (0.5, 0, 0.5 * MM), (0.2, 4, 2 * MM)])
@first_short("shape", ["wave", "disc"])
def test_better_than_the_depth_and_no_worse_than_the_normals(device, shape, noise, drift, sigma, perspective):
    view = see(shape, perspective=perspective)
    joined, given = join(view, noise=noise, drift=drift, sigma=sigma, device=device)
    error = joined.height - view.z
    sure = ~joined.guessed & ~joined.rejected & joined.placed
    assert sure.mean() > 0.99
    assert np.sqrt((error[sure] ** 2).mean()) <= LEAST_RATIO * sigma
    assert degrees_between(joined.normal, view.normal)[sure].mean() <= NORMAL_RATIO * degrees_between(given, view.normal)[sure].mean()
    assert (np.abs(error) <= 3 * joined.sigma)[sure].mean() >= 0.95  # 0.9973 if neighbours did not err alike


@first_short("perspective", [False, True])
def test_a_tilted_disc_before_a_plane_keeps_both_and_their_distance(device, perspective):
    view = see("disc", perspective=perspective)
    joined, _ = join(view, noise=0.5, drift=0, sigma=0.5 * MM, device=device)
    before = np.abs(view.z + 0.5) > 20 * MM
    assert len(np.unique(joined.part)) == 2
    assert len(np.unique(joined.part[before])) == 1 and len(np.unique(joined.part[~before])) == 1
    assert np.abs(joined.height - view.z).max() < 0.5 * MM  # the noise of one depth, at the worst of all pixels


WAVE = see("wave")


def ripple(depth):
    return depth + MM * np.sin(np.arange(depth.shape[1]) / 9)


@first_short(("depth", "normals", "most"), [
    (lambda depth: depth + 4 * SIGMA * np.random.default_rng(7).standard_normal(depth.shape), 1.0, 0.2 * MM),
    (ripple, 2.0, 0.5 * MM),
    (lambda depth: np.round(depth / (2 * MM)) * 2 * MM, 2.0, 0.2 * MM),
    (lambda depth: gaussian_filter(depth, 4), 1.5, 0.2 * MM),
    (lambda depth: np.roll(depth, 3, axis=1), 1.5, 0.2 * MM),
], ids=["σ a quarter of the noise", "ripple", "steps of 2 mm", "smoothed", "shifted by 3 px"])
def test_a_depth_that_is_worse_than_its_sigma_says_neither_bends_normals_nor_is_believed(device, depth, normals, most):
    noise = SIGMA * np.random.default_rng(2).standard_normal(WAVE.z.shape)
    joined, _ = join(WAVE, noise=0.5, drift=1, sigma=SIGMA, device=device, depth=depth(-WAVE.z) + noise)
    sure = ~joined.guessed & ~joined.rejected & joined.placed
    error = np.abs(joined.height - WAVE.z)[sure]
    assert sure.mean() > 0.95 and degrees_between(joined.normal, WAVE.normal)[sure].mean() < normals
    assert np.sqrt((error**2).mean()) < most
    assert np.median(error / joined.sigma[sure]) < 1.4 and np.mean(error > 5 * joined.sigma[sure]) < 0.1


@first_short(("shape", "perspective"), [("disc", True), ("wave", False)])
def test_rounded_depths_are_no_stairs(device, shape, perspective):
    """Steps of 20 σ were steps of the surface, with 26 % of the heights beyond 5 σ."""
    view = see(shape, size=SIZE, perspective=perspective)
    noisy = -view.z + SIGMA / 4 * np.random.default_rng(1).standard_normal(view.z.shape)
    joined, _ = join(view, noise=NOISE, drift=2, sigma=SIGMA / 4, device=device, depth=np.round(noisy / (5 * SIGMA)) * 5 * SIGMA)
    right, _ = join(view, noise=NOISE, drift=2, sigma=SIGMA / 4, device=device, depth=noisy)
    assert right.step_m == 0 and joined.step_m == pytest.approx(5 * SIGMA, rel=0.1)  # of heights −log z, over the mean depth
    assert len(np.unique(joined.part)) == len(np.unique(right.part)) and joined.placed.all()
    assert np.mean(np.abs(joined.height - view.z)[~joined.guessed] > 5 * joined.sigma[~joined.guessed]) < 0.001


@pytest.mark.long
def test_boxes_before_a_wall_are_not_rounded(device):
    z = np.full((SIZE, SIZE), -0.5)
    z[10:50, 10:50] += 25 * MM
    z[60:90, 30:80] += 50 * MM
    flat = WAVE._replace(x=WAVE.x[:SIZE, :SIZE], y=WAVE.y[:SIZE, :SIZE], z=z, normal=np.stack([0 * z, 0 * z, 1 + 0 * z]))
    joined, _ = join(flat, noise=2, drift=4, sigma=SIGMA, device=device, depth=-z)
    assert joined.step_m == 0 and len(np.unique(joined.part)) == 3


@pytest.mark.long
@pytest.mark.parametrize("factor", [1.0, 0.7, 1.3])
def test_normals_that_are_too_flat_or_too_steep_everywhere_get_the_relief_of_the_depth(device, factor):
    """Slopes of 0.7 or 1.3 times the true ones, which are 4 to 5° off; what is left is the noise of 0.5° and drift of 1°."""
    given = drifting(WAVE.normal, noise=NOISE, drift=1) * np.array([factor, factor, 1.0])[:, None, None]
    given /= np.linalg.norm(given, axis=0)
    everywhere = np.ones(WAVE.z.shape, bool)
    depth = -WAVE.z + SIGMA * np.random.default_rng(1).standard_normal(WAVE.z.shape)
    angle, metres = np.full(WAVE.z.shape, np.radians(NOISE)), np.full(WAVE.z.shape, SIGMA)
    joined = join_depth(given, angle, everywhere, depth, metres, everywhere, WAVE.x, WAVE.y, perspective=False, device=device)
    assert joined.factor == (1.0 if factor == 1 else pytest.approx(1 / factor, rel=0.03))
    assert joined.noise_factor < 1.1 and not any(joined.shift_px)
    assert degrees_between(joined.normal, WAVE.normal).mean() < 1.2  # 1.1° of noise and drift were given


@pytest.mark.long
@pytest.mark.parametrize(("wrong", "said"), [(True, True), (False, False)], ids=["range along the ray", "depth along the axis"])
def test_a_bent_depth_that_contradicts_the_normals_is_said_and_held(device, wrong, said):
    """A range along the ray bends the surface by 8° in the mean: 70 % of the heights were more than 5 σ off."""
    view = see("wave", perspective=True)
    depth = -view.z * (np.sqrt(1 + view.x**2 + view.y**2) if wrong else 1)
    joined, _ = join(view, noise=0.5, drift=1, sigma=SIGMA, device=device,
                     depth=depth + SIGMA * np.random.default_rng(1).standard_normal(depth.shape))
    assert (joined.contradicted_degrees > 0) == said
    assert np.mean(np.abs(joined.height - view.z) > 5 * joined.sigma) < 0.01
    assert said or np.median(joined.sigma) < 0.2 * SIGMA


@pytest.mark.long
def test_a_relief_that_is_too_deep_is_held(device):
    depth = 0.5 + 1.15 * (-WAVE.z - 0.5) + SIGMA * np.random.default_rng(1).standard_normal(WAVE.z.shape)
    joined, _ = join(WAVE, noise=0.5, drift=1, sigma=SIGMA, device=device, depth=depth)
    assert joined.factor == pytest.approx(1.15, rel=0.03)
    assert np.mean(np.abs(joined.height - WAVE.z) > 5 * joined.sigma) < 0.01  # 63 % before


@first_short("shift", [2.0, 0.7, 4.0])
def test_a_depth_from_another_place_is_moved_back(device, shift):
    """A relief of bumps 40 pixels wide: what drift of normals might be took the shift up, and the heights were 4 σ off."""
    random = np.random.default_rng(3)
    height = gaussian_filter(random.standard_normal((224, 224)), 14, mode="wrap")
    height *= 2.5 / height.std()  # pixels, with slopes of .2
    slope = np.gradient(height)
    given = np.stack([-slope[1], slope[0], np.ones_like(height)])
    given /= np.linalg.norm(given, axis=0)
    noisy = given + np.radians(NOISE) * random.standard_normal(given.shape)
    x, y = np.meshgrid((np.arange(224) - 112) * MM, (112 - np.arange(224)) * MM)
    aside = np.fft.ifft(np.fft.fft(height, axis=1) * np.exp(-2j * np.pi * np.fft.fftfreq(224) * shift), axis=1).real
    depth, everywhere = 0.5 - MM * aside + SIGMA * random.standard_normal(height.shape), np.ones(height.shape, bool)
    joined = join_depth(noisy / np.linalg.norm(noisy, axis=0), np.full(height.shape, np.radians(NOISE)), everywhere, depth,
                        np.full(height.shape, SIGMA), everywhere, x, y, perspective=False, device=device)
    assert joined.shift_px == pytest.approx((shift, 0), abs=0.1 + 0.05 * shift)
    error = np.abs(joined.height - MM * height + 0.5)
    assert np.sqrt((error**2).mean()) < 0.2 * SIGMA and np.mean(error > 2 * joined.sigma) < 0.01


def test_normals_that_are_turned_alike_are_not_taken_for_a_shifted_depth(device):
    """An egg whose normals are turned by 5° looks as if it stood 1.7 px aside; the depth turns them back."""
    made = surface("egg", np.random.default_rng(0))
    half = made.mask.shape[0] / 2 * MM
    true, z = np.moveaxis(made.normal, -1, 0), made.points[..., 2] * half
    given = np.einsum("ij,jrc->irc", Rotation.from_rotvec((0.06, 0.06, 0)).as_matrix(), true)
    depth = 0.5 - z + SIGMA * np.random.default_rng(1).standard_normal(z.shape)
    joined = join_depth(given, np.full(z.shape, np.radians(NOISE)), made.mask, depth, np.full(z.shape, SIGMA), made.mask,
                        made.points[..., 0] * half, made.points[..., 1] * half, perspective=False, device=device)
    error = np.abs(joined.height - z + 0.5)[made.mask]
    assert not any(joined.shift_px) and degrees_between(joined.normal, true)[made.mask].mean() < 2.0
    assert np.sqrt((error**2).mean()) < LEAST_RATIO * SIGMA and np.median(joined.sigma[made.mask]) < LEAST_RATIO * SIGMA


def test_where_depth_is_missing_normals_carry_on(device):
    view = see("wave")
    seen = np.random.default_rng(5).random(view.z.shape) > 0.5
    seen[60:90, 50:80] = False
    joined, _ = join(view, noise=0.5, drift=1, sigma=0.5 * MM, device=device, seen=seen)
    assert joined.placed.all()
    hole = np.abs(joined.height - view.z)[60:90, 50:80]
    assert hole.max() < 1 * MM  # a tenth of the wave that the hole takes away


def test_pixels_without_depth_beside_a_step_are_not_taken_for_sure(device):
    """Half of the depths are missing at random, so that it is open which side of the step some pixels are on."""
    view = see("disc")
    seen = np.random.default_rng(7).random(view.z.shape) > 0.5
    joined, _ = join(view, noise=0.5, drift=2, sigma=0.5 * MM, device=device, seen=seen)
    wrong = np.abs(joined.height - view.z) > 5 * MM
    assert (wrong & ~(joined.guessed | joined.rejected | ~joined.placed)).sum() <= 3
    assert joined.guessed.mean() < 0.05


@first_short("perspective", [False, True])
def test_where_there_is_a_depth_none_beside_a_step_is_worse(device, perspective):
    """A tenth of the depths is missing; pixels with one are right on both sides of the step, and only guessed ones are far off."""
    view = see("disc", perspective=perspective)
    seen = np.random.default_rng(3).random(view.z.shape) > 0.1
    joined, _ = join(view, noise=2, drift=3, sigma=0.1 * MM, device=device, seen=seen)
    error = np.abs(joined.height - view.z)
    assert np.sqrt((error[seen] ** 2).mean()) <= LEAST_RATIO * 0.1 * MM and error[seen].max() < 0.5 * MM
    assert joined.guessed[error > 0.5 * MM].all() and not (joined.guessed & seen).any()


def test_mixtures_at_an_outline_are_left_out(device):
    view = see("disc")
    depth = -view.z + 0.2 * MM * np.random.default_rng(9).standard_normal(view.z.shape)
    inside = np.hypot(view.x + 10 * MM, view.y)
    rim = np.abs(inside - 50 * MM) < 0.5 * MM
    depth[rim] -= 20 * MM * np.where(inside[rim] < 50 * MM, -1, 1)  # half way to the other side
    joined, _ = join(view, noise=0.5, drift=0, sigma=0.2 * MM, device=device, depth=depth)
    wrong = np.abs(joined.height - view.z) > 2 * MM
    assert wrong[~rim].sum() == 0
    assert (wrong & ~(joined.guessed | joined.rejected | ~joined.placed)).sum() == 0
    assert len(np.unique(joined.part[joined.placed])) == 2


@first_short(("count", "perspective"), [(0, True), (1, True), (1, False), (40, True)])
def test_single_depths_that_are_far_off_are_rejected(device, count, perspective):
    view = see("wave", size=SIZE, perspective=perspective)
    random = np.random.default_rng(1)
    depth = -view.z + SIGMA * random.standard_normal(view.z.shape)
    wrong = np.zeros(depth.shape, dtype=bool)
    wrong.reshape(-1)[random.choice(depth.size, count, replace=False)] = True
    depth[wrong] += 20 * MM
    joined, _ = join(view, noise=NOISE, drift=2, sigma=SIGMA, device=device, depth=depth)
    assert joined.rejected[wrong].all() and (joined.rejected & ~wrong).mean() < 0.01  # beside one, two in line look like mixtures
    sure = joined.placed & ~joined.rejected & ~joined.guessed
    assert np.sqrt(np.mean((joined.height - view.z)[sure] ** 2)) < LEAST_RATIO * SIGMA


@first_short(("share", "off"), [(0.1, 3 * MM), (0.2, 3 * MM), (0.3, 3 * MM), (0.3, -2 * MM)])
def test_σ_holds_depths_that_are_off_to_one_side_and_too_near_to_be_rejected(device, share, off):
    view = see("wave", size=SIZE)
    random = np.random.default_rng(4)
    depth = -view.z + SIGMA * random.standard_normal(view.z.shape)
    right, _ = join(view, noise=NOISE, drift=2, sigma=SIGMA, device=device, depth=depth)
    joined, _ = join(view, noise=NOISE, drift=2, sigma=SIGMA, device=device, depth=depth + off * (random.random(depth.shape) < share))
    sure = joined.placed & ~joined.rejected & ~joined.guessed
    assert right.one_sided_m == 0 and 0 < joined.one_sided_m < share * abs(off)
    assert (np.abs(joined.height - view.z) <= 3 * joined.sigma)[sure].mean() >= 0.95  # as of right depths


@pytest.mark.long
def test_what_normals_leave_unexplained_tells_a_mirrored_view(device):
    view = see("wave")
    right, _ = join(view, noise=0.5, drift=2, sigma=0.2 * MM, device=device)
    mirrored, _ = join(view._replace(normal=view.normal * np.array([-1, 1, 1])[:, None, None]), noise=0.5, drift=2, sigma=0.2 * MM,
                       device=device)
    assert right.unexplained is not None and right.unexplained < 0.1
    assert mirrored.unexplained is not None and mirrored.unexplained > 1


@first_short("mirrored", [False, True])
def test_the_drift_of_normals_of_a_low_relief_is_no_contradiction(device, mirrored):
    """Bumps of .5 mm under normals with drift of 3° were refused as of another surface: 2.2 of their relief was unexplained."""
    height = gaussian_filter(np.random.default_rng(0).standard_normal((128, 128)), 6, mode="wrap")
    slope = np.gradient(height * 0.5 / height.std())
    given = np.stack([-slope[1] * (-1 if mirrored else 1), slope[0], np.ones_like(height)])
    x, y = np.meshgrid((np.arange(128) - 64) * MM, (64 - np.arange(128)) * MM)
    view = View(x, y, height * 0.5 * MM / height.std() - 0.5, given / np.linalg.norm(given, axis=0), False)
    joined, _ = join(view, noise=NOISE, drift=3, sigma=SIGMA / 2, device=device)
    assert joined.unexplained is not None and (joined.unexplained > 0.8 if mirrored else joined.unexplained < 0.1)


def test_a_flat_wall_has_no_relief_to_explain(device):
    view = see("wave")
    normal = np.zeros_like(view.normal)
    normal[2] = 1
    flat = view._replace(z=np.full_like(view.z, -0.5), normal=normal)
    joined, _ = join(flat, noise=0.5, drift=0, sigma=1 * MM, device=device)
    assert joined.unexplained is None
    assert np.abs(joined.height - flat.z).max() < 0.3 * MM


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"depth": np.zeros((4, 5))}, "depth has shape"),
    ({"normal": np.zeros((3, 4, 5))}, "normal has shape"),
    ({"measured": np.zeros((8, 8), dtype=bool)}, "0 pixels have both a depth and a normal"),
    ({"depth": np.full((8, 8), np.nan)}, "must be finite"),
    ({"depth": np.full((8, 8), -1.0)}, "must be above 0"),
    ({"depth_sigma": np.zeros((8, 8))}, "standard deviation of a depth must be above 0"),
])
def test_what_cannot_be_is_refused(device, changes, sentence):
    view = see("wave", size=8, perspective=True)
    everywhere = np.ones(view.z.shape, dtype=bool)
    given = {"normal": view.normal, "normal_sigma": np.full(view.z.shape, 0.01), "solved": everywhere, "depth": -view.z,
             "depth_sigma": np.full(view.z.shape, MM), "measured": everywhere, "x": view.x, "y": view.y, "perspective": True}
    with pytest.raises(ArrayError, match=sentence):
        join_depth(**{**given, **changes}, device=device)

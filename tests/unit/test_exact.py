"""The exact solutions against the equations, the formulas written out, and closed forms."""

import itertools
import math
import tracemalloc
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from covering_helpers import covering
from mpipic.physics.acoustics import cosines, solutions
from mpipic.physics.acoustics.cosines import CosineSeries, gaussian_waves, periodic_gaussian
from mpipic.physics.acoustics.gas import Gas
from mpipic.physics.acoustics.solutions import PROFILES, solution

LENGTH = (1.0, 1.5, 0.8)
CENTER = (0.3, 0.9, 0.5)
WAVE = (2, -1, 1)
FLOWS = {"rest": (0.0, 0.0, 0.0), "slow": (0.05, -0.1, 0.2), "supersonic": (3.0, -2.0, 2.5)}
SOUND_SPEED, DENSITY = 1.3, 0.7

every_profile = pytest.mark.parametrize("profile", PROFILES)
every_dimension = pytest.mark.parametrize("d", [1, 2, 3])


def build(profile, d, *, flow="slow", sharpness=20.0, wave=WAVE, sound_speed=SOUND_SPEED, density=DENSITY):
    gas = Gas(sound_speed, FLOWS[flow][:d], density)
    return solution(profile, length=LENGTH[:d], gas=gas, center=CENTER[:d], sharpness=sharpness, wave=wave[:d])


def points(d, n=200, seed=1):
    return np.random.default_rng(seed).random((n, d)) * LENGTH[:d]


def images(x, sharpness, reach=6):
    """The sum over images of exp(-sharpness |x - center|²), image by image."""
    d = x.shape[1]
    total = np.zeros(len(x))
    for m in itertools.product(range(-reach, reach + 1), repeat=d):
        total += np.exp(-sharpness * ((x - CENTER[:d] - np.array(m) * LENGTH[:d]) ** 2).sum(1))
    return total


def initial_density(profile, x, sharpness=20.0):
    """f(x) as the formulas say, by the shortest means."""
    d = x.shape[1]
    k = 2 * np.pi * np.array(WAVE[:d]) / LENGTH[:d]
    if profile == "gaussian":
        return images(x, sharpness)
    if profile == "plane-gaussian":
        size = np.sqrt(k @ k)
        s = (x - CENTER[:d]) @ k / size
        return sum(np.exp(-sharpness * (s - m * 2 * np.pi / size) ** 2) for m in range(-40, 41))
    if profile == "plane-wave":
        return np.cos(x @ k)
    if profile == "standing-wave":
        return np.prod(np.cos(x * k), axis=1)
    raise AssertionError(f"write out the initial data of {profile} here")


def difference(values, h):
    """Fourth-order central difference from values at -2h, -h, h, 2h."""
    return (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)


@every_profile
@every_dimension
def test_at_time_zero_the_density_is_the_formula_and_the_gas_rests(profile, d):
    x = points(d, 60)
    density, velocity = build(profile, d)(x, 0.0)
    np.testing.assert_allclose(density, initial_density(profile, x), rtol=0, atol=1e-13)
    assert np.all(velocity == 0.0) and velocity.shape == (60, d)


@pytest.mark.parametrize(("profile", "d", "flow"), covering(2, PROFILES, (1, 2, 3), FLOWS))
def test_the_equations_hold(profile, d, flow):
    exact_solution = build(profile, d, flow=flow)
    x, t, h = points(d, 40), 0.37, 1e-3
    v = np.array(FLOWS[flow][:d])
    steps = h * np.array([-2, -1, 1, 2])
    along = [exact_solution(x + v * s, t + s) for s in steps]
    rate = difference([rho for rho, _ in along], h)
    acceleration = difference([u for _, u in along], h)
    beside = [[exact_solution(x + s * axis, t) for s in steps] for axis in np.eye(d)]
    gradient = np.stack([difference([rho for rho, _ in values], h) for values in beside], axis=1)
    divergence = sum(difference([u[:, a] for _, u in values], h) for a, values in enumerate(beside))
    assert np.abs(rate).max() > 0.1 and np.abs(acceleration).max() > 0.1
    # h⁴ f⁽⁵⁾/30 with |f⁽⁵⁾| below 4e5 for the sharpest profile here leaves 2e-8.
    np.testing.assert_allclose(rate, -DENSITY * divergence, rtol=0, atol=1e-7)
    np.testing.assert_allclose(acceleration, -(SOUND_SPEED**2 / DENSITY) * gradient, rtol=0, atol=1e-7)


@every_profile
@every_dimension
def test_the_box_is_periodic_along_every_axis(profile, d):
    exact_solution, x = build(profile, d), points(d)
    density, velocity = exact_solution(x, 0.6)
    for axis in range(d):
        for periods in (1, -3):
            shift = periods * LENGTH[axis] * np.eye(d)[axis]
            moved_density, moved_velocity = exact_solution(x + shift, 0.6)
            np.testing.assert_allclose(moved_density, density, rtol=0, atol=1e-12)
            np.testing.assert_allclose(moved_velocity, velocity, rtol=0, atol=1e-12)
    assert np.ptp(density) > 0.01


@every_profile
@every_dimension
def test_a_flow_only_carries_the_solution(profile, d):
    x, t = points(d), 0.83
    resting = build(profile, d, flow="rest")(x, t)
    moving = build(profile, d, flow="supersonic")(x + t * np.array(FLOWS["supersonic"][:d]), t)
    for a, b in zip(moving, resting):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


@every_profile
@every_dimension
def test_energy_is_conserved(profile, d):
    """Mean of c²ρ² + ρ₀²u² over a grid that resolves the squares of all modes."""
    exact_solution, n = build(profile, d, sharpness=60.0), 32
    x = np.stack([g.ravel() for g in np.meshgrid(*[np.arange(n) * box / n for box in LENGTH[:d]])], axis=1)

    def energies(t):
        density, velocity = exact_solution(x, t)
        return np.mean(SOUND_SPEED**2 * density**2), np.mean(DENSITY**2 * (velocity**2).sum(1))

    start, later = energies(0.0), energies(0.21)
    assert start[1] == 0.0 and later[1] > 0.01 * start[0]
    assert sum(later) == pytest.approx(sum(start), rel=1e-12)


@pytest.mark.parametrize("sharpness", [0.3, 1.0, 3.0, 8.0, 60.0, 1e4, 1e8])
def test_a_gaussian_in_1d_is_two_travelling_pulses(sharpness):
    """The pulses at v + c and v - c, image by image: eq. 7 with its first sign put right."""
    t, v = 0.37, FLOWS["slow"][0]
    spread = np.linspace(-2, 2, 41)[:, None] / math.sqrt(sharpness)
    x = np.vstack([points(1)] + [(CENTER[0] + (v + c) * t + spread) % LENGTH[0] for c in (SOUND_SPEED, -SOUND_SPEED)])
    fast, slow = (images(x - (v + c) * t, sharpness, reach=12) for c in (SOUND_SPEED, -SOUND_SPEED))
    density, velocity = build("gaussian", 1, sharpness=sharpness)(x, t)
    scale = images(np.array([CENTER[:1]]), sharpness, reach=12)[0]
    # Positions are rounded to 1e-16, which the slope, √sharpness, amplifies.
    atol = 1e-14 * scale * max(1.0, math.sqrt(sharpness))
    assert density.max() > 0.4 * scale
    np.testing.assert_allclose(density, 0.5 * (fast + slow), rtol=0, atol=atol)
    np.testing.assert_allclose(velocity[:, 0], SOUND_SPEED / (2 * DENSITY) * (fast - slow), rtol=0, atol=2 * atol)


@pytest.mark.parametrize("exponent", [1e-3, 0.1, 1.0, 3.0, 4.0, 7.0, 10.0, 60.0, 1e3])
def test_a_periodic_gaussian_equals_its_images_and_its_series(exponent):
    s = np.linspace(-0.5, 0.5, 101)
    reach = math.ceil(math.sqrt(40 / exponent)) + 1
    by_images = sum(np.exp(-exponent * (s - m) ** 2) for m in range(-reach, reach + 1))
    by_series = sum(a * np.cos(2 * np.pi * n * s) for n, a in zip(*gaussian_waves(exponent)))
    np.testing.assert_allclose(periodic_gaussian(s, exponent), by_images, rtol=0, atol=3e-15 * by_images.max())
    np.testing.assert_allclose(by_series, by_images, rtol=0, atol=3e-15 * by_images.max())


@pytest.mark.parametrize("sharpness", [1.0, 60.0, 3000.0])
def test_the_series_in_1d_equals_the_travelling_pulses(sharpness):
    pulses, x = build("gaussian", 1, sharpness=sharpness), points(1)
    waves, amplitudes = gaussian_waves(sharpness * LENGTH[0] ** 2)
    series = CosineSeries(LENGTH[:1], pulses.gas, CENTER[:1], [waves], [amplitudes])
    for a, b in zip(series(x, 0.77), pulses(x, 0.77)):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


@pytest.mark.parametrize("d", [2, 3])
def test_the_series_starts_from_the_sum_over_images(d):
    gaussian, x = build("gaussian", d, sharpness=60.0), points(d, 60)
    np.testing.assert_allclose(gaussian.moving(x, 0.0)[0], images(x, 60.0, reach=3), rtol=0, atol=1e-12)


@pytest.mark.parametrize("d", [2, 3])
def test_the_factored_series_equals_the_plain_sum_over_complex_modes(d):
    gaussian, x, t = build("gaussian", d, sharpness=12.0), points(d, 30), 0.9
    offset = x - CENTER[:d] - t * np.array(FLOWS["slow"][:d])
    density, velocity = np.zeros(30), np.zeros((30, d))
    for n in itertools.product(range(-13, 14), repeat=d):
        k = 2 * np.pi * np.array(n) / LENGTH[:d]
        size = np.sqrt(k @ k)
        # The continuous transform of exp(-12 |x|²), over the volume of the box.
        mode = (np.pi / 12.0) ** (d / 2) * np.exp(-(k @ k) / 48.0) / np.prod(LENGTH[:d]) * np.exp(1j * offset @ k)
        density += (mode * np.cos(SOUND_SPEED * size * t)).real
        if any(n):
            swing = -1j * mode * np.sin(SOUND_SPEED * size * t) * SOUND_SPEED / DENSITY
            velocity += np.multiply.outer(swing, k / size).real
    fast = gaussian(x, t)
    np.testing.assert_allclose(fast[0], density, rtol=0, atol=1e-12)
    np.testing.assert_allclose(fast[1], velocity, rtol=0, atol=1e-12)
    assert np.abs(velocity).max() > 0.01


def test_a_gaussian_in_3d_is_a_sum_of_spherical_waves():
    """ρ = [F(r-ct) + F(r+ct)]/2r and u = ∇A/r, F(s) = s exp(-a s²), summed over images of the center."""
    a, t = 60.0, 0.45
    x = points(3, 300)
    density, velocity = np.zeros(300), np.zeros((300, 3))
    ct = SOUND_SPEED * t
    for m in itertools.product(range(-2, 3), repeat=3):
        offset = x - CENTER - t * np.array(FLOWS["slow"]) - np.array(m) * LENGTH
        r = np.sqrt((offset**2).sum(1))
        out, back = np.exp(-a * (r - ct) ** 2), np.exp(-a * (r + ct) ** 2)
        density += ((r - ct) * out + (r + ct) * back) / (2 * r)
        potential = SOUND_SPEED / (4 * a * DENSITY) * (back - out)
        slope = SOUND_SPEED / (2 * DENSITY) * ((r - ct) * out - (r + ct) * back)
        velocity += offset * ((slope - potential / r) / r**2)[:, None]
    series = build("gaussian", 3, sharpness=a)(x, t)
    np.testing.assert_allclose(series[0], density, rtol=0, atol=1e-12)
    np.testing.assert_allclose(series[1], velocity, rtol=0, atol=1e-12)
    assert np.abs(density).max() > 0.05


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize(("oblique", "one"), [("plane-gaussian", "plane-gaussian"), ("plane-wave", "standing-wave")])
def test_an_oblique_plane_profile_is_the_1d_one_along_its_direction(d, oblique, one):
    k = 2 * np.pi * np.array(WAVE[:d]) / LENGTH[:d]
    direction, wavelength = k / np.sqrt(k @ k), 2 * np.pi / np.sqrt(k @ k)
    x, v, center = points(d), np.array(FLOWS["slow"][:d]), np.array(CENTER[:d])
    gas = Gas(SOUND_SPEED, (float(direction @ v),), DENSITY)
    line = solution(one, length=[wavelength], gas=gas, center=[float(direction @ center)], sharpness=70.0, wave=[1])
    expected = line((x @ direction)[:, None], 0.7)
    density, velocity = build(oblique, d, sharpness=70.0)(x, 0.7)
    np.testing.assert_allclose(density, expected[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(velocity, expected[1] * direction, rtol=0, atol=1e-12)


def test_plane_and_round_profiles_meet_in_1d():
    x = points(1)
    for names in (("gaussian", "plane-gaussian"), ("plane-wave", "standing-wave")):
        first, second = (build(name, 1, wave=(1,))(x, 0.4) for name in names)
        for a, b in zip(first, second):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-14)


@every_dimension
def test_axes_without_a_wave_do_not_matter(d):
    x, y = points(d), points(d, seed=2)
    y[:, 0] = x[:, 0]
    wave = build("standing-wave", d, flow="rest", wave=(2, 0, 0))
    for a, b in zip(wave(x, 0.3), wave(y, 0.3)):
        np.testing.assert_array_equal(a, b)
    still = build("standing-wave", d, wave=(0, 0, 0))
    density, velocity = still(x, 0.3)
    assert np.all(density == 1.0) and np.all(velocity == 0.0)


@settings(max_examples=60, deadline=None)
@given(
    profile=st.sampled_from(sorted(PROFILES)),
    sharpness=st.floats(1e-2, 1e9),
    t=st.floats(-1e6, 1e6),
    x=st.lists(st.floats(-50.0, 50.0), min_size=1, max_size=20),
)
def test_in_1d_nothing_exceeds_the_initial_maximum(profile, sharpness, t, x):
    exact_solution = build(profile, 1, sharpness=sharpness)
    start = CENTER[0] if "gaussian" in profile else 0.0
    largest = exact_solution([[start]], 0.0)[0][0]
    density, velocity = exact_solution(np.array(x)[:, None], t)
    assert np.abs(density).max() <= largest * (1 + 1e-14)
    assert np.abs(velocity).max() <= largest * SOUND_SPEED / DENSITY * (1 + 1e-14)


@pytest.mark.parametrize("profile", ["gaussian", "plane-gaussian", "plane-wave"])
def test_a_long_time_costs_no_accuracy(profile):
    """With c = L = 1 and a whole v the solution repeats in time with period 1, here a billion times over."""
    gas = Gas(1.0, (3.0,), 1.0)
    wave = solution(profile, length=[1.0], gas=gas, center=[0.5], sharpness=1e4, wave=[1])
    x = np.linspace(0.0, 1.0, 500)[:, None]
    for a, b in zip(wave(x, 2.0**30 + 0.375), wave(x, 0.375)):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("profile", "d", "sound_speed", "rest_density"), covering(2, PROFILES, (1, 2, 3), (1e-12, 1e12), (1e-12, 1e12))
)
def test_extreme_constants_only_scale_the_velocity(profile, d, sound_speed, rest_density):
    x = points(d, 50)
    with warnings.catch_warnings(), np.errstate(over="raise", invalid="raise", divide="raise"):
        warnings.simplefilter("error")
        extreme = build(profile, d, flow="rest", sound_speed=sound_speed, density=rest_density)(x, 0.4 / sound_speed)
    plain = build(profile, d, flow="rest", sound_speed=1.0, density=1.0)(x, 0.4)
    np.testing.assert_allclose(extreme[0], plain[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(extreme[1] * (rest_density / sound_speed), plain[1], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("profile", "d", "t"), covering(2, PROFILES, (1, 2, 3), (0.0, 0.5)))
def test_any_memory_layout_gives_the_same_values(profile, d, t):
    x, exact_solution = points(d, 101), build(profile, d)
    kept = x.copy()
    wide = np.full((202, 2 * d), np.nan)
    wide[::2, ::2] = x
    expected = exact_solution(x, t)
    for view in (np.asfortranarray(x), wide[::2, ::2], x[::-1][::-1], x.tolist()):
        for a, b in zip(exact_solution(view, t), expected):
            np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(x, kept)
    single = x.astype(np.float32)
    for a, b in zip(exact_solution(single, t), exact_solution(single.astype(np.float64), t)):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("profile", "d", "t"), covering(2, PROFILES, (1, 2, 3), (0.0, 0.5)))
def test_no_points_give_empty_fields(profile, d, t):
    density, velocity = build(profile, d)(np.empty((0, d)), t)
    assert density.shape == (0,) and velocity.shape == (0, d)
    assert density.dtype == velocity.dtype == np.float64


@every_profile
@every_dimension
def test_chunks_and_blocks_do_not_show(profile, d, monkeypatch):
    x, exact_solution = points(d, 150), build(profile, d)
    whole = exact_solution(x, 0.5), exact_solution(x, 0.0)
    monkeypatch.setattr(cosines, "CHUNK", 300)
    monkeypatch.setattr(solutions, "CHUNK", 300)
    pieces = exact_solution(x, 0.5), exact_solution(x, 0.0)
    for a, b in zip(itertools.chain(*pieces), itertools.chain(*whole)):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)


@pytest.mark.parametrize(("d", "sharpness"), [(2, 60.0), (3, 60.0), (3, 2000.0)])
def test_temporaries_stay_bounded(d, sharpness):
    """In one piece the tables and products of these points would take hundreds of MB."""
    n = {60.0: {2: 400_000, 3: 50_000}, 2000.0: {3: 20}}[sharpness][d]
    gaussian, x = build("gaussian", d, sharpness=sharpness), points(d, n)
    tracemalloc.start()
    gaussian(x, 0.3)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1e8


@every_profile
def test_bad_input_is_named(profile):
    with pytest.raises(ValueError, match=r"x has shape \(5, 3\), expected \(n, 2\)"):
        build(profile, 2)(np.zeros((5, 3)), 0.1)
    with pytest.raises(ValueError, match="flow has 1 entries, expected one per axis, 2"):
        solution(profile, length=(1, 1), gas=Gas(1, (0.0,), 1), center=(0, 0), sharpness=1, wave=(1, 1))
    if "gaussian" in profile:
        with pytest.raises(ValueError, match="sharpness = 0 must be positive"):
            build(profile, 2, sharpness=0.0)
    if "wave" in profile:
        with pytest.raises(ValueError, match="whole periods"):
            build(profile, 2, wave=(1, 0.5))
    if "plane" in profile:
        with pytest.raises(ValueError, match="direction"):
            build(profile, 2, wave=(0, 0))


@pytest.mark.parametrize(("d", "limit"), [(2, 8192), (3, 512)])
def test_a_gaussian_too_sharp_for_its_series_is_refused(d, limit):
    # Most waves = ceil(√(39 sharpness) L / π) along the longest axis.
    fits = 0.999 * (np.pi * limit / max(LENGTH[:d])) ** 2 / 39.0
    build("gaussian", d, sharpness=fits)
    with pytest.raises(ValueError, match=f"sharpness = .* limit in {d}D is {limit}"):
        build("gaussian", d, sharpness=1.01 * fits)


def test_an_unknown_profile_is_refused_with_the_choices():
    with pytest.raises(
        ValueError, match="'square' is unknown; choose one of gaussian, plane-gaussian, plane-wave, standing-wave"
    ):
        build("square", 1)

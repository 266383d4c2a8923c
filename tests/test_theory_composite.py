"""Composite variables: coefficient match, the two rates, the exact solution, the sampled cap."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from cmc.theory.composite import InfeasibleGainsError, certify_latent, composite

ROOTS = ("small", "large")


def random_gains(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    lam, kp = rng.uniform(0.1, 5.0, n), 10.0 ** rng.uniform(-6, 3, n)
    return kp, np.sqrt(4 * kp * lam) * (1 + rng.exponential(1.0, n)), lam


@pytest.mark.parametrize("root", ROOTS)
def test_the_coefficients_match(root):
    kp, kd, lam = random_gains(100_000)
    m = composite(kp, kd, lam, root)
    np.testing.assert_allclose(m.A_lat * m.K2, lam, rtol=1e-12)
    np.testing.assert_allclose(m.A_lat * m.K1 + m.B_lat * m.K2, kd, rtol=1e-12)
    np.testing.assert_allclose(m.B_lat * m.K1, kp, rtol=1e-12)
    for field in (m.K1, m.K2, m.A_lat, m.B_lat, -m.f_u, -m.f_y):  # R < 0: slopes are positive
        assert (field > 0).all()


@pytest.mark.parametrize("root", ROOTS)
def test_the_two_rates_are_the_two_poles(root):
    kp, kd, lam = random_gains(200)
    kp = np.maximum(kp, 1e-2)  # np.roots loses the small pole's digits below
    kd = np.maximum(kd, 2.01 * np.sqrt(kp * lam))
    m = composite(kp, kd, lam, root)
    poles = np.sort([np.roots(c).real for c in np.stack([lam, kd, kp], axis=1)], axis=1)
    slow, fast = -poles[:, 1], -poles[:, 0]
    latent, rest = (slow, fast) if root == "small" else (fast, slow)
    np.testing.assert_allclose(m.latent_rate, latent, rtol=1e-7)
    np.testing.assert_allclose(m.composition_rate, rest, rtol=1e-7)


@pytest.mark.parametrize(
    ("kp", "kd", "fast", "slow"),
    [(40, 20, 17.75, 2.254), (20, 10, 7.24, 2.76), (20, 30, 29.3, 0.682), (30, 40, 39.2, 0.765)],
)
def test_rates_of_the_published_gains(kp, kd, fast, slow):
    small, large = composite(kp, kd), composite(kp, kd, root="large")
    assert small.composition_rate == pytest.approx(fast, rel=2e-3)
    assert small.latent_rate == pytest.approx(slow, rel=2e-3)
    assert large.composition_rate == pytest.approx(slow, rel=2e-3)
    assert large.latent_rate == pytest.approx(fast, rel=2e-3)
    assert small.K2 < large.K2
    critical = [composite(4.0, 4.0, root=root) for root in ROOTS]  # the two roots are one
    assert {float(x) for m in critical for x in (m.K2, m.latent_rate, m.composition_rate)} == {2.0}


@pytest.mark.parametrize("root", ROOTS)
@pytest.mark.parametrize(("kp", "kd", "lam"), [(40.0, 20.0, 1.0), (3.0, 8.0, 2.0), (0.0, 5.0, 0.5)])
def test_simulated_error_obeys_the_latent_model(kp, kd, lam, root):
    """Integrate e'' alone; y built from it must equal the latent model integrated on its own."""
    m = composite(kp, kd, lam, root)
    times = np.linspace(0, 2, 41)

    def push(t):
        return 0.7 * np.sin(3 * t) + 0.2

    def second_order(t, s):
        return [s[1], -(kd * s[1] + kp * s[0] + push(t)) / lam]

    tight = {"t_eval": times, "rtol": 1e-10, "atol": 1e-12}
    e, v = solve_ivp(second_order, (0, 2), [0.3, -0.4], **tight).y
    y = solve_ivp(
        lambda t, y: -(m.B_lat * y + push(t)) / m.A_lat, (0, 2), [m.y(0.3, -0.4)], **tight
    ).y[0]
    np.testing.assert_allclose(m.y(e, v), y, atol=1e-8)


@pytest.mark.parametrize("root", ROOTS)
def test_without_control_y_decays_exactly_at_the_latent_rate(root):
    m = composite(40.0, 20.0, root=root)
    for t in (0.01, 0.1, 0.7):
        e, v = expm(np.array([[0.0, 1.0], [-40.0, -20.0]]) * t) @ [0.01, 0.02]
        assert m.y(e, v) == pytest.approx(m.y(0.01, 0.02) * np.exp(-m.latent_rate * t), rel=1e-9)


def test_zero_stiffness_axis_beside_others():
    m = composite([40.0, 0.0], [20.0, 3.0], [1.0, 2.0])
    found = [m.K1[1], m.K2[1], m.A_lat[1], m.B_lat[1], m.composition_rate[1], m.latent_rate[1]]
    assert found == [0.0, 1.0, 2.0, 3.0, 0.0, 1.5]


def sampled_radius(m, g: float, dt: float) -> float:
    """Spectral radius of the held loop, from the matrix exponential of the double integrator."""
    hold = expm(np.array([[0, 1, 0], [0, 0, 1], [0, 0, 0.0]]) * dt)
    feedback = -np.array([m.K_p + g * m.K1, m.K_d + g * m.K2]) / m.lambda_d
    return float(np.abs(np.linalg.eigvals(hold[:2, :2] + np.outer(hold[:2, 2], feedback))).max())


@pytest.mark.parametrize("root", ROOTS)
def test_slope_cap_is_where_the_sampled_loop_turns_unstable(root):
    rng = np.random.default_rng(1)
    for _ in range(40):
        kp, lam = rng.uniform(1, 50), rng.uniform(0.5, 3)
        kd = 2 * np.sqrt(kp * lam) * rng.uniform(1, 3)
        m = composite(kp, kd, lam, root)
        dt = rng.uniform(0.05, 0.9) * 2 * lam / kd
        cap = float(m.slope_cap(dt))
        assert cap > 0
        assert sampled_radius(m, 1.001 * cap, dt) > 1
        for g in (0.999 * cap, rng.uniform(0, 1) * cap):  # Jury's other condition
            slow = (kp + g * m.K1) * dt < 2 * (kd + g * m.K2)
            assert slow == (sampled_radius(m, g, dt) < 1)


def test_slope_cap_of_both_roots_differs_as_published_gains_say():
    small, large = composite(20, 30), composite(20, 30, root="large")
    assert small.slope_cap(0.02) / large.slope_cap(0.02) == pytest.approx(43, rel=0.01)
    chatter = 20 + 50 * composite(40, 20).K2
    assert chatter * 0.02 == pytest.approx(2.65, abs=0.01)


class Bounds:
    def __init__(self, low, high):
        self.slope_bounds = lambda: (low, high)


ONE = Bounds([[1.0, 1.0]], [[2.0, 2.0]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: composite([40, 40.0], [20, 12.0]), "axis 1.*K_p = 40, K_d = 12.*below.*12.6491"),
        (lambda: composite(1.0, 1.0), r"K_d\^2 < 4 K_p lambda_d: K_p = 1"),
        (lambda: composite(np.nan, 1.0), "K_p needs finite"),
        (lambda: composite(-1.0, 1.0), "K_p needs values of at least 0"),
        (lambda: composite(1.0, 0.0), "K_d needs positive"),
        (lambda: composite(1.0, 5.0, -1.0), "lambda_d needs positive"),
        (lambda: composite([1.0, 2.0], [5.0, 5.0, 5.0]), "broadcast"),
        (lambda: composite(1.0, 5.0, 1.0, "middle"), "root must be"),
        (lambda: composite("1", 5.0), "K_p needs real numbers"),
        (lambda: composite(1e300, 1e200), "K_d: too large"),
        (lambda: composite(1.0, 1e-200), "K_d: too large or too small"),
        (lambda: composite(1e300, 1e10, 1e200), "K_p and lambda_d: too large"),
        (lambda: composite(1.0, 1e100, 1e-300), "too large or too small"),
        (lambda: composite(1e-320, 1.0), "K_p, K_d and lambda_d: too large or too small"),
        (lambda: composite(1.0, 5.0).slope_cap(0.0), "dt needs positive"),
        (lambda: composite(1.0, 5.0).slope_cap(np.inf), "dt needs finite"),
        (lambda: composite(1.0, 5.0).slope_cap(1e-320), "dt and K2: too"),
        (lambda: composite(1.0, [5.0, 5.0]).y([1.0, 2.0, 3.0], 0.0), "fit together.*K1"),
        (lambda: certify_latent(3.0, ONE, 1.0, 5.0), r"signal needs slope_bounds\(\)"),
        (lambda: certify_latent(ONE, Bounds([[1.0]], [[1.0]]), 1.0, 5.0), "policy.slope_bounds"),
        (lambda: certify_latent(ONE, ONE, [1.0, 2.0], 5.0), r"K_p needs a number or shape \(1,\)"),
        (lambda: certify_latent(ONE, ONE, 1.0, 5.0, 0.0), "lambda_d needs positive"),
        (lambda: certify_latent(ONE, ONE, 1.0, 5.0, h=0.0), "h needs positive"),
    ],
)
def test_bad_gains_are_named(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call()
    with pytest.raises(InfeasibleGainsError):
        composite(1.0, 1.0)

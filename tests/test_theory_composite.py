"""Composite variables: coefficient match, the two rates, the exact solution, the sampled cap."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from cmc.theory.composite import InfeasibleGainsError, composite, feasible

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
    for field in (m.K1, m.K2, m.A_lat, m.B_lat):
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


def test_critical_damping_makes_the_roots_one():
    small, large = composite(4.0, 4.0), composite(4.0, 4.0, root="large")
    assert small.K2 == large.K2 == 2.0
    assert small.latent_rate == small.composition_rate == 2.0


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
    y = solve_ivp(lambda t, y: m.y_dot(y, push(t)), (0, 2), [m.y(0.3, -0.4)], **tight).y[0]
    np.testing.assert_allclose(m.y(e, v), y, atol=1e-8)


@pytest.mark.parametrize("root", ROOTS)
def test_without_control_y_decays_exactly_at_the_latent_rate(root):
    m = composite(40.0, 20.0, root=root)
    for t in (0.01, 0.1, 0.7):
        e, v = expm(np.array([[0.0, 1.0], [-40.0, -20.0]]) * t) @ [0.01, 0.02]
        assert m.y(e, v) == pytest.approx(m.y(0.01, 0.02) * np.exp(-m.latent_rate * t), rel=1e-9)


def test_sign_rule_asks_for_positive_slopes():
    kp, kd, lam = random_gains(1000, seed=3)
    for root in ROOTS:
        m = composite(kp, kd, lam, root)
        assert (m.f_u < 0).all()
        assert (m.f_y < 0).all()
        assert (m.slope_sign == 1.0).all()


def test_zero_stiffness_axis_beside_others():
    m = composite([40.0, 0.0], [20.0, 3.0], [1.0, 2.0])
    assert m.K1[1] == 0.0
    assert m.K2[1] == 1.0
    assert m.A_lat[1] == 2.0
    assert m.B_lat[1] == 3.0
    assert m.composition_rate[1] == 0.0
    assert m.latent_rate[1] == 1.5


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
        assert not m.sampled_stable(1.001 * cap, dt)
        for g in (0.999 * cap, rng.uniform(0, 1) * cap):
            assert m.sampled_stable(g, dt) == (sampled_radius(m, g, dt) < 1)


def test_slope_cap_of_both_roots_differs_as_published_gains_say():
    small, large = composite(20, 30), composite(20, 30, root="large")
    assert small.slope_cap(0.02) / large.slope_cap(0.02) == pytest.approx(43, rel=0.01)
    chatter = 20 + 50 * composite(40, 20).K2
    assert chatter * 0.02 == pytest.approx(2.65, abs=0.01)


def test_infeasible_gains_are_refused_with_the_reason():
    with pytest.raises(InfeasibleGainsError, match="axis 1.*K_p = 40, K_d = 12.*below.*12.6491"):
        composite([40.0, 40.0], [20.0, 12.0])
    with pytest.raises(InfeasibleGainsError, match=r"K_d\^2 < 4 K_p lambda_d: K_p = 1"):
        composite(1.0, 1.0)
    assert feasible([40.0, 40.0, 0.0], [20.0, 12.0, 0.1]).tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ((np.nan, 1.0, 1.0), "K_p must be finite"),
        ((-1.0, 1.0, 1.0), "K_p must be >= 0"),
        ((1.0, 0.0, 1.0), "K_d must be > 0"),
        ((1.0, 5.0, -1.0), "lambda_d must be > 0"),
        (([1.0, 2.0], [5.0, 5.0, 5.0], 1.0), "broadcast"),
        ((1.0, 5.0, 1.0, "middle"), "root must be"),
    ],
)
def test_bad_gains_are_named(args, message):
    with pytest.raises(ValueError, match=message):
        composite(*args)
    for dt in (0.0, -1.0, np.inf):
        with pytest.raises(ValueError, match="dt must be positive"):
            composite(1.0, 5.0).slope_cap(dt)

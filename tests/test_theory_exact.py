"""Exact certificates: transforms that turn, nonlinear plants, and what is refused."""

import numpy as np
import pytest
from test_theory_certify import policy, ratio

from cmc import plants
from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.ball import lowest
from cmc.theory.certify import certify
from cmc.theory.exact import Region, shortfall
from cmc.theory.identification import differences
from cmc.theory.simulate import Loop, closed_loop


class Turning:
    """T_a = Rot(3 y1) on two plain lags: what the frozen view takes for a constant."""

    u0 = 0.0

    def slope_bounds(self):
        bounds = np.tile([0.5, 0.1], (2, 1))
        return bounds, bounds

    def pi(self, s):
        return 0.5 * s[..., 0] + 0.1 * s[..., 1] - np.array([0.0, -5.0])

    @staticmethod
    def spaces(y):
        angle = 3 * y[..., 0]
        rot = np.stack(
            [
                np.stack([np.cos(angle), -np.sin(angle)], -1),
                np.stack([np.sin(angle), np.cos(angle)], -1),
            ],
            -2,
        )
        eye = np.broadcast_to(np.eye(2), rot.shape)
        return AuxiliarySpace(eye, rot, -eye, rot)


def test_frozen_passes_and_exact_fails_where_the_transform_turns():
    plant = plants.Lags(tau=(1.0, 1.0), gain=(1.0, 1.0))
    region = Region([-0.35, -0.5], [0.35, 0.5])
    turning = Turning()
    frozen = certify(turning, plant, region=region, kind="frozen", transforms=Turning.spaces)
    assert not frozen
    assert frozen.rate > 0
    assert "proves nothing" in str(frozen)
    exact = certify(turning, plant, region=region, kind="exact", transforms=Turning.spaces)
    assert not exact
    assert not exact.refused
    # by hand, with the slopes at zero: -1 + 15 cos(0.9) = 8.32 at y1 = 0.3
    loop = Loop(plant, turning, Turning.spaces)
    hand = differences(
        lambda s: loop.field(0.0, s) + _without_feedback(s), np.array([0.3, 0, 0, 0.0])
    )
    assert np.linalg.eigvals(hand).real.max() == pytest.approx(8.32, abs=0.01)


def _without_feedback(s):
    y, I = s[..., :2], s[..., 2:]
    a = (0.5 * y + 0.1 * I)[..., None]
    push = (Turning.spaces(y).T_a @ a)[..., 0]
    return np.concatenate([push, np.zeros_like(push)], axis=-1)


def test_exact_certificate_of_a_nonlinear_plant_is_obeyed():
    plant = plants.get("pendulum")
    region = Region([-0.3, -0.3], [0.3, 0.3], integral=0.3, points=5)
    pol = policy((0.8, 0.3), (0.2, 0.1))
    answer = certify(pol, plant, region=region, kind="exact")
    assert answer, str(answer)
    assert answer.kind == "exact"
    assert "in it" in answer.reason

    times, rng = np.linspace(0, 4, 200), np.random.default_rng(8)
    start = rng.uniform(-0.05, 0.05, (8, 4))
    path = closed_loop(plant, pol, start[:, :2], times, integral=start[:, 2:])
    paths = np.concatenate([path.y, path.integral], axis=-1)
    assert np.abs(paths).max() < 0.3
    assert (ratio(paths, answer.metric) <= np.exp(-answer.rate * times) * (1 + 1e-6)).all()
    sampled = certify(pol, plant, region=region, kind="exact", h=0.02)
    assert sampled
    assert (sampled.kind, sampled.domain) == ("exact", "sampled")


def test_exact_is_refused_where_it_cannot_be_had():
    class BoundsOnly:
        def slope_bounds(self):
            return np.full((2, 2), 0.2), np.full((2, 2), 0.5)

    blind = certify(BoundsOnly(), plants.get("pendulum"))
    assert blind.refused
    assert "neither pi(s) nor a network" in blind.reason

    def flipping(y):
        space = AuxiliarySpace.identity(np.diag([-1.0, -2.0]), np.eye(2))
        sign = np.where(y[..., :1, None] > 0.1, -1.0, 1.0)
        eye = np.broadcast_to(np.eye(2), (*y.shape[:-1], 2, 2))
        return AuxiliarySpace(eye * sign, eye, eye * 0 + space.Lambda, eye)

    lags = plants.get("lags")
    assert "track" in certify(policy(), lags, kind="exact", transforms=flipping).reason


def test_the_hull_of_what_was_looked_at_is_enlarged_by_what_lies_beyond():
    """Matrices diag(x) with |x| <= 0.8 of 1, 0.5: others reach 1 / 0.8 as far, units apart."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (4000, 2)) * [1.0, 1e-6]
    J = np.einsum("ki,ij->kij", x, np.eye(2)) + [[0.0, 3.0], [0.0, 0.0]]
    inside = J[np.abs(x[:, 0]) < 0.8]
    assert shortfall(J, inside) == 0.0
    assert shortfall(inside, J) == pytest.approx(0.25, abs=0.02)
    assert shortfall(J[:1].repeat(5, axis=0), J[:1]) == 0.0
    assert shortfall(J, 3 * J) == pytest.approx(2.0, abs=0.1)


def test_going_downhill_finds_what_random_points_miss():
    """A hole of a thousandth of the square, in a bowl; and the margin that is left."""
    bowl = lambda x: ((x - 0.3) ** 2).sum(-1) - 0.1 * (((x - 0.3) ** 2).sum(-1) < 3e-4)  # noqa: E731
    start = np.random.default_rng(0).uniform(-1, 1, (64, 2))
    assert bowl(start).min() > 0
    points, values, _ = lowest(bowl, start, lambda x: np.clip(x, -1, 1), np.full(2, 0.1))
    assert values.min() < -0.09
    np.testing.assert_array_equal(values, bowl(points))
    slope = lambda x: x.sum(-1)  # noqa: E731
    points, values, margin = lowest(slope, start, lambda x: np.clip(x, -1, 1), np.full(2, 0.1))
    assert np.abs(points).max() <= 1
    assert values.min() - margin <= -2 <= values.min()

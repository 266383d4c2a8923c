"""The low level that learns through the latent model: its rollouts, and what they teach it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import nn

from cmc.learning.latent import LatentConfig, LatentLow, LatentModel
from cmc.learning.low_level import Segment
from cmc.studies import peg_push
from cmc.studies.two_level import latent

K_P, K_D, K1, K2, ACTION, MASS, TICK, TICKS = 20.0, 30.0, 29.0, 0.7, 0.8, 3.0, 0.02, 20


class Linear(nn.Module):
    """u = clip of 3 y + 5 times the integral of y, for one dimension."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.tensor([3.0, 5.0]))

    def forward(self, s: torch.Tensor) -> torch.Tensor:
        return torch.tanh((s * self.gain).sum(-1, keepdim=True))


def one_axis(delay: int = 0, **options) -> LatentLow:
    values = (K_P, K_D, K1, K2, ACTION, MASS, 1.0)
    model = LatentModel(*(np.array([value]) for value in values), tick=TICK, delay=delay)
    return LatentLow(Linear(), [0], model, TICKS, LatentConfig(**options))


def reference(e: float, v: float, push: float, delay: int = 0) -> list[float]:
    """Errors at the end of every tick, integrated by another method."""
    integral, errors, late = 0.0, [], [0.0] * delay
    for _ in range(TICKS):
        y = K1 * e + K2 * v
        integral += TICK * y
        late.append(np.tanh(3.0 * y + 5.0 * integral))
        u = late.pop(0)

        def rhs(t, x, u=u):
            return [x[1], -K_D * x[1] - K_P * x[0] - ACTION * (u + push)]

        e, v = solve_ivp(rhs, (0, TICK), [e, v], rtol=1e-10, atol=1e-13).y[:, -1]
        errors.append(e)
    return errors


@pytest.mark.parametrize(("push", "delay"), [(0.0, 0), (0.4, 0), (-0.2, 1), (0.1, 3)])
def test_a_free_rollout_costs_the_error_of_the_differential_equation(push, delay):
    start, free, pushes = [[[0.003, -0.02]]], [[[False]]], [[[push]]]
    low = one_axis(delay)
    loss = low.rollouts.cost(
        low.actor, torch.tensor(start), torch.tensor(free), torch.tensor(pushes)
    )
    errors = reference(0.003, -0.02, push, delay)
    assert loss.item() == pytest.approx(np.mean(np.abs(errors)) / 0.003, rel=1e-4)


def test_a_blocked_rollout_costs_the_force_beyond_the_limit():
    weight, limit = 0.3, 0.5
    low = one_axis(force_weight=weight, force_limit=limit)
    start = torch.tensor([[[0.004, 0.5]]])  # a blocked axis does not move, whatever the start says
    loss = low.rollouts.cost(low.actor, start, torch.tensor([[[True]]]), torch.zeros(1, 1, 1))
    y = K1 * 0.004
    u = np.tanh(3.0 * y + 5.0 * TICK * y * np.arange(1, TICKS + 1))
    force = MASS * (K_P * 0.004 + ACTION * u)
    wanted = weight * np.maximum(force - limit, 0.0).mean()
    assert loss.item() == pytest.approx(wanted, rel=1e-4)


def test_without_starts_nothing_is_learned():
    low = one_axis()
    low.update()
    assert low.actor.gain.tolist() == [3.0, 5.0]


CONFIG = peg_push.STUDY.config_of("ctd3")


def trained(config, updates: int, **options) -> LatentLow:
    low = latent(replace(config, latent=replace(config.latent, batch=32, **options)), [0])
    rng = np.random.default_rng(0)
    observation = np.zeros((1, 1, 512, 25))
    observation[0, ..., 12:18] = rng.uniform(-1, 1, (512, 6)) * np.repeat([0.005, 0.3], 3)
    low.record(Segment(observation, None, None))
    for _ in range(updates):
        low.update()
    return low


def slopes(low: LatentLow, offset: int) -> np.ndarray:
    """d u / d y at rest by position, or of the integral with an offset of 6; translation."""
    seen, k, step = np.zeros((1, 6, 25)), np.arange(6), 1e-4
    seen[:, k, offset + k] = step
    up = low.act(seen, explore=False)[0, k, k]
    return (up / step)[:3]


def test_pure_tracking_goes_to_the_cap_and_the_integral_needs_a_push():
    config = replace(CONFIG, start_gain=20.0)  # both ways from a large start
    cap = config.slope_cap()[:3]
    alone = trained(config, 200, force_weight=0.0, disturbance=0.0)
    pushed = trained(config, 200, force_weight=0.0, disturbance=0.5)
    assert np.all(slopes(alone, 0) > 0.95 * cap)
    for low in (alone, pushed):
        assert np.all(slopes(low, 0) <= cap * (1 + 1e-4))
    assert np.all(slopes(pushed, 6) > 3.0 * slopes(alone, 6))


def test_a_price_on_force_lowers_the_slope_of_heavy_axes():
    low = trained(CONFIG, 200, force_weight=1.0)
    x, y, z = slopes(low, 0)
    assert z < y < x  # in the order of the masses
    assert z < 0.5 * CONFIG.slope_cap()[2]

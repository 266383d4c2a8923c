"""Lesson 07, second part: model error on the peg, three tests and the truth."""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc import plants
from cmc.fast import budget
from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.certificates import common_metric, loop_jacobian
from cmc.theory.differential import F1
from cmc.theory.model_error import (
    model_error_metric_test,
    model_error_paper_test,
    nominal_metric,
)
from cmc.theory.sampled import sampled_margin

Array = NDArray[np.float64]

SHIFTS = {
    "time constants + 50 %": (1.5, 1.0, 1.0),
    "time constants - 50 %": (0.5, 1.0, 1.0),
    "stiffness + 100 %": (1.0, 2.0, 1.0),
    "surface + 50 %": (1.0, 1.0, 1.5),
    "all, signs at random": (None, 2.0, 1.5),
}
"""The paper's shifts of the peg: factors on tau_x and tau_z, K_sur, surface."""


def _peg(
    tau: Any, stiffness: Any, surface: Any, slopes: Array, draw: dict[str, Array]
) -> tuple[Array, Array]:
    """F1 and the loop's Jacobian of a shifted peg under identity transforms."""
    peg = plants.Peg(
        0.0437 * tau,
        0.01 * tau,
        draw["K_sur"] * stiffness,
        draw["surface_sin"] * surface,
        draw["surface_cos"] * surface,
    )
    y, u = draw["y"], draw["u"]
    space = AuxiliarySpace.from_transforms(np.eye(2), np.eye(2), peg.f_y(y, u), peg.f_u(y, u))
    jacobian = loop_jacobian(space.Lambda, space.R, slopes[..., 0], slopes[..., 1])
    return np.asarray(F1(space, slopes), float), jacobian


def _draw(rng: np.random.Generator, count: int) -> tuple[dict[str, Array], Array]:
    """Pegs, states and slopes as in the paper's ranges; slopes are our choice."""
    draw = {
        "K_sur": rng.uniform(1, 31, count),
        "surface_sin": rng.uniform(-0.01, 0.01, count),
        "surface_cos": rng.uniform(-0.01, 0.01, count),
        "y": np.stack([rng.uniform(1, 3, count), rng.uniform(-2.5, -0.5, count)], axis=-1),
        "u": np.stack([rng.uniform(1, 3, count), rng.uniform(-3, 1, count)], axis=-1),
    }
    return draw, -rng.uniform(0.02, 1.0, (count, 2, 2)) * np.array([1.0, 5.0])


@cache
def shift_tests(count: int = 20_000) -> dict[str, dict[str, float]]:
    """Share of random pegs and policies that each test of model error accepts, per shift."""
    shares = {}
    for name, (tau, stiffness, surface) in SHIFTS.items():
        rng = np.random.default_rng(0)
        draw, slopes = _draw(rng, count)
        factor = rng.choice([0.5, 1.5], count) if tau is None else tau
        F1_hat, nominal = _peg(1.0, 1.0, 1.0, slopes, draw)
        F1_real, real = _peg(factor, stiffness, surface, slopes, draw)
        paper = model_error_paper_test(F1_hat, F1_real)
        metric = model_error_metric_test(nominal, real)
        shares[name] = {
            "stable": float((np.linalg.eigvals(real).real.max(axis=-1) < 0).mean()),
            "paper, order": float(paper.order.mean()),
            "paper, premise": float(paper.premise.mean()),
            "nominal metric": float(metric.holds.mean()),
        }
    return shares


def box_metrics() -> tuple[int, int]:
    """How often one metric fits all 16 corners of the paper's shifts, and of how many policies.

    The entries of the Jacobian are products of 1/tau_x, 1/tau_z, K_sur and the surface, so the
    corners of these factors enclose every shift in between, at the state that was drawn.
    """
    policies = budget(12, 3)
    draw, slopes = _draw(np.random.default_rng(1), policies)
    factors = np.array(list(product((1.5, 0.5), (1.5, 0.5), (1.0, 2.0), (0.5, 1.5))))
    found = 0
    for i in range(policies):
        one = {key: value[i] for key, value in draw.items()}
        corners = []
        for tau_x, tau_z, stiffness, surface in factors:
            peg = plants.Peg(
                0.0437 * tau_x,
                0.01 * tau_z,
                one["K_sur"] * stiffness,
                one["surface_sin"] * surface,
                one["surface_cos"] * surface,
            )
            f_y, f_u = peg.f_y(one["y"], one["u"]), peg.f_u(one["y"], one["u"])
            corners.append(loop_jacobian(f_y, f_u, slopes[i, :, 0], slopes[i, :, 1]))
        found += common_metric(corners).holds
    return found, policies


def mismatch_map(points: int = 41) -> dict[str, Array]:
    """Rate of the peg's force loop in the nominal metric, and its sampled margin, over mismatch.

    One dimension: tau_z f' = -f + K_sur u with slopes 0.05 and 1.5 / s (our choice), tau_z and
    K_sur scaled by factors from 0.25 to 4.
    """
    factors = np.geomspace(0.25, 4.0, points)
    tau, stiffness = np.meshgrid(0.01 * factors, 16.0 * factors)
    rate = _force_rate(tau, stiffness)
    margin = sampled_margin(0.05, 1.5, tau, stiffness, 0.01)
    return {"factors": factors, "rate": rate, "margin": margin}


def force_loop(tau: ArrayLike, stiffness: ArrayLike) -> Array:
    """Jacobian of the peg's force loop for a lag (s) and a stiffness, slopes 0.05 and 1.5 / s."""
    lam, gain = -1.0 / np.asarray(tau, float), np.asarray(stiffness, float) / tau
    return loop_jacobian(lam[..., None, None], gain[..., None, None], [-0.05], [-1.5])


def _force_rate(tau: ArrayLike, stiffness: ArrayLike) -> Array:
    nominal = force_loop(0.01, 16.0)
    metric = nominal_metric(nominal)
    return model_error_metric_test(nominal, force_loop(tau, stiffness), metric=metric).real_rate


def mismatch(tau: float, stiffness: float) -> dict[str, Any]:
    """Slider: the force loop under a wrong model, and the verdict of each test.

    Args:
        tau: factor on tau_z.
        stiffness: factor on K_sur.
    """
    nominal, real = force_loop(0.01, 16.0), force_loop(0.01 * tau, 16.0 * stiffness)
    rate = float(_force_rate(0.01 * tau, 16.0 * stiffness))
    h = 0.01
    margin = float(sampled_margin(0.05, 1.5, 0.01 * tau, 16.0 * stiffness, h))
    error, total, path = 1.0, 0.0, []
    decay = np.exp(-h / (0.01 * tau))
    for _ in range(60):
        path.append(error)
        total += h * error
        command = -(0.05 * error + 1.5 * total)
        error = decay * error + (1 - decay) * 16.0 * stiffness * command
    verdict = "contracts" if rate > 0 else "not proved"
    held = "stable" if margin > 0 else "unstable"
    return {
        "t": h * np.arange(60),
        "e": np.clip(path, -50.0, 50.0),
        "nominal": np.linalg.eigvals(nominal).astype(complex),
        "real": np.linalg.eigvals(real).astype(complex),
        "text": f"in the nominal metric: {verdict} ({rate:.1f} 1/s); sampled at 10 ms: {held}",
    }

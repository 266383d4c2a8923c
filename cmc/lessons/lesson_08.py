"""Lesson 08: the peg-touch plant. Contact, the sign of the force, slopes, returns and stability."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import nn

from cmc.envs.peg_touch_config import PegShift, PegTouchConfig
from cmc.fast import budget
from cmc.plants import Peg
from cmc.studies.peg_touch_methods import LinearPI, TouchPolicy
from cmc.studies.peg_touch_motion import simulate
from cmc.theory.sampled import sampled_margin

Array = NDArray[np.float64]

GAINS: Array = np.array([[2.0, 40.0], [0.02, 8.0]])
"""A proportional-integral controller: rows x and force, columns error and integral."""
TASK = PegTouchConfig()


def controller(factor: float = 1.0) -> nn.Module:
    """The controller with its two force gains multiplied by `factor`."""
    return TouchPolicy(LinearPI(GAINS * np.array([[1.0], [factor]])))


def margin(
    stiffness: float | Array, factor: float | Array = 1.0, lags: float = 1.0, h: float = 0.01
) -> Array:
    """Margin of the sampled force loop; negative is unstable."""
    k1, k2 = (np.asarray(factor) * gain for gain in GAINS[1])
    return sampled_margin(k1, k2, TASK.tau_z * lags, stiffness, h)


def touch(
    stiffness: float = 15.0,
    factor: float = 1.0,
    lags: float = 1.0,
    surface: float = 0.01,
    num: int = 20,
) -> dict[str, Any]:
    """Touches of one surface from several starts.

    Args:
        stiffness: of the surface, N/m.
        factor: on the force gains.
        lags: factor on both lags of the plant.
        surface: both coefficients of the profile, m; the second with a minus.
        num: trajectories.

    Returns:
        `t` (T,), `x`, `z`, `f`, `e_x`, `e_f` (T, num), `margin` and `text`.
    """
    task = PegTouchConfig(shift=PegShift(tau_x=lags, tau_z=lags))
    fixed = {"K_sur": stiffness, "surface_sin": surface, "surface_cos": -surface}
    run = simulate(controller(factor), task, num=num, duration=0.6, parameters=fixed)
    slack = float(margin(stiffness, factor, lags))
    word = "stable" if slack > 0 else "unstable"
    keep = ("t", "x", "z", "f", "e_x", "e_f")
    return {**{key: run[key] for key in keep}, "margin": slack, "text": f"{word}, {slack:+.2f}"}


def one_touch() -> dict[str, Any]:
    """A single touch in detail, with R_22 of the plant: K / tau_z in contact, 0 in the air."""
    fixed = {"K_sur": 8.0, "x0": 1.3, "z0": 0.9, "x_d": 2.5, "f_d": -2.0}
    slope = {"surface_sin": 0.01, "surface_cos": 0.01}
    run = simulate(controller(0.5), TASK, num=1, duration=0.6, parameters={**fixed, **slope})
    peg = Peg(K_sur=8.0, **slope)
    R_22 = np.where(run["f"] < 0, 8.0 / TASK.tau_z, 0.0)
    return {**run, "surface": peg.surface(run["x"]), "R_22": R_22, "f_d": -2.0}


def secant_error(samples: int = 20_000) -> dict[str, float]:
    """How often g(x)/x in place of g'(x) gives the lower left entry of f_y the wrong sign."""
    rng = np.random.default_rng(0)
    low, high = TASK.surface
    peg = Peg(
        K_sur=rng.uniform(*TASK.K_sur, samples),
        surface_sin=rng.uniform(low, high, samples),
        surface_cos=rng.uniform(low, high, samples),
    )
    x = rng.uniform(*TASK.x_limits, samples)
    y = np.stack([x, -np.ones(samples)], axis=-1)
    exact, paper = peg.f_y(y, peg.hold(y))[:, 1, 0], peg.f_y_paper(y)[:, 1, 0]
    off = np.abs(paper - exact) / np.abs(exact)
    return {"wrong sign": float(np.mean(exact * paper < 0)), "median error": float(np.median(off))}


def slope_coupling(surface: float = 0.1, stiffness: float = 15.0) -> dict[str, Any]:
    """Move along a slope while pressing: the force error with and without T_y."""
    fixed: dict[str, float] = {"K_sur": stiffness, "x0": 1.2, "x_d": 2.8, "f_d": -1.5, "z0": -0.1}
    fixed |= {"surface_sin": surface, "surface_cos": -surface}
    answer: dict[str, Any] = {}
    for interface in ("identity", "auxiliary"):
        task = PegTouchConfig(interface=interface)
        run = simulate(controller(), task, num=1, duration=0.5, parameters=fixed)
        answer["t"], answer[interface] = run["t"], run["e_f"][:, 0]
        answer[f"{interface}_peak"] = float(np.abs(run["e_f"][8:, 0]).max())
    slope = Peg(surface_sin=surface, surface_cos=-surface).surface_slope(2.0)
    answer["text"] = f"slope {float(slope):+.2f}"
    return answer


def landscape(
    stiffest: float = 31.0, rare: float = 0.0, points: int | None = None
) -> dict[str, Any]:
    """Return over the force gain, averaged over the surfaces met in training.

    Args:
        stiffest: upper end of the stiffness met in training, N/m; the lower one is 1.
        rare: share of the surfaces that are stiffer than that, up to the paper's 31.
        points: gains to try.

    Returns:
        `factor` on the force gains (G,), `return` (G,), `best`: factor of the largest return,
        `edge`: factor at which a surface of stiffness `stiffest` becomes unstable, `edge_31`: the
        same for the paper's stiffest surface, `unstable`: share of the training's surfaces on
        which the best gain is unstable.
    """
    count = budget(41, 17) if points is None else points
    factor = np.geomspace(0.1, 6.0, count)
    num = budget(2000, 500)
    rng = np.random.default_rng(0)
    K = rng.uniform(1.0, stiffest, num)
    K[: round(rare * num)] = rng.uniform(stiffest, TASK.K_sur[1], round(rare * num))

    def score_of(value: float) -> float:
        run = simulate(controller(value), TASK, num=num, duration=0.5, parameters={"K_sur": K})
        return float(run["return"].mean())

    score = np.array([score_of(value) for value in factor])
    level = GAINS[1, 0] + 0.5 * TASK.h * GAINS[1, 1]
    bound = 1.0 / (np.tanh(TASK.h / (2 * TASK.tau_z)) * level)
    best = float(factor[np.argmax(score)])
    return {
        "factor": factor,
        "return": score,
        "best": best,
        "unstable": float(np.mean(margin(K, best) < 0)),
        "edge": float(bound / stiffest),
        "edge_31": float(bound / TASK.K_sur[1]),
    }


def stiffness_and_gain(points: int = 40) -> dict[str, Any]:
    """Margin of the force loop over stiffness and gain, with nothing to learn and no reward."""
    stiffness = np.linspace(1.0, 62.0, points)
    factor = np.geomspace(0.1, 6.0, points)
    values = margin(stiffness[None, :], factor[:, None])
    return {"stiffness": stiffness, "factor": factor, "margin": values}

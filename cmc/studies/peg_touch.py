"""Peg touch (section VI, appendix F, fig:1): PPO against C-PPO, 15,000 episodes, five seeds.

The paper gives the plant, the ranges of its parameters, the shifts of the test and the network's
shape. What it leaves open is chosen here, and everything that differs from it is in this list:

1. Position, force targets, start, control period (10 ms), episode (50 steps) and reward are ours
   (`PegTouchConfig`); so are all of PPO's hyperparameters (`PPOConfig`).
2. f_y is linearised exactly at the command that holds x, where the paper replaces g' by g / x and
   often gets the sign wrong. T_y then undoes the slope of the surface, and T_a is the identity.
3. Eigenvectors are scaled to a unit diagonal of T_y, which keeps them continuous along x.
4. Weights are made positive by their absolute value. The command is u0 + T_a a, clipped.
5. The integral is I_k = I_{k-1} + h z_k, the new error included.
6. The critic of the training sees the plant's parameters; the policy never does.
7. Oscillation and drift are not defined in the paper; `cmc.studies.detectors` defines them. Tests
   last 2 s with a deterministic policy, training episodes 0.5 s.
8. Arms that the paper has not: joint and raw inputs, identity transforms, no integral, slopes
   capped by the sampled-data bound (for half the lag and twice the stiffness), the same with most
   of the vertical room in a linear bypass, a cap on the loop gain with the nominal stiffness
   divided out, slopes bounded on both sides, gradients of convex networks (arXiv 2305.17777),
   hand-tuned PI, and a labeled stress setting of PPO.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from torch import nn

from cmc.envs.peg_touch_config import PegTouchConfig
from cmc.studies.peg_touch_arms import (
    Network,
    TouchConfig,
    TouchTraining,
    bounded,
    bypass,
    capped,
    convex,
    cppo,
    fixed,
    joint,
    no_integral,
    ppo,
    raw,
)
from cmc.studies.peg_touch_certificates import certificates
from cmc.studies.peg_touch_tests import SHIFTS, measure, shifted, signed, simulate
from cmc.studies.study import Method, Rows, Study, Test, last, same

PAPER_EPISODE = 5000
"""The episode whose policies the paper's generalization test uses (fig:1 c)."""

# -- methods --------------------------------------------


def arm(title: str, network: Network, adapt: Callable[[Any], Any] = same, **more: Any) -> Method:
    """A method that trains a network by PPO."""
    return Method(title, lambda c, seeds: TouchTraining(c, network(c, seeds), seeds), adapt, **more)


def seeing(config: TouchConfig, interface: str) -> TouchConfig:
    """The environment shows `auxiliary` signals, `identity` for T_y = I, or `raw` ones."""
    return replace(config, task=replace(config.task, interface=interface))


def scaled(config: TouchConfig) -> TouchConfig:
    """The vertical action is multiplied by 16 N/m, the middle of the range, over the nominal K."""
    return replace(config, task=replace(config.task, stiffness_reference=16.0))


def stress(config: TouchConfig) -> TouchConfig:
    """PPO set aggressively: large steps, more epochs, no floor under the noise."""
    harsh = replace(config.ppo, learning_rate=3e-3, epochs=10, log_std_floor=-20.0)
    return replace(config, ppo=harsh)


METHODS: dict[str, Method] = {
    "cppo": arm("C-PPO", cppo),
    "ppo": arm("PPO, one network per dimension", ppo),
    "cppo_capped": arm("C-PPO, capped", capped),
    "cppo_bypass": arm("C-PPO, capped, vertical bypass", bypass),
    "cppo_scaled": arm("C-PPO, capped loop gain", capped, scaled),
    "ppo_stress": arm("PPO, stress setting", ppo, stress),
    "cppo_stress": arm("C-PPO, stress setting", cppo, stress),
    "ppo_joint": arm("PPO, joint network", joint),
    "ppo_raw": arm("PPO, raw inputs", raw, partial(seeing, interface="raw")),
    "cppo_identity": arm("C-PPO, T_y = T_a = I", cppo, partial(seeing, interface="identity")),
    "cppo_bounded": arm("C-PPO, bounded on both sides", bounded),
    "cppo_no_integral": arm("C-PPO, no integral", no_integral),
    "convex_pi": arm("Convex-gradient PI", convex),
    "pi": arm("Hand-tuned PI", fixed((2.0, 40.0), (0.02, 8.0)), trained=False),
    "pi_scaled": arm(
        "Hand-tuned PI, scheduled on stiffness",
        fixed((2.0, 40.0), (0.012, 5.6)),
        scaled,
        trained=False,
    ),
}


# -- tests --------------------------------------------


def change(shift: str, h: float | None = None) -> Callable[[TouchConfig], TouchConfig]:
    """The plant shifted, and another control period if given."""
    return lambda config: replace(config, task=shifted(config.task, shift, h))


def paper(marks: Sequence[int]) -> Sequence[int]:
    """The kept policy of the paper's generalization test; in a shorter run the last one."""
    return [PAPER_EPISODE] if PAPER_EPISODE in marks else marks[-1:]


def sparse(marks: Sequence[int]) -> Sequence[int]:
    """Kept policies at which every method is tested."""
    return [m for m in marks if m in (1000, 5000, 10_000, 15_000) or m == marks[-1]]


def paper_and_last(marks: Sequence[int]) -> Sequence[int]:
    """Both, once."""
    return sorted({*paper(marks), *last(marks)})


_CAPPED = ("cppo_capped", "cppo_bypass")
_MAIN = ("cppo", "ppo", "cppo_bounded", "pi", "pi_scaled")
_TIMED = (*_CAPPED, "cppo", "ppo", "cppo_bounded")
_CURVES = ("ppo_stress", "cppo_stress", "ppo_joint", "ppo_raw")
_SIDE = tuple(name for name in METHODS if name not in _CAPPED + _MAIN)
_MANY, _FEW = 8000, 2000
SAMPLE_TIMES = (0.002, 0.005, 0.01, 0.02, 0.03)
"""Control periods of the test of the sampled-data bound [s]; training has 0.01."""

TESTS = (
    Test("nominal", _MANY, methods=("cppo", "ppo", *_CAPPED)),
    Test("nominal", _MANY, when=sparse, methods=_MAIN[2:]),
    Test("nominal", _FEW, methods=_CURVES),
    Test("nominal", _FEW, when=sparse, methods=tuple(m for m in _SIDE if m not in _CURVES)),
    *(
        Test(shift, number, change(shift), when, methods)
        for shift in SHIFTS
        if shift != "nominal"
        for number, when, methods in (
            (_MANY, same, _CAPPED),
            (_MANY, paper_and_last, _MAIN),
            (_FEW, paper, _SIDE),
        )
    ),
    *(
        Test("nominal", _FEW, change("nominal", h), paper, _TIMED)
        for h in SAMPLE_TIMES
        if h != PegTouchConfig().h
    ),
)


def judge(config: TouchConfig, policy: nn.Module, seeds: int, test: Test) -> dict[str, Rows]:
    """One test of one policy, and what its weights guarantee."""
    sized = replace(config.test, trajectories=test.number)
    found = measure(policy, config.task, sized, seeds)
    if test.change is same and signed(policy):
        found["certificates"] = certificates(policy, config.task, config.slope_limit())
    return found


def motion(config: TouchConfig, policy: nn.Module, episode: int) -> dict[str, Any]:
    """Errors of 50 trajectories of the training set, from a random stream of this number."""
    run = simulate(policy, config.task, seed=episode)
    end_x, end_f = (np.median(np.abs(run[key][-1])) for key in ("e_x", "e_f"))
    signals = [
        (r"$x - x_d$ (m)", run["e_x"], 0.0),
        (r"$f - f_d$ (N)", np.clip(run["e_f"], -10.0, 10.0), 0.0),
    ]
    text = f"50 trajectories end {end_x:.2g} m and {end_f:.2g} N from their targets (median)"
    return {"t": run["t"], "signals": signals, "text": text}


STUDY = Study(
    name="peg_touch",
    about="PPO against C-PPO: a peg on a lag presses on a surface of unknown stiffness",
    config=TouchConfig(),
    methods=METHODS,
    tests=TESTS,
    length=15_000,
    every=1000,
    judge=judge,
    motion=motion,
    shown=paper,
    unit="episode",
    gain="return",
)


def at_period(h: float) -> Study:
    """The study with another control period [s]: episodes and discounts keep their duration."""
    share = h / STUDY.config.task.h
    task = replace(STUDY.config.task, h=h, horizon=round(STUDY.config.task.horizon / share))
    old = STUDY.config.ppo
    rates = {"gamma": old.gamma**share, "gae_lambda": old.gae_lambda**share}
    about = f"the same, trained at a control period of {1e3 * h:g} ms"
    config = replace(STUDY.config, task=task, ppo=replace(old, steps=task.horizon, **rates))
    names = ("cppo", "ppo", "ppo_raw")
    tests = tuple(
        Test(shift, _FEW, change(shift), same if shift == "nominal" else paper) for shift in SHIFTS
    )
    methods = {name: METHODS[name] for name in names}
    name = f"peg_touch_{1e3 * h:g}ms"
    return replace(STUDY, name=name, about=about, config=config, methods=methods, tests=tests)


VARIANTS = {study.name: study for study in (at_period(0.002), at_period(0.005))}

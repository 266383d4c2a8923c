"""Exercises of lessons 10 to 13."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from cmc.envs.peg_push import BOX_TOP, PUSH, PegPush
from cmc.plants import Plant
from cmc.policies import ModularPolicy, PositiveNetwork
from cmc.robot.panda import JOINTS
from cmc.theory.certify import certify
from cmc.theory.combinations import transforms_that_fit
from cmc.theory.exact import Region
from exercises import check, compare, expect, expect_close, numbers


def _states() -> Iterator[tuple[np.ndarray, ...]]:
    """M (7, 7), J (6, 7) and three vectors (7,), (6,), (6,): any will do."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        A = rng.normal(size=(JOINTS, JOINTS))
        M, J = A @ A.T + np.eye(JOINTS), rng.normal(size=(6, JOINTS))
        yield M, J, *(rng.normal(size=n) for n in (JOINTS, 6, 6))


@compare("10-torque", "the torque", atol=1e-6)
def torque() -> Iterator[Any]:
    """`my_torque(M, J, h, drift, p)`: M J^+ (p - drift) + h, which makes the tip's x'' be p."""
    for M, J, h, drift, p in _states():
        inertia, joints = np.linalg.inv(J @ np.linalg.solve(M, J.T)), M @ np.linalg.pinv(J)
        slips = {
            "J' q' counts twice: p is the whole acceleration x''": joints @ p + h,
            "h is missing": joints @ (p - drift),
            "the tip is right, but the joints differ: the acceleration form was asked for, M J^+": (
                J.T @ inertia @ (p - drift) + h
            ),
        }
        yield (M, J, h, drift, p), joints @ (p - drift) + h, slips


@check("10-posture")
def posture(answer: Any) -> None:
    """Judge `my_posture(M, J, qn)`: J M^-1 tau = 0, and as much of q'' = qn as that allows."""
    for M, J, qn, *_ in _states():
        made = np.linalg.solve(M, numbers(answer(M, J, qn), (JOINTS,), "the torque"))
        expect_close(J @ made, np.zeros(6), "what your torque does to the tip", atol=1e-7)
        free = np.linalg.svd(J)[2][-1]  # the joint motion that the tip does not feel
        wanted = free @ qn, free @ M @ qn / (free @ M @ free)
        said = f"at {wanted[0]:.3g} or {wanted[1]:.3g} (M-weighted), yours at {free @ made:.3g}"
        expect(np.isclose(free @ made, wanted).any(), f"the elbow should accelerate {said}")


@compare("10-limit", "the limit for {0} kg")
def limit() -> Iterator[Any]:
    """`my_limit(mass, K_p, clip)`: mass (K_p clip + limit) = 1 N, and never below 0."""
    for mass, clip in ((1.7, 0.005), (4.0, 0.004), (7.0, 0.005)):
        yield (mass, 40.0, clip), max(0.0, 1.0 / mass - 40.0 * clip)


@check("11-target")
def target(answer: Any) -> None:
    """Judge `my_target(reward, following, actor, critics, discount, noise)` without noise first."""
    draw = torch.Generator().manual_seed(0)
    reward, following = torch.randn(64, 1, generator=draw), torch.randn(64, 15, generator=draw)
    critics = (lambda x: x[:, 15:18].sum(-1, keepdim=True), lambda x: 0.5 - x[:, 15:16])

    def ask(noise: float) -> Any:
        found = answer(reward, following, lambda s: 0.7 * s[:, :3], critics, 0.5, noise)
        return found.detach() if isinstance(found, torch.Tensor) else found

    a = torch.tanh(0.7 * following[:, :3])
    values = a.sum(-1, keepdim=True), 0.5 - a[:, :1]
    slips: dict[str, Any] = {
        "the smaller of the two values, not the larger": reward + 0.5 * torch.maximum(*values),
        "the smaller of the two values, not their mean": reward + 0.25 * (values[0] + values[1]),
        "one critic alone is too hopeful: take the smaller value": reward + 0.5 * values[0],
        "the discount is missing": reward + torch.minimum(*values),
        "the reward is missing": 0.5 * torch.minimum(*values),
    }
    wanted: Any = reward + 0.5 * torch.minimum(*values)
    expect_close(ask(0.0), wanted, "the target without noise", slips, atol=1e-5)
    expect(not torch.allclose(ask(0.2), wanted), "the slow actor's action should get noise")
    hint = "noise and action should stay in their bounds: clip the noise to 0.5, the action to 1"
    expect((ask(100.0) - reward).abs().max() <= 0.5 * 3.0 + 1e-5, hint)


@compare("11-relabel", "the position of the candidate that explains the actions best")
def relabel() -> Iterator[Any]:
    """`my_choice(states, actions, goals, act)`: the position of the likeliest sub-goal.

    Segments are made by low levels that pursue one of the candidates, with noise.
    """
    rng = np.random.default_rng(0)
    for _ in range(40):
        n, ticks, count = (int(rng.integers(*ends)) for ends in ((1, 5), (3, 9), (2, 7)))
        W, goals, drift = rng.normal(size=(n, 2 * n)), rng.normal(size=(count, n)), 0.4

        def act(state: np.ndarray, left: np.ndarray, W: np.ndarray = W) -> np.ndarray:
            return np.tanh(W @ np.concatenate([state, 2.0 * left]))

        states = rng.normal(size=n) + drift * rng.normal(size=(ticks, n)).cumsum(axis=0)
        acted = np.array(
            [[[act(s, g + k * (states[0] - s)) for s in states] for g in goals] for k in (0, 1)]
        )
        actions = acted[1, rng.integers(count)] + 0.3 * rng.normal(size=(ticks, n))
        whole, shrinking = ((actions - acted) ** 2).sum((2, 3))
        hint = "what is left of a sub-goal shrinks while it is pursued: g' = s + g - s'"
        slips = {hint: whole.argmin(), "is yours the largest squared error?": shrinking.argmax()}
        yield (states, actions, goals, act), shrinking.argmin(), slips


@compare("11-gain", "the gain for K_p = {0}, K_d = {1}")
def gain() -> Iterator[Any]:
    """`my_gain(K_p, K_d, h, level)`: (K_d + g K_2) h = level with the smaller root K_2."""
    for K_p, K_d, h, level in ((40.0, 20.0, 0.02, 1.0), (20.0, 30.0, 0.02, 2.0), (20, 10, 0.01, 1)):
        small, large = (2 * K_p / (K_d + s * np.sqrt(K_d**2 - 4 * K_p)) for s in (1, -1))
        slips = {"this is the larger root: K_d *plus* the square root": (level / h - K_d) / large}
        yield (K_p, K_d, h, level), (level / h - K_d) / small, slips


@compare("12-segment-return", "the rest of the segment's return at every tick")
def segment_return() -> Iterator[Any]:
    """`my_segment_return(rewards, horizon)`: the sum from every tick to its segment's end."""
    rng = np.random.default_rng(0)
    for segments, horizon in ((3, 5), (1, 4), (50, 20)):
        rewards = rng.normal(size=(segments, horizon))
        right = rewards[:, ::-1].cumsum(1)[:, ::-1].ravel()
        on = {"the sum ends with the segment": rewards.ravel()[::-1].cumsum()[::-1]}
        yield (rewards.ravel(), horizon), right, on


@compare("12-discount", "the smallest discount at which pushing is worth more")
def discount() -> Iterator[Any]:
    """`my_discount(push, stand)`: the first of 0, .01, .. .99 at which push is worth more."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        push = np.r_[-rng.uniform(0.1, 0.3, 4), np.zeros(16)]
        stand, steps = np.full(20, -rng.uniform(0.04, 0.09)), np.arange(100) / 100
        better = [((push - stand) * gamma ** np.arange(20)).sum() > 0 for gamma in steps]
        yield (push, stand), steps[int(np.argmax(better))]


@check("12-plan")
def plan(answer: Any) -> None:
    """Judge `my_plan()`: waypoints (y, z), mm, that end in a strict touch with a return above -90.

    The low level is u = tanh(20 (y + integral of y)); the start is that of the lesson.
    """
    points = answer()
    way = numbers(points, (len(points or ()), 2), "the list of points (y, z)")
    task, total, stage = PegPush(PUSH, num=1, seed=0), 0.0, 0
    obs, layout = task.reset(), task.layout
    for k in range(PUSH.ticks):
        if k % PUSH.horizon == 0:
            tip = 1e3 * (obs[0, layout["position"]] - BOX_TOP)
            stage += bool(np.abs(tip[1:] - way[stage]).max() < 0.7 and stage < len(way) - 1)
            step = 1e-3 * np.r_[-tip[0], way[stage] - tip[1:]]
            obs = task.set_subgoal(np.r_[step, -obs[0, layout["rotation"]]][None])
        u = np.tanh(20.0 * (obs[:, layout["latent"]] + obs[:, layout["integral"]]))
        obs, reward, *_, info = task.step(u)
        total += float(reward[0])
    away = 1e3 * float(np.linalg.norm(obs[0, layout["goal"]] - obs[0, layout["position"]]))
    where = f"{away:.2f} mm from the target, at waypoint {stage + 1} of {len(way)}"
    expect(info["success"][0], f"the tip ends {where}: no strict touch")
    expect(total > -90.0, f"a strict touch, with a return of {total:.0f}; wanted above -90")


@check("13-order")
def order(answer: Any) -> None:
    """Judge `my_order(f_y)`: upper triangular in that order, None where two drive each other."""
    rng = np.random.default_rng(0)
    for n in (2, 3, 5, 6):
        names = rng.permutation(n)
        f_y = np.triu(rng.uniform(0.5, 1.5, (n, n)) * (rng.random((n, n)) < 0.6))[names][:, names]
        found = answer(f_y.copy())
        expect(found is not None, f"an order exists for {f_y.round(1).tolist()}")
        found = [int(i) for i in found]
        expect(sorted(found) == list(range(n)), f"{found} is no order of {n} signals")
        below = np.tril(f_y[found][:, found], -1)
        expect(not below.any(), f"in the order {found} a signal still drives one after it")
    ring = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0], [1.0, 0.0, -1.0]])
    expect(answer(ring) is None, "in a ring of three everybody is driven: there is no order")


@check("13-hold")
def hold(answer: Any) -> None:
    """Judge `my_hold(proved, low, high)`: the largest proved h to 1 %, with few questions."""
    for edge in (0.37, 2.9, 0.051):
        asked: list[float] = []

        def proved(h: float, edge: float = edge, asked: list[float] = asked) -> bool:
            asked.append(h)
            return h <= edge

        found = float(numbers(answer(proved, 0.05, 3.0), (), "the hold"))
        expect(found <= edge, f"{found:.4g} s is not proved, the edge is at {edge:.4g} s")
        expect(found >= 0.99 * edge, f"{found:.4g} s falls short of {edge:.4g} s by over 1 %")
        expect(len(asked) <= 30, f"{len(asked)} questions, wanted at most 30")


@compare("13-angle", "the angle that {0} Nm can hold, at most 90 degrees,")
def angle() -> Iterator[Any]:
    """`my_angle(limit)`: 3 limit = 15 sin(angle), 90 degrees where it always suffices."""
    for limit in (0.5, 2.0, 4.9, 5.0, 8.0):
        yield (limit,), np.arcsin(min(3 * limit / 15, 1.0))


@check("13-own")
def own(answer: Any) -> None:
    """Judge `my_plant()`: f, y, u, floor, cap; not linear, n >= 2, certified in the middle."""
    found = answer()
    hint = "wanted five things: f, y, u, floor and cap"
    expect(isinstance(found, tuple) and len(found) == 5, hint)
    f, y, u, floor, cap = found
    plant = Plant.from_function(f, y=y, u=u)
    expect(plant.n >= 2, f"wanted at least two signals, got {plant.n}")
    expect(not plant.constant, "this plant is linear: its Jacobians are the same everywhere")
    fits = [option for option in transforms_that_fit(plant) if option.possible]
    expect(fits, "no transforms fit; print transforms_that_fit(plant)")
    middle, half = (plant.y_low + plant.y_high) / 2, (plant.y_high - plant.y_low) / 2
    network = PositiveNetwork(plant.n, slope_min=floor, slope_max=cap)
    policy = ModularPolicy(network, u0=plant.hold(middle))
    box = Region(middle - half / 2, middle + half / 2, integral=0.5, points=5)
    said = certify(policy, plant, region=box, transforms=fits[0].transforms, y_ref=middle)
    expect(said, f"with {fits[0].name}: {said}")

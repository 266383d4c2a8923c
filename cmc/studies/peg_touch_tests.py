"""Tests of a peg-touch policy: stability shares, their prediction, slope signs, motions."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from cmc.envs.peg_touch import PegShift, PegTouchConfig, PegTouchVectorEnv
from cmc.plants import Lags
from cmc.policies import ConvexGradientNetwork, ModularPolicy
from cmc.studies.study import Array, Rows, Test, same
from cmc.theory.arrays import checked, number
from cmc.theory.certify import certify
from cmc.theory.sampled import sampled_margin

Flags = NDArray[np.bool_]
SHIFTS: dict[str, PegShift] = {
    "nominal": PegShift(),
    "lags x 0.5": PegShift(tau_x=0.5, tau_z=0.5),
    "lags x 1.5": PegShift(tau_x=1.5, tau_z=1.5),
    "stiffness x 2": PegShift(K_sur=2.0),
    "surface x 0.5": PegShift(surface=0.5),
    "surface x 1.5": PegShift(surface=1.5),
    "all, slow": PegShift(tau_x=1.5, tau_z=1.5, K_sur=2.0, surface=1.5),
    "all, fast": PegShift(tau_x=0.5, tau_z=0.5, K_sur=2.0, surface=1.5),
}
"""The paper's shifts of the plant, singly and jointly; the controller keeps the nominal model."""
ERROR_BINS: Array = np.logspace(-5, 2, 57)  # edges of the histograms of force errors, N

# All that follows is our choice; the paper's test has 8000 trajectories for each checkpoint.
# Length of a test, four training episodes, and of the tail that is judged, s; below 0.5 s of tail
# transients pass for drift.
DURATION, WINDOW = 2.0, 1.0
SEED = 20_231_103  # random stream of the tests; never used in training
SIGN_EVERY = 25  # steps between two samples of the slopes on visited states
THRESHOLD: Array = np.array([0.02, 0.10])  # smallest movement or error that counts, m and N
# Of an oscillation: zero crossings of the detrended tail, and the smallest peak-to-peak of the
# tail's second half over that of its first.
CROSSINGS, PERSISTENCE = 4, 0.7


def judge(config: Any, policy: nn.Module, seeds: int, test: Test) -> dict[str, Rows]:
    """One test of one policy, and what its weights guarantee."""
    found = measure(policy, config.task, test.number, seeds)
    if test.change is same and _signed(policy):
        found["certificates"] = _certificates(policy, config.task, config.slope_limit())
    return found


def measure(policy: nn.Module, task: PegTouchConfig, number: int, seeds: int) -> dict[str, Rows]:
    """Test a policy on (seeds, number, 4) inputs; the columns of `cmc.results`.

    Where the policy has slopes, oscillation is predicted: at the equilibrium found from the weights
    alone if they guarantee signs and see the integral, else at the mean input of the last second.
    """
    run = record(policy, task, number, seeds)
    flags = {name: f.reshape(seeds, number) for name, f in detect(run.tail, task.h).items()}
    size = np.abs(run.tail).mean(axis=0, dtype=np.float64).reshape(seeds, number, 2)
    found = {"return": run.returns.mean(axis=1)} | {k: f.mean(axis=1) for k, f in flags.items()}
    found["error_x"], found["error_f"] = np.median(size, axis=1).T
    found["error_f_90"] = np.quantile(size[..., 1], 0.9, axis=1)
    more: dict[str, Any] = {"trajectories": number, "h": task.h}
    if run.wrong_sign is not None:
        found["wrong_sign_signal"], found["wrong_sign_integral"] = run.wrong_sign.T
        from_weights = _signed(policy) and bool(policy.integral)
        s, reachable = torch.as_tensor(run.mean_s, dtype=torch.float32), np.ones((seeds, number))
        if from_weights:
            s, exists = equilibrium(policy, run.envs, seeds)
            reachable = np.all(exists, axis=-1)
        predicted = _predicted_oscillation(policy, s, run.envs)
        more["prediction"] = "weights" if from_weights else "visited"
        found["predicted_oscillation"] = predicted.mean(axis=1)
        found["agreement"] = (predicted == flags["oscillation"]).mean(axis=1)
        found["reachable"] = reachable.mean(axis=1)
    rows = [{"seed": k, **more, **{name: v[k] for name, v in found.items()}} for k in range(seeds)]
    counts, _ = np.histogram(np.clip(size[..., 1], ERROR_BINS[0], ERROR_BINS[-1]), ERROR_BINS)
    bins = zip(ERROR_BINS, ERROR_BINS[1:], counts, strict=False)
    binned = [{"low_N": a, "high_N": b, "count": int(c)} for a, b, c in bins if c]
    return {"tests": rows, "histograms": binned}


class Recording(NamedTuple):
    """What one test leaves of S seeds and M trajectories each."""

    tail: NDArray[np.float32]  # errors in the judged window, (time, S M, 2), m and N
    mean_s: Array  # mean of the policy's input over that window, (S, M, 2, 2)
    returns: Array  # sum of rewards over the first `horizon` steps, (S, M)
    wrong_sign: Array | None  # share of visited states with a negative [signal, integral], (S, 2)
    envs: PegTouchVectorEnv  # after the last step


def record(policy: nn.Module, task: PegTouchConfig, num: int, seeds: int = 1) -> Recording:
    """Run a policy with its leading axis of `seeds` on the same trajectories for each seed."""
    envs = PegTouchVectorEnv(seeds * num, task, AutoresetMode.DISABLED, privileged=False)
    steps, count = round(DURATION / task.h), round(WINDOW / task.h)
    obs, _ = envs.reset(seed=[SEED] * seeds)
    returns, mean_s = np.zeros(seeds * num), np.zeros((seeds, num, 4))
    tail = np.empty((count, seeds * num, 2), dtype=np.float32)
    wrong, sampled = np.zeros((seeds, 2)), 0
    for k in range(steps):
        s = torch.as_tensor(obs).reshape(seeds, num, 4)
        with torch.no_grad():
            action = policy(s)
            if k % SIGN_EVERY == 0 and isinstance(policy, ModularPolicy):
                slope = policy.jacobian(s.unflatten(-1, (2, 2)))
                wrong += (slope < 0).any(dim=-2).double().mean(dim=1).numpy()
                sampled += 1
        obs, reward, *_ = envs.step(action.reshape(seeds * num, 2).numpy())
        if k < task.horizon:
            returns += reward
        if k >= steps - count:
            tail[k - steps + count] = envs.error
            mean_s += obs.reshape(seeds, num, 4) / count
    wrong_sign, seen = wrong / sampled if sampled else None, mean_s.reshape(seeds, num, 2, 2)
    return Recording(tail, seen, returns.reshape(seeds, num), wrong_sign, envs)


def detect(error: ArrayLike, h: float) -> dict[str, Flags]:
    """Classify trajectories by the tail of their errors; the paper defines none of these.

    For each signal, with the tail's linear trend removed:

    - `oscillation`: at least `CROSSINGS` sign changes, peak-to-peak of the last half above the
      threshold and at least `PERSISTENCE` of the first half's;
    - `drift`: no oscillation, |trend| times the window above the threshold, and a mean |e| that is
      larger in the last half than in the first;
    - `offset`: neither, but |mean e| above the threshold.

    A trajectory has a flag if one of its signals has; oscillation goes before drift before offset.

    Takes tracking errors (time, batch, 2), m and N, sampled every `h` seconds; returns the flags,
    (batch,) each, of which at most one is set. A ValueError says if the record is shorter than the
    window, of another shape, or not finite.
    """
    e = np.asarray(error)
    e = e if e.dtype == np.float32 else checked("error", error)
    if e.ndim != 3 or e.shape[-1] != len(THRESHOLD) or not e.size:
        raise ValueError(f"error: wanted (time, batch, {len(THRESHOLD)}), got {e.shape}")
    count = round(WINDOW / number("h", h, above=0))
    if count < 8 or len(e) < count:
        raise ValueError(
            f"error, h: wanted at least 8 samples in a window of {WINDOW} s and a record no "
            f"shorter than it; got {len(e)} samples every {h} s"
        )
    tail, half = e[-count:], count // 2
    if not np.isfinite(tail).all():
        raise ValueError("error: wanted finite values, got NaN or infinity")
    time = ((np.arange(count) - (count - 1) / 2) * h).astype(e.dtype)
    trend = np.tensordot(time, tail, axes=(0, 0)) / np.sum(time**2)
    residual = tail - tail.mean(axis=0) - time[:, None, None] * trend
    crossings = (np.signbit(residual[1:]) != np.signbit(residual[:-1])).sum(axis=0)
    swing_first, swing_last = np.ptp(residual[:half], axis=0), np.ptp(residual[half:], axis=0)
    swings = (swing_last > THRESHOLD) & (swing_last >= PERSISTENCE * swing_first)
    size = np.abs(tail)
    grows = size[half:].mean(axis=0) > size[:half].mean(axis=0)
    oscillation = ((crossings >= CROSSINGS) & swings).any(axis=-1)
    drift = ((np.abs(trend) * WINDOW > THRESHOLD) & grows).any(axis=-1) & ~oscillation
    offset = (np.abs(tail.mean(axis=0)) > THRESHOLD).any(axis=-1) & ~oscillation & ~drift
    return {"oscillation": oscillation, "drift": drift, "offset": offset}


def equilibrium(policy: nn.Module, envs: PegTouchVectorEnv, seeds: int) -> tuple[Tensor, Flags]:
    """The input (0, I*) at which a contracting policy holds the targets, by bisection.

    pi_i(0, I) grows with I, so I* solves u0 - pi(0, I*) = (x_d, f_d / K + g(x_d)). Returns the
    input (seeds, trajectories, 2, 2), and whether an equilibrium exists, (..., 2): tanh networks
    saturate, and some targets need more command than they can give.
    """
    c, x_d = envs.config, envs.sampled["x_d"]
    wanted = np.stack([x_d, envs.true_peg.height(x_d, envs.sampled["f_d"])], axis=-1)
    a = wanted - np.asarray(c.u0)
    if c.stiffness_reference is not None:
        a[:, 1] *= envs.sampled["K_sur"] / c.stiffness_reference
    target = torch.as_tensor(a.reshape(seeds, -1, 2), dtype=torch.float32)
    low, high = torch.full_like(target, -1e3), torch.full_like(target, 1e3)

    def command(integral: Tensor) -> Tensor:
        s = torch.stack([torch.zeros_like(integral), integral], dim=-1)
        return policy(s.flatten(-2))

    with torch.no_grad():
        exists = (command(low) > target) & (command(high) < target)
        for _ in range(40):
            middle = 0.5 * (low + high)
            above = command(middle) > target
            low, high = torch.where(above, middle, low), torch.where(above, high, middle)
    middle = 0.5 * (low + high)
    return torch.stack([torch.zeros_like(middle), middle], dim=-1), exists.numpy()


def _predicted_oscillation(policy: nn.Module, s: Tensor, envs: PegTouchVectorEnv) -> Flags:
    """Whether the sampled loop of some dimension is unstable at the inputs `s`, (seeds, num).

    The local slopes k1, k2 go into k1 + (h/2) k2 < coth(h / (2 tau)) / K with the true tau and K.
    """
    c = envs.config
    slope = policy.jacobian(s).detach().double().numpy()  # type: ignore[operator]
    K = np.ones((envs.num_envs, 2))
    K[:, 1] = envs.true_peg.K_sur
    if c.stiffness_reference is not None:
        K[:, 1] *= c.stiffness_reference / envs.sampled["K_sur"]
    tau = np.array([c.tau_x * c.shift.tau_x, c.tau_z * c.shift.tau_z])
    # only the upper side: a wrong sign drifts, it does not oscillate
    k1, k2 = np.moveaxis(np.maximum(slope, 0.0), -1, 0)
    K = K.reshape(*slope.shape[:2], 2)
    return np.any(sampled_margin(k1, k2, tau, K, c.h) < 0, axis=-1)


def _signed(policy: nn.Module) -> bool:
    """Whether the weights guarantee the sign of every slope, each dimension on its own."""
    network = getattr(policy, "network", None)
    return hasattr(network, "slope_bounds") and not isinstance(network, ConvexGradientNetwork)


def _certificates(policy: nn.Module, task: PegTouchConfig, limit: Array) -> Rows:
    """What holds for each seed of a policy, from its weights alone.

    In contact and in the coordinates (x, z) the peg is two separate lags with gains 1 and K,
    exactly; the surface only couples the first into the second. Each loop can be judged alone.

    Rows have `seed` (position) and, for all states: `signs`: every slope has the right sign, so
    each linearization is a stable continuous loop (the paper's condition). `slope_x`, `slope_z`:
    k1 + (h/2) k2, bounded by the product of the weights. `stiffest`: stiffness up to which the
    sampled loop of every linearization is stable at the nominal lags, N/m; `stiffness_factor`: the
    same over the stiffest of the training set; `x_margin`: the same for the horizontal loop, as a
    factor on its gain. `design`: whether the slopes stay below `limit` (2,), the largest for the
    worst plant of the design. `contracting`, `rate`: whether one quadratic metric proves
    contraction for all slopes that the weights allow, sampled, on the softest and the stiffest
    surface of the training set; `reason`: why not.
    """
    lower, upper = (b.reshape(-1, 2, 2) for b in policy.slope_bounds())  # type: ignore[operator]
    steepest = upper[..., 0] + 0.5 * task.h * upper[..., 1]
    tau, reference = np.array([task.tau_x, task.tau_z]), task.stiffness_reference
    margin = 1.0 / np.tanh(task.h / (2.0 * tau)) / steepest
    # a cap on the loop gain allows any nominal stiffness: what counts is the factor on it
    gains = task.K_sur if reference is None else [reference]
    rows = []
    for k, bounds in enumerate(zip(lower, upper, strict=True)):
        own = SimpleNamespace(slope_bounds=lambda bounds=bounds: bounds)
        plants = [Lags(tau=tuple(tau), gain=(1.0, gain)) for gain in gains]
        found = [certify(own, plant, h=task.h) for plant in plants]
        rows.append(
            {
                "seed": k,
                "signs": bool((bounds[0] >= 0.0).all()),
                "slope_x": steepest[k, 0],
                "slope_z": steepest[k, 1],
                "stiffest": margin[k, 1] if reference is None else None,
                "stiffness_factor": margin[k, 1] / gains[-1],
                "x_margin": margin[k, 0],
                "design": bool((steepest[k] < limit).all()),
                "contracting": all(part.holds for part in found),
                "rate": min((part.rate for part in found if part.holds), default=None),
                "reason": next((part.reason for part in found if not part.holds), ""),
            }
        )
    return rows


def motion(config: Any, policy: nn.Module, episode: int) -> dict[str, Any]:
    """Errors of 50 trajectories of the training set for 1 s, from a random stream of this number.

    `t` (time,), `signals` (label, errors by time and trajectory, target), and `text`.
    """
    envs, errors = PegTouchVectorEnv(50, config.task, AutoresetMode.DISABLED), []
    obs, _ = envs.reset(seed=episode)
    for _ in range(round(1.0 / config.task.h)):
        errors.append(np.array(envs.error))
        with torch.no_grad():
            action = policy(torch.as_tensor(obs)[None])[0].numpy()
        obs, *_ = envs.step(action)
    e_x, e_f = np.moveaxis(np.array(errors), -1, 0)
    end_x, end_f = np.median(np.abs(errors[-1]), axis=0)
    text = f"50 trajectories end {end_x:.2g} m and {end_f:.2g} N from their targets (median)"
    force = (r"$f - f_d$ (N)", np.clip(e_f, -10.0, 10.0), 0.0)
    t = config.task.h * np.arange(len(errors))
    return {"t": t, "signals": [(r"$x - x_d$ (m)", e_x, 0.0), force], "text": text}

"""What is guaranteed about a peg-touch policy, from its weights alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import nn

from cmc.envs.peg_touch_config import PegTouchConfig
from cmc.plants import Lags
from cmc.studies.study import Rows
from cmc.theory.certify import certify

Array = NDArray[np.float64]


class _Bounds:
    """Slope bounds of one seed, in the shape that `certify` asks a policy for."""

    def __init__(self, lower: Array, upper: Array) -> None:
        self.bounds = lower, upper

    def slope_bounds(self) -> tuple[Array, Array]:
        """Smallest and largest slopes, (2, 2) each."""
        return self.bounds


def certificates(policy: nn.Module, task: PegTouchConfig, limit: Array) -> Rows:
    """What holds for each seed of a policy.

    In contact and in the coordinates (x, z) the peg is two separate lags with gains 1 and K,
    exactly; the surface only couples the first into the second. Each loop can be judged alone.

    Args:
        policy: with `slope_bounds`.
        task: at the nominal lags.
        limit: what k1 + (h/2) k2 must stay below for the worst plant of the design, (2,).

    Returns:
        Rows with `seed` (position), `signs`: every slope has the right sign, everywhere: each
        linearization is a stable continuous loop (the paper's condition).
        `slope_x`, `slope_z`: k1 + (h/2) k2, bounded by the product of the weights.
        `stiffest`: stiffness up to which the sampled loop of every linearization is stable at the
        nominal lags [N/m]; `stiffness_factor`: the same over the stiffest of the training set;
        `x_margin`: the same for the horizontal loop, as a factor on its gain.
        `design`: whether `limit` is met, everywhere.
        `contracting`, `rate`: whether one quadratic metric proves contraction for all slopes that
        the weights allow, sampled, on the softest and the stiffest surface of the training set.
        `reason`: why not.
    """
    lower, upper = (b.reshape(-1, 2, 2) for b in policy.slope_bounds())  # type: ignore[operator]
    steepest = upper[..., 0] + 0.5 * task.h * upper[..., 1]
    nominal = 1.0 / np.tanh(task.h / (2.0 * np.array([task.tau_x, task.tau_z])))
    # a cap on the loop gain allows any nominal stiffness: what counts is the factor on it
    reference = task.stiffness_reference
    gain = nominal[1] / steepest[:, 1] / (1.0 if reference is None else reference)
    rows = []
    for k, (low, high) in enumerate(zip(lower, upper, strict=True)):
        found = _contraction(low, high, task)
        rows.append(
            {
                "seed": k,
                "signs": bool((lower >= 0.0).all()),
                "slope_x": steepest[k, 0],
                "slope_z": steepest[k, 1],
                "stiffest": None if reference is not None else gain[k],
                "stiffness_factor": gain[k] / (1.0 if reference is not None else task.K_sur[1]),
                "x_margin": nominal[0] / steepest[k, 0],
                "design": bool((steepest[k] < limit).all()),
                "contracting": all(part.holds for part in found),
                "rate": min((part.rate for part in found if part.holds), default=None),
                "reason": next((part.reason for part in found if not part.holds), ""),
            }
        )
    return rows


def _contraction(low: Array, high: Array, task: PegTouchConfig) -> list[Any]:
    """Certificates of one seed for the softest and the stiffest surface of the training set."""
    gains = task.K_sur if task.stiffness_reference is None else [task.stiffness_reference]
    plants = [Lags(tau=(task.tau_x, task.tau_z), gain=(1.0, gain)) for gain in gains]
    return [certify(_Bounds(low, high), plant, h=task.h) for plant in plants]

"""What is guaranteed about each kept policy of the peg-touch study, from its weights alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc.plants import Lags
from cmc.studies.peg_touch_methods import method
from cmc.studies.peg_touch_training import PegTouchStudy, contents, load, slope_limit, task_of
from cmc.theory.certify import certify

Array = NDArray[np.float64]


class _Bounds:
    """Slope bounds of one seed, in the shape that `certify` asks a policy for."""

    def __init__(self, lower: Array, upper: Array) -> None:
        self.bounds = lower, upper

    def slope_bounds(self) -> tuple[Array, Array]:
        """Smallest and largest slopes, (2, 2) each."""
        return self.bounds


def certificates(name: str, path: str | Path | None = None) -> list[dict[str, Any]]:
    """One entry for each kept policy; see `certificate_of` for what is in it."""
    if not method(name).trained:
        return [certificate_of(name, None)]
    marks, _ = contents(name, path)
    return [certificate_of(name, mark, path) for mark in marks]


def certificate_of(
    name: str, episode: int | None, path: str | Path | None = None
) -> dict[str, Any]:
    """What holds for one kept policy; lists have one entry for each seed.

    In contact and in the coordinates (x, z) the peg is two separate lags with gains 1 and K,
    exactly; the surface only couples the first into the second. Each loop can be judged alone.

    Returns:
        `signs`: every slope has the right sign, everywhere: each linearization is a stable
        continuous loop (the paper's condition).
        `largest_slope`: k1 + (h/2) k2 of each dimension, bounded by the product of the weights.
        `stiffest`: stiffness up to which the sampled loop of every linearization is stable at the
        nominal lags [N/m]; `x_margin`: the same for the horizontal loop, as a factor on its gain.
        `design`: whether the bound is met for the shortest lags and the stiffest surface of the
        design, everywhere.
        `contracting`, `rate`: whether one quadratic metric proves contraction for all slopes that
        the weights allow, sampled, on the softest and the stiffest surface of the training set.
        `reason`: why the first of them is not proved to contract.
    """
    study, task = PegTouchStudy(), task_of(name)
    lower, upper = load(name, episode, path=path).slope_bounds()  # type: ignore[operator]
    lower, upper = lower.reshape(-1, 2, 2), upper.reshape(-1, 2, 2)
    steepest = upper[..., 0] + 0.5 * task.h * upper[..., 1]
    reference = task.stiffness_reference
    nominal = 1.0 / np.tanh(task.h / (2.0 * np.array([task.tau_x, task.tau_z])))
    found = [_contraction(name, low, high, study) for low, high in zip(lower, upper, strict=True)]
    # a cap on the loop gain allows any nominal stiffness: what counts is the factor on it
    gain = nominal[1] / steepest[:, 1] / (1.0 if reference is None else reference)
    return {
        "episode": episode,
        "signs": bool((lower >= 0.0).all()),
        "largest_slope": np.round(steepest, 6).tolist(),
        "stiffest": None if reference is not None else np.round(gain, 3).tolist(),
        "stiffness_factor": np.round(gain / (1.0 if reference else task.K_sur[1]), 3).tolist(),
        "x_margin": np.round(nominal[0] / steepest[:, 0], 3).tolist(),
        "design": [bool((s < slope_limit(name, study)).all()) for s in steepest],
        "contracting": [all(part.holds for part in pair) for pair in found],
        "rate": [min((part.rate for part in pair if part.holds), default=None) for pair in found],
        "reason": next((part.reason for pair in found for part in pair if not part.holds), ""),
    }


def _contraction(name: str, low: Array, high: Array, study: PegTouchStudy) -> list[Any]:
    """Certificates of one seed for the softest and the stiffest surface of the training set."""
    task = task_of(name, study)
    gains = task.K_sur if task.stiffness_reference is None else [task.stiffness_reference]
    plants = [Lags(tau=(task.tau_x, task.tau_z), gain=(1.0, gain)) for gain in gains]
    return [certify(_Bounds(low, high), plant, h=task.h) for plant in plants]

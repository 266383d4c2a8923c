"""Oscillation, drift and offset of recorded tracking errors.

The paper plots the share of oscillating and of drifting trajectories and defines neither; these
definitions are our choice. They look at the last second of a test with a deterministic policy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class DetectorConfig:
    """Thresholds of the three detectors; all of them our choice."""

    window: float = 1.0
    """Length of the tail that is judged [s]; below 0.5 s transients pass for drift."""
    threshold: tuple[float, ...] = (0.02, 0.10)
    """Smallest movement or error that counts, one for each signal [m, N]."""
    crossings: int = 4
    """Zero crossings of the detrended tail that make an oscillation."""
    persistence: float = 0.7
    """Smallest peak-to-peak of the tail's second half over that of its first."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.window) and self.window > 0):
            raise ValueError(f"window: wanted a positive time in seconds, got {self.window}")
        if not self.threshold or min(self.threshold) <= 0:
            raise ValueError(f"threshold: wanted positive numbers, got {self.threshold}")


@dataclass(frozen=True)
class Verdict:
    """What the detectors say of each trajectory, (batch,) each; at most one flag is set."""

    oscillation: Flags
    drift: Flags
    offset: Flags

    def shares(self) -> dict[str, float]:
        """Share of the trajectories with each flag."""
        return {name: float(flag.mean()) for name, flag in vars(self).items()}


def judge(error: ArrayLike, h: float, config: DetectorConfig | None = None) -> Verdict:
    """Classify trajectories by the tail of their errors.

    For each signal, with the tail's linear trend removed:

    - oscillation: at least `crossings` sign changes, peak-to-peak of the last half above the
      threshold and at least `persistence` of the first half's;
    - drift: no oscillation, |trend| times the window above the threshold, and a mean |e| that is
      larger in the last half than in the first;
    - offset: neither, but |mean e| above the threshold.

    A trajectory has a flag if one of its signals has; oscillation goes before drift before offset.

    Args:
        error: tracking errors, (time, batch, signals), sampled every `h` seconds.
        h: sample time [s].
        config: thresholds; the default ones if None.

    Raises:
        ValueError: if the record is shorter than the window, has another number of signals than
            there are thresholds, or is not finite.
    """
    config = config or DetectorConfig()
    e = np.asarray(error)
    e = e if e.dtype == np.float32 else e.astype(np.float64)
    if e.ndim != 3 or e.shape[-1] != len(config.threshold):
        raise ValueError(f"error: wanted (time, batch, {len(config.threshold)}), got {e.shape}")
    count = round(config.window / h)
    if count < 8 or len(e) < count:
        raise ValueError(
            f"error: wanted at least 8 samples in a window of {config.window} s and a record no "
            f"shorter than it; got {len(e)} samples every {h} s"
        )
    tail = e[-count:]
    if not np.isfinite(tail).all():
        raise ValueError("error: wanted finite values, got NaN or infinity")
    threshold = np.asarray(config.threshold)
    time = ((np.arange(count) - (count - 1) / 2) * h).astype(e.dtype)
    trend = np.tensordot(time, tail, axes=(0, 0)) / np.sum(time**2)
    residual = tail - tail.mean(axis=0) - time[:, None, None] * trend
    half = count // 2
    crossings = (np.signbit(residual[1:]) != np.signbit(residual[:-1])).sum(axis=0)
    swing_first, swing_last = np.ptp(residual[:half], axis=0), np.ptp(residual[half:], axis=0)
    oscillates = (
        (crossings >= config.crossings)
        & (swing_last > threshold)
        & (swing_last >= config.persistence * swing_first)
    )
    size = np.abs(tail)
    grows = size[half:].mean(axis=0) > size[:half].mean(axis=0)
    drifts = (np.abs(trend) * config.window > threshold) & grows
    offset = np.abs(tail.mean(axis=0)) > threshold
    any_oscillation = oscillates.any(axis=-1)
    any_drift = drifts.any(axis=-1) & ~any_oscillation
    any_offset = offset.any(axis=-1) & ~any_oscillation & ~any_drift
    return Verdict(any_oscillation, any_drift, any_offset)

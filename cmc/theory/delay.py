"""Delay against gain: where a sampled loop stops being stable, predicted exactly and measured.

The loop is one auxiliary dimension of a diagonalized plant: a lag, a policy that looks at the
error and its integral through one ratio, a hold, and a command that arrives late::

    tau e'(t) = -e(t) + gain u(t),    u(t) = u_k  for  t_k + delay <= t < t_{k+1} + delay
    u_k = -slope (e_k + I_k / integral_time),    I_k = I_{k-1} + period e_k

Neither the lag nor the hold is approximated, and the delay need not be a whole number of samples.
Three answers to "how large may the slope be?": `largest_gain` (exact, from the frequency response),
`spectral_radius` (exact, from the matrix of one sample) and `decays` (measured, by simulation).
`class_gain` is the fourth: up to it *every* policy with slopes in that range contracts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

Array = NDArray[np.float64]

_STOP = 1e9  # a diverging loop is held here, so that nothing overflows
_FREQUENCIES = 8192  # points of the frequency grid, refined by bisection


@dataclass(frozen=True)
class LagLoop:
    """A lag with sampled proportional-integral feedback.

    Raises:
        ValueError: if a value is not finite and positive.
    """

    tau: float = 0.0437
    """Time constant of the lag, s (peg touch: the x axis, paper appendix PPO)."""
    gain: float = 1.0
    """Output per command in steady state."""
    period: float = 0.01
    """Control period h, s (our choice)."""
    integral_time: float = 0.1
    """Ratio of the slope on the error to the slope on its integral, s (our choice)."""

    def __post_init__(self) -> None:
        for name in ("tau", "gain", "period", "integral_time"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be finite and positive, got {value!r}")

    def split(self, delay: ArrayLike) -> tuple[NDArray[np.int64], Array]:
        """Whole samples and the remaining fraction of a sample in `delay` (s).

        Raises:
            ValueError: if a delay is negative or not finite.
        """
        samples = np.asarray(delay, float) / self.period
        if not np.isfinite(samples).all() or (samples < 0.0).any():
            raise ValueError(f"wanted finite delays of at least 0 s, got {delay!r}")
        whole = np.floor(samples + 1e-9)  # 0.03 / 0.01 is 2.9999...
        return whole.astype(np.int64), np.maximum(samples - whole, 0.0)

    def weights(self, delay: ArrayLike) -> tuple[float, Array, Array]:
        """Exact step over one sample, e_{k+1} = a e_k + b_new u_{k-d} + b_old u_{k-d-1}.

        The older command acts during the first `fraction` of the sample, the newer one after it.
        """
        _, fraction = self.split(delay)
        a = float(np.exp(-self.period / self.tau))
        newer = np.exp(-(1.0 - fraction) * self.period / self.tau)
        return a, self.gain * (1.0 - newer), self.gain * (newer - a)


def loop_response(loop: LagLoop, delay: ArrayLike, angle: ArrayLike) -> NDArray[np.complex128]:
    """Open-loop response per unit slope, L(e^{j angle}), with angle = frequency * period.

        L(z) = (1 + h z / (T (z - 1))) (b_new z + b_old) / (z^{d+1} (z - a))

    `delay` and `angle` broadcast.
    """
    a, b_new, b_old = loop.weights(delay)
    whole, _ = loop.split(delay)
    angle = np.asarray(angle, float)
    z = np.exp(1j * angle)
    controller = 1.0 + loop.period / loop.integral_time * z / (z - 1.0)
    late = np.exp(-1j * angle * (whole + 1))
    return np.asarray(controller * (b_new * z + b_old) * late / (z - a), dtype=np.complex128)


def _angles() -> Array:
    # Logarithmic near zero, where the integrator turns the phase; linear up to half the sample rate
    low = np.geomspace(1e-5, 0.05, _FREQUENCIES // 4, endpoint=False)
    return np.concatenate([low, np.linspace(0.05, np.pi, 3 * _FREQUENCIES // 4)])


def largest_gain(loop: LagLoop, delay: ArrayLike) -> Array:
    """Smallest slope > 0 that puts a closed-loop pole on the unit circle; below it: stable.

    1 + k L(z) = 0 on |z| = 1 needs L real and negative: k = -1 / L(e^{j angle}) at the phase
    crossovers, half the sample rate (z = -1) included.

    Args:
        loop: the lag and its sampling.
        delay: delays in s, any shape.

    Returns:
        The slope at the boundary, same shape as `delay`. Without delay it is the sampled-data
        bound k (1 + h / (2 T)) gain < coth(h / (2 tau)).
    """
    delays = np.asarray(delay, float)
    angles = _angles()
    found = np.array([_first_crossing(loop, float(value), angles) for value in delays.ravel()])
    return found.reshape(delays.shape)


def _first_crossing(loop: LagLoop, delay: float, angles: Array) -> float:
    def imaginary(angle: float) -> float:
        return float(loop_response(loop, delay, angle).imag)

    values = loop_response(loop, delay, angles[:-1]).imag
    where = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0.0)
    crossings = [brentq(imaginary, angles[i], angles[i + 1], xtol=1e-14) for i in where]
    real = loop_response(loop, delay, np.array([*crossings, np.pi])).real
    return float(min((-1.0 / value for value in real if value < 0.0), default=np.inf))


def class_gain(loop: LagLoop, delay: ArrayLike) -> Array:
    """Largest k such that *every* policy with slopes in (0, k) contracts, delay included.

    The difference of two trajectories obeys the same loop with a slope that changes with time in
    that interval, so the sampled circle criterion applies to it: 1 + k Re L(e^{j angle}) > 0 for
    all angles (Tsypkin), once the slopes keep some distance from both ends. Sufficient only; it
    never exceeds `largest_gain`, and equals it where there is no delay.
    """
    delays = np.asarray(delay, float)
    response = loop_response(loop, delays[..., None], _angles())
    lowest = response.real.min(axis=-1)
    return np.where(lowest < 0.0, -1.0 / np.minimum(lowest, -1e-300), np.inf)


def sample_matrix(loop: LagLoop, delay: float, slope: float) -> Array:
    """Matrix of one sample for the state (e_k, I_{k-1}, u_{k-1}, ..., u_{k-d-1})."""
    a, b_new, b_old = loop.weights(delay)
    d = int(loop.split(delay)[0])
    matrix = np.zeros((d + 3, d + 3))
    # u_k = -slope ((1 + h/T) e_k + I_{k-1} / T), because I_k holds the new error already
    command = np.zeros(d + 3)
    command[:2] = -slope * np.array(
        [1.0 + loop.period / loop.integral_time, 1 / loop.integral_time]
    )
    commands = np.vstack([command, np.eye(d + 3)[2:]])  # u_k, u_{k-1}, ..., u_{k-d-1}
    matrix[0, 0] = a
    matrix[0] += float(b_new) * commands[d] + float(b_old) * commands[d + 1]
    matrix[1, :2] = loop.period, 1.0
    matrix[2:] = commands[: d + 1]
    return matrix


def spectral_radius(loop: LagLoop, delay: float, slope: float) -> float:
    """Largest modulus of a closed-loop pole per sample; below 1 means stable."""
    return float(np.abs(np.linalg.eigvals(sample_matrix(loop, delay, slope))).max())


def simulate(
    loop: LagLoop,
    delay: ArrayLike,
    slope: ArrayLike,
    steps: int,
    *,
    limit: float = np.inf,
    noise: ArrayLike | None = None,
    start: float = 1.0,
) -> Iterator[Array]:
    """Run many delayed loops at once, yielding the errors e_k.

    The lag is integrated exactly from event to event (sample, arrival of the late command).

    Args:
        loop: the lag and its sampling.
        delay: s, broadcast against `slope`.
        slope: slope of the policy at the origin.
        steps: number of samples.
        limit: the command is limit * tanh(raw / limit); infinite means linear.
        noise: added to what the policy sees of the error, (steps, ...).
        start: e_0; no integral and no command before it.

    Raises:
        ValueError: if `limit` or `steps` is not positive.
    """
    if not limit > 0.0 or steps < 1:
        raise ValueError(f"wanted limit > 0 and steps >= 1, got {limit!r} and {steps!r}")
    delays, slopes = np.broadcast_arrays(np.asarray(delay, float), np.asarray(slope, float))
    whole, fraction = loop.split(delays)
    keep_old = np.exp(-fraction * loop.period / loop.tau)
    keep_new = np.exp(-(1.0 - fraction) * loop.period / loop.tau)
    length = int(whole.max()) + 2
    sent = np.zeros((length, *delays.shape))  # ring of past commands
    error, integral = np.full(delays.shape, float(start)), np.zeros(delays.shape)
    for k in range(steps):
        yield error
        seen = error if noise is None else error + np.asarray(noise)[k]
        integral = integral + loop.period * seen
        raw = -slopes * (seen + integral / loop.integral_time)
        sent[k % length] = raw if np.isinf(limit) else limit * np.tanh(raw / limit)
        for keep, age in ((keep_old, whole + 1), (keep_new, whole)):
            acting = np.take_along_axis(sent, ((k - age) % length)[None], axis=0)[0]
            error = loop.gain * acting + (error - loop.gain * acting) * keep
        error = np.clip(error, -_STOP, _STOP)


def decays(
    loop: LagLoop,
    delay: ArrayLike,
    slope: ArrayLike,
    *,
    steps: int = 2000,
    limit: float = np.inf,
) -> NDArray[np.bool_]:
    """Measured stability: whether the error's peak still shrinks late in a simulation.

    Compares the peaks over the third and the fourth quarter of `steps` samples.

    Returns:
        Booleans, shape of `delay` broadcast against `slope`.
    """
    shape = np.broadcast_shapes(np.shape(delay), np.shape(slope))
    third, fourth = np.zeros(shape), np.zeros(shape)
    for k, error in enumerate(simulate(loop, delay, slope, steps, limit=limit)):
        if 4 * k >= 3 * steps:
            np.maximum(fourth, np.abs(error), out=fourth)
        elif 2 * k >= steps:
            np.maximum(third, np.abs(error), out=third)
    # A sustained oscillation has equal peaks up to where the samples happen to fall
    return (fourth < 0.99 * third) | (fourth < 1e-9)

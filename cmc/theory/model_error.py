r"""Model error: the paper's sufficient condition, and a test that is useful.

The paper (appendix "Robustness") keeps T_y, T_a of the model and asks of the real Jacobians

    F1_real^T + F1_real  <=  F1_hat^T + F1_hat  <  -(beta + max(nu+, 0)) I.

The left half never holds by luck. With the errors D_A = T_y (f_y - f_y_hat) T_y^{-1} and
D_B = T_y (f_u - f_u_hat) T_a and P = dpi/ds1, F1_real - F1_hat = [I; P] [D_A, D_B], and the
symmetric part of such a product is negative semidefinite if and only if D_B = D_A P^T and
D_A + D_A^T <= 0: n^2 equations for the error to obey. The right half fails for most stable loops.

Contraction does not need the identity metric: take a metric in which the *model's* loop contracts
and ask whether the *real* loop still contracts in it. The Jacobian of the real loop in the model's
coordinates is `loop_jacobian(space.Lambda, space.R, p, q)` of `cmc.theory.certificates` with
`space = AuxiliarySpace.from_transforms(T_y_hat, T_a_hat, f_y, f_u)`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.theory.contraction import contraction_rate, metric_factor
from cmc.theory.margins import symmetric_bound
from cmc.theory.spectrum import checked_square

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PaperTest:
    """The two halves of the paper's condition, over a batch."""

    order: NDArray[np.bool_]
    """F1_real^T + F1_real <= F1_hat^T + F1_hat."""
    premise: NDArray[np.bool_]
    """F1_hat^T + F1_hat < -max(nu+, 0) I: some beta > 0 exists."""

    @property
    def holds(self) -> NDArray[np.bool_]:
        """Both."""
        return self.order & self.premise


def model_error_paper_test(
    F1_hat: ArrayLike, F1_real: ArrayLike, *, nu_plus: ArrayLike = 0.0
) -> PaperTest:
    """Test the paper's inequality between model and reality, literally.

    Args:
        F1_hat: F1 of the model, (..., 2n, 2n).
        F1_real: F1 of the real plant under the model's T_y, T_a, (..., 2n, 2n).
        nu_plus: upper bound of the eigenvalues of F2^T + F2, 1/s.
    """
    hat, real = checked_square(F1_hat, "F1_hat"), checked_square(F1_real, "F1_real")
    scale = 1e-12 * (1.0 + np.abs(hat).max(axis=(-2, -1)))  # equality is allowed
    order = symmetric_bound(real - hat) <= scale
    # symmetric_bound halves F1^T + F1, the paper's inequality does not
    return PaperTest(order, 2.0 * symmetric_bound(hat) < -np.maximum(nu_plus, 0.0))


def nominal_metric(jacobian: ArrayLike, *, share: float = 0.5) -> Array:
    """Metric in which a linear loop contracts at a chosen share of its own decay rate.

    Solves (J + b I)^T M + M (J + b I) = -I with b = share * |max Re lambda|. A share near 1 makes a
    metric that fits this loop alone; a share near 0 one that is blind to the slow modes.

    Args:
        jacobian: J, (..., n, n), Hurwitz; units of the rows as they come.
        share: in [0, 1).

    Returns:
        M, (..., n, n).

    Raises:
        ValueError: if a loop is not stable or `share` is outside of [0, 1).
    """
    J = checked_square(jacobian, "jacobian")
    if not 0.0 <= share < 1.0:
        raise ValueError(f"wanted a share in [0, 1), got {share!r}")
    abscissa = np.linalg.eigvals(J).real.max(axis=-1)
    if not (abscissa < 0.0).all():
        raise ValueError(
            f"wanted stable loops, got a largest real part of {abscissa.max():.3g} 1/s"
        )
    n = J.shape[-1]
    eye = np.eye(n)
    shifted = np.swapaxes(J - share * abscissa[..., None, None] * eye, -1, -2)
    # (J^T kron I + I kron J^T) vec(M) = -vec(I), for the whole batch at once
    kronecker = np.einsum("...ij,kl->...ikjl", shifted, eye)
    kronecker = kronecker + np.einsum("ij,...kl->...ikjl", eye, shifted)
    flat = kronecker.reshape(*J.shape[:-2], n * n, n * n)
    right = np.broadcast_to(-eye.reshape(-1, 1), (*J.shape[:-2], n * n, 1))
    metric = np.linalg.solve(flat, right).reshape(J.shape)
    return 0.5 * (metric + np.swapaxes(metric, -1, -2))


@dataclass(frozen=True)
class MetricTest:
    """How fast model and reality contract in one metric, over a batch."""

    metric: Array
    """M, (n, n) or (..., n, n)."""
    nominal_rate: Array
    """Rate of the model's loop in it, 1/s."""
    real_rate: Array
    """Rate of the real loop in it, 1/s: the margin; negative where the test fails."""

    @property
    def holds(self) -> NDArray[np.bool_]:
        """Whether the real loop contracts in the metric."""
        return self.real_rate > 0.0


def model_error_metric_test(
    nominal: ArrayLike,
    real: ArrayLike,
    *,
    metric: ArrayLike | None = None,
    share: float = 0.5,
) -> MetricTest:
    """Check the real loop in a metric of the model's loop.

    Args:
        nominal: Jacobian of the model's loop, (..., n, n).
        real: Jacobian of the real loop, same coordinates, (..., n, n).
        metric: a metric to use, for example a certificate's; `nominal_metric` by default.
        share: passed to `nominal_metric`.
    """
    model, plant = checked_square(nominal, "nominal"), checked_square(real, "real")
    M = nominal_metric(model, share=share) if metric is None else np.asarray(metric, float)
    return MetricTest(M, contraction_rate(model, M), contraction_rate(plant, M))


def tolerated_error(nominal: ArrayLike, metric: ArrayLike) -> Array:
    """Size of model error, in 1/s, that a loop survives whatever its direction.

    The real loop contracts if ||Theta (J_real - J_hat) Theta^{-1}||_2 is below the model's rate in
    the metric, because the rate changes by at most that norm.
    """
    return np.maximum(contraction_rate(nominal, metric), 0.0)


def error_size(nominal: ArrayLike, real: ArrayLike, metric: ArrayLike) -> Array:
    """||Theta (J_real - J_hat) Theta^{-1}||_2 in 1/s, to compare with `tolerated_error`."""
    theta = metric_factor(metric)
    error = np.asarray(real, float) - np.asarray(nominal, float)
    return np.linalg.norm(theta @ error @ np.linalg.inv(theta), 2, axis=(-2, -1))

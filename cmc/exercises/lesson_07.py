"""Exercise of lesson 07: the radius of the error ball in a metric."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cmc.exercises import check, expect, expect_close
from cmc.theory.contraction import contraction_rate
from cmc.theory.robustness import ErrorBall


@check("07-ball-radius")
def ball_radius(answer: Callable[[np.ndarray, np.ndarray, np.ndarray, float], float]) -> None:
    """Judge `ball_radius(J, B, M, size)`: radius, in the metric M, of the ball of x' = J x + B d.

    It is the largest push ||Theta B|| size over the rate of J in the metric, M = Theta^T Theta.
    """
    J = np.array([[-2.0, 1.0], [0.0, -1.0]])
    B = np.array([[0.5], [1.0]])
    cases = {
        "the identity metric": (J, B, np.eye(2), 1.0),
        "a disturbance twice as large": (J, B, np.eye(2), 2.0),
        "a metric that is not diagonal": (J, B, np.array([[2.0, 0.3], [0.3, 1.0]]), 1.0),
        "three states and two disturbances": (
            np.array([[-1.0, 0.2, 0.0], [0.0, -2.0, 0.5], [0.1, 0.0, -1.5]]),
            np.array([[1.0, 0.0], [0.0, 0.0], [0.3, 2.0]]),
            np.diag([1.0, 4.0, 9.0]),
            0.7,
        ),
    }
    for name, (jacobian, channel, metric, size) in cases.items():
        rate = float(contraction_rate(jacobian, metric))
        wanted = ErrorBall(metric, rate, channel).radius(size)
        found = answer(jacobian.copy(), channel.copy(), metric.copy(), size)
        if found is not None and np.isclose(found, 2 * wanted):
            expect(False, "the radius is twice too large: halve J^T M + M J, its rate is 2 beta")
        expect_close(found, wanted, f"the radius for {name}", rtol=1e-6)

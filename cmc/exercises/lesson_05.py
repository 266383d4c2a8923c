"""Exercise of lesson 05: the slopes of a network as a product of matrices."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cmc.exercises import check, expect, expect_close

Answer = Callable[[Sequence[np.ndarray], Sequence[np.ndarray], np.ndarray], np.ndarray]


def _network(weights: Sequence[np.ndarray], biases: Sequence[np.ndarray], s: np.ndarray) -> float:
    x = s
    for W, b in zip(weights[:-1], biases[:-1], strict=True):
        x = np.tanh(W @ x + b)
    return float((weights[-1] @ x + biases[-1])[0])


@check("05-slopes")
def slopes(answer: Answer) -> None:
    """Judge `my_slopes(weights, biases, s)`: d pi / d s of a tanh network, by `product`.

    Weights are (out, in); the last layer is linear and has one output; s is (2,).
    """
    rng = np.random.default_rng(0)
    for hidden in ((4,), (5, 3), (4, 4, 4)):
        sizes = (2, *hidden, 1)
        weights = [rng.uniform(0, 1.5, (b, a)) for a, b in zip(sizes[:-1], sizes[1:], strict=True)]
        biases = [rng.normal(size=len(W)) for W in weights]
        s = rng.normal(size=2)
        step = 1e-6 * np.eye(2)
        wanted = [
            (_network(weights, biases, s + d) - _network(weights, biases, s - d)) / 2e-6
            for d in step
        ]
        found = answer([W.copy() for W in weights], [b.copy() for b in biases], s.copy())
        expect(np.ndim(found) > 0, "two slopes are wanted, one per input")
        name = f"the slopes of a network with {len(hidden)} hidden layer(s)"
        expect_close(np.ravel(found), wanted, name, rtol=1e-6, atol=1e-8)
        expect((np.ravel(found) > 0).all(), "positive weights should give positive slopes")

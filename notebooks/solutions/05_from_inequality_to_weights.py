"""Solution of the exercise of lesson 05."""

import numpy as np


def my_slopes(weights, biases, s):
    """Slopes of a tanh network: W_l M_{l-1} W_{l-1} ... M_1 W_1."""
    x, jacobian = s, np.eye(len(s))
    for W, b in zip(weights[:-1], biases[:-1], strict=True):
        x = np.tanh(W @ x + b)
        jacobian = (1 - x**2)[:, None] * (W @ jacobian)
    return (weights[-1] @ jacobian)[0]

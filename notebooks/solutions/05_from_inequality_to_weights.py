"""Solutions of the exercises of lesson 05."""

from types import SimpleNamespace

import numpy as np

from cmc.plants import LinearPlant
from cmc.theory.certify import certify


def my_slopes(weights, biases, s):
    """Slopes of a tanh network: W_l D_{l-1} W_{l-1} ... D_1 W_1."""
    x, product = s, np.eye(len(s))
    for W, b in zip(weights[:-1], biases, strict=True):
        x = np.tanh(W @ x + b)
        product = (1 - x**2)[:, None] * (W @ product)
    return (weights[-1] @ product)[0]


def my_stiffness(z, w):
    """Stiff on the way in, where it speeds the swing up; soft on the way out."""
    return 1.5 if z * w < 0 else 0.5


def my_step(p, q, Lambda, R, h):
    """I_k is known at sample k, and z_k joins it afterwards: I_{k+1} = I_k + h z_k."""
    phi, G = np.exp(Lambda * h), R * np.expm1(Lambda * h) / Lambda
    return np.array([[phi - G * p, -G * q], [h, 1.0]])


def my_plant():
    """Two coupled modes; h by bisection on the certificate."""
    f_y, f_u = [[-1.0, 0.5], [0.2, -3.0]], [[1.0, 0.3], [0.4, 2.0]]
    floor, ceiling = np.array([[0.5, 0.3]] * 2), np.array([[2.0, 1.0]] * 2)
    interval = SimpleNamespace(slope_bounds=lambda: (floor, ceiling))
    low, high = 0.2, 2.0
    for _ in range(7):
        h = (low + high) / 2
        low, high = (h, high) if certify(interval, LinearPlant(f_y, f_u), h=h) else (low, h)
    return f_y, f_u, floor, ceiling, low

"""Solution of the exercise of lesson 06."""

from math import sqrt


def my_composite(K_p, K_d, lambda_d):
    """K1, K2, A, B of the large root, in the paper's scale B = lambda_d."""
    discriminant = K_d**2 - 4 * K_p * lambda_d
    if discriminant < 0:
        raise ValueError("K_d^2 < 4 K_p lambda_d: no composite variable exists")
    K2 = 2 * K_p / (K_d - sqrt(discriminant))
    return K_p / lambda_d, K2, lambda_d / K2, lambda_d

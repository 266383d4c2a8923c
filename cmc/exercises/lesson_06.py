"""Exercise of lesson 06: the composite gains of the large root."""

from __future__ import annotations

from collections.abc import Callable

from cmc.exercises import check, expect, expect_close


@check("06-composite")
def composite(answer: Callable[[float, float, float], tuple[float, float, float, float]]) -> None:
    """Judge `my_composite(K_p, K_d, lambda_d)`: K1, K2, A, B with the fast pole latent.

    The coefficients must match the error equation; the library's own formula is not consulted.
    """
    for K_p, K_d, lambda_d in ((40.0, 20.0, 1.0), (3.0, 8.0, 2.0), (20.0, 30.0, 0.5)):
        found = answer(K_p, K_d, lambda_d)
        expect(found is not None and len(tuple(found)) == 4, "return four numbers K1, K2, A, B")
        K1, K2, A, B = (float(v) for v in found)
        expect(min(K1, K2, A, B) > 0, "K1, K2, A and B are all positive")
        expect_close(A * K2, lambda_d, "A K2 (the factor of e'')")
        expect_close(A * K1 + B * K2, K_d, "A K1 + B K2 (the factor of e')")
        expect_close(B * K1, K_p, "B K1 (the factor of e)")
        expect_close(B, lambda_d, "B, in the paper's scale,")
        expect(B / A > K1 / K2, "this is the small root: the fast pole should be latent, B / A")
    try:
        answer(40.0, 12.0, 1.0)
    except ValueError:
        return
    expect(False, "K_p = 40, K_d = 12 has no real K2; raise ValueError")

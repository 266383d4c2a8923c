"""Exercises of lesson 05: slopes, a pumped swing, another quadrature, a plant of one's own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace

import numpy as np
from scipy.linalg import expm

from cmc.exercises import check, expect, expect_close
from cmc.plants import LinearPlant
from cmc.theory.certify import certify

Array = np.ndarray
Slopes = Callable[[Sequence[Array], Sequence[Array], Array], Array]


def _network(weights: Sequence[Array], biases: Sequence[Array], s: Array) -> float:
    x = s
    for W, b in zip(weights[:-1], biases, strict=True):
        x = np.tanh(W @ x + b)
    return float((weights[-1] @ x)[0])


@check("05-slopes")
def slopes(answer: Slopes) -> None:
    """Judge `my_slopes(weights, biases, s)`: d pi / d s of a tanh network, by `product`.

    Weights are (out, in); the last layer is linear, has one output and no bias; s is (2,).
    """
    rng = np.random.default_rng(0)
    for hidden in ((4,), (5, 3), (4, 4, 4)):
        sizes = (2, *hidden, 1)
        weights = [rng.uniform(0, 1.5, (b, a)) for a, b in zip(sizes[:-1], sizes[1:], strict=True)]
        biases = [rng.normal(size=len(W)) for W in weights[:-1]]
        s = rng.normal(size=2)
        wanted, unbiased = (
            [
                (_network(weights, b, s + d) - _network(weights, b, s - d)) / 2e-6
                for d in 1e-6 * np.eye(2)
            ]
            for b in (biases, [0 * b for b in biases])
        )
        found = answer([W.copy() for W in weights], [b.copy() for b in biases], s.copy())
        expect(np.size(found) == 2, "two slopes are wanted, one for each input")
        name = f"the slopes of a network with {len(hidden)} hidden layer(s)"
        straight = np.linalg.multi_dot(weights[::-1])[0]
        hints = (
            (unbiased, "the biases are missing inside tanh"),
            (straight, "this is W_l ... W_1 alone; put D_j = diag(1 - tanh^2) between them"),
        )
        for slip, hint in hints:
            expect(not np.allclose(np.ravel(found), slip, rtol=1e-4), hint)
        expect_close(np.ravel(found), wanted, name, rtol=1e-6, atol=1e-8)


@check("05-pump")
def pump(answer: Callable[[float, float], float]) -> None:
    """Judge `my_stiffness(z, w)`: makes z' = -0.28 z - k w, w' = z grow with k in [0.5, 1.5]."""
    z, w, dt, size = 0.0, 1.0, 0.005, []
    for _ in range(12_000):
        k = float(answer(z, w))
        expect(0.5 <= k <= 1.5, f"k should stay in [0.5, 1.5], yours was {k:.3g}")
        z += dt * (-0.28 * z - k * w)
        w += dt * z
        size.append(np.hypot(z, w))
    grown = float(np.log(max(size[-2000:]) / max(size[2000:4000])))
    decay = "decays as fast as a constant k does" if grown < -4 else "still decays"
    hint = "w is pulled back hardest if k is large on the way in (z w < 0) and small on the way out"
    expect(grown > 0, f"the swing {decay}: its size falls by {np.exp(grown):.2g} in 40 s; {hint}")


@check("05-quadrature")
def quadrature(answer: Callable[[float, float, float, float, float], Array]) -> None:
    """Judge `my_step(p, q, Lambda, R, h)`: the held step in (z_k, I_k), I_{k+1} = I_k + h z_k."""
    for p, q, Lambda, R, h in ((0.5, 0.2, -1.0, 2.0, 0.3), (3.0, 1.0, 0.4, 0.7, 0.1)):
        both = expm(h * np.array([[Lambda, R], [0.0, 0.0]]))
        phi, G = both[0, 0], both[0, 1]
        found = np.asarray(answer(p, q, Lambda, R, h), dtype=float)
        expect(found.shape == (2, 2), f"wanted a 2 x 2 matrix, got shape {found.shape}")
        with_new = [[phi - G * (p + h * q), -G * q], [h, 1.0]]
        expect(
            not np.allclose(found, with_new),
            "this is the matrix of the text: the new error must not be in the command's sum",
        )
        expect_close(found, [[phi - G * p, -G * q], [h, 1.0]], "the step in (z_k, I_k)")


@check("05-own-plant")
def own_plant(answer: Callable[[], tuple[Array, Array, Array, Array, float]]) -> None:
    """Judge `my_plant()`: f_y, f_u, floor, ceiling and the sample time where `certify` gives up."""
    found = answer()
    expect(len(found) == 5, "return f_y, f_u, floor, ceiling, h")
    f_y, f_u, floor, ceiling = (np.asarray(v, dtype=float) for v in found[:4])
    h = float(found[4])
    expect(f_y.shape == f_u.shape == (2, 2), "f_y and f_u should be 2 x 2")
    for name, M in (("f_y", f_y), ("f_u", f_u)):
        expect(np.count_nonzero(M - np.diag(np.diag(M))), f"{name} is diagonal: nothing is coupled")
    expect(floor.shape == ceiling.shape == (2, 2), "floor and ceiling should be 2 x 2")
    expect((ceiling > floor).all(), "every ceiling should lie above its floor")
    plant = LinearPlant(f_y, f_u)
    interval = SimpleNamespace(slope_bounds=lambda: (floor, ceiling))
    for share in (None, 0.9, 1.1):
        verdict = certify(interval, plant, h=None if share is None else share * h)
        when = "without sampling" if share is None else f"at {share:g} h = {share * h:.3g} s"
        wanted = share != 1.1
        said = f"no ({verdict.reason})" if not verdict else f"yes, {verdict.rate:.3g} 1/s"
        expect(bool(verdict) == wanted, f"{when} certify says {said}")

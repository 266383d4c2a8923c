"""Lesson 04: the explicit solution, theorem 2, tracking, and what breaks."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from cmc import plants
from cmc.fast import budget
from cmc.lessons.linear_loop import largest_real_part, loop_matrix, signed_slopes
from cmc.theory.as_printed import literal_transforms
from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.combinations import schur
from cmc.theory.margins import module_eigenvalues, slope_floor
from cmc.theory.spectrum import Array, ComplexEigenvalueError, DefectiveMatrixError
from cmc.theory.tracking import Tracker, track

F_U = np.array([[1.0, 2.0], [1.5, 1.0]])
"""f_u of the coupled lags."""
REPAIRS = {
    "as printed": {},
    "$T_y$ inverted": {"invert": True},
    "transposed": {"transpose": True},
    "both": {"invert": True, "transpose": True},
}
"""Repairs of the theorem's text, by the name they have in the figure."""


def printed_formula() -> dict[str, dict[str, Array]]:
    """Lambda and R of the coupled lags by the theorem's text, for each repair of it."""
    plant = plants.get("coupled_lags")
    f_y, f_u = plant.f_y([0, 0], [0, 0]), plant.f_u([0, 0], [0, 0])
    spaces = {name: literal_transforms(f_y, f_u, **repair) for name, repair in REPAIRS.items()}
    return {
        "Lambda": {name: _clean(space.Lambda) for name, space in spaces.items()},
        "R": {name: _clean(space.R) for name, space in spaces.items()},
    }


def _clean(matrix: Array) -> Array:
    """Set rounding residues to zero, for display."""
    return np.where(np.abs(matrix) < 1e-12, 0.0, matrix)


def decay_against_damping() -> tuple[Array, Array]:
    """Decay rate of one module with determinant 1 against its trace (negated), both in 1/s."""
    damping = np.logspace(-1.0, 4.0, 300)
    eye = np.ones((len(damping), 1, 1))
    space = AuxiliarySpace(eye, eye, 0.0 * eye - 0.05, eye)
    slopes = np.stack([0.05 - damping, -np.ones_like(damping)], axis=-1)[:, None, :]
    return damping, -module_eigenvalues(space, slopes)[:, 0, 0].real


def oscillating_share(number: int | None = None, seed: int = 0) -> float:
    """Share of random modules of the right signs (all magnitudes 0.1 to 3) that oscillate."""
    number = number or budget(100_000, 20_000)
    Lambda, R, p, q = np.random.default_rng(seed).uniform(0.1, 3.0, (4, number))
    eye = np.ones((number, 1, 1))
    space = AuxiliarySpace(eye, eye, -Lambda[:, None, None], R[:, None, None])
    roots = module_eigenvalues(space, -np.stack([p, q], axis=-1)[:, None])
    return float(np.mean(roots[:, 0, 0].imag != 0.0))


def floor_scan(growth: float = 0.8) -> tuple[Array, Array, float]:
    """Largest real part of the loop around the unstable mode against the slope in z, and its floor.

    The slope applies to both modules; the integral slope is 0.1.
    """
    plant = plants.get("unstable_mode", growth=growth)
    space = decompose(plant.f_y([0, 0], [0, 0]), plant.f_u([0, 0], [0, 0]))
    floor = float(slope_floor(space).max())
    sizes = np.linspace(0.0, 3.0 * floor, 121)
    many = AuxiliarySpace(*(np.tile(m, (121, 1, 1)) for m in vars(space).values()))
    slopes = signed_slopes(many, sizes[:, None], 0.1)
    return sizes, largest_real_part(loop_matrix(many, slopes)), floor


def turning_plant(turns: float, crossing: float, steps: int = 400) -> tuple[Array, Array]:
    """Times (s) and f_y along a path: eigenvectors make `turns` half turns, eigenvalues cross."""
    t = np.linspace(0.0, 4.0, steps)
    angle = np.pi * turns * t / 4.0
    c, s = np.cos(angle), np.sin(angle)
    V = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2) @ np.array([[1, 0.3], [0, 1.0]])
    gap = 1.0 - crossing * np.sin(np.pi * t / 4.0)
    eigenvalues = np.stack([-2.0 + gap, -2.0 - gap], axis=-1)
    return t, V @ (eigenvalues[..., None] * np.linalg.inv(V))


def tracking(turns: float, crossing: float) -> dict[str, Any]:
    """Follow z = T_y y of a constant y along the turning path, sorted anew and tracked."""
    t, f_y = turning_plant(turns, crossing)
    y = np.array([1.0, 0.4])
    anew, followed = decompose(f_y, np.eye(2)), track(f_y, np.eye(2))
    z_anew, z_followed = anew.to_z(y), followed.to_z(y)
    jumps = int((np.abs(np.diff(z_anew, axis=0)).max(axis=-1) > 0.3).sum())
    return {
        "t": t,
        "anew": z_anew,
        "followed": z_followed,
        "eigenvalues": followed.eigenvalues,
        **{f"anew_{i + 1}": z_anew[:, i] for i in (0, 1)},
        **{f"followed_{i + 1}": z_followed[:, i] for i in (0, 1)},
        **{f"eigenvalue_{i + 1}": followed.eigenvalues[:, i] for i in (0, 1)},
        "jumps": jumps,
        "text": f"sorted anew: {jumps} jumps; tracked: none",
    }


def lapack_jumps(n: int = 6, number: int | None = None, seed: int = 0) -> tuple[float, float]:
    """Shares of small steps on which numpy's eigenvectors swap order and, otherwise, flip sign."""
    rng, number = np.random.default_rng(seed), number or budget(20_000, 4_000)
    V = np.eye(n) + 0.3 * rng.normal(size=(number, n, n))
    f_y = V @ (-rng.uniform(0.5, 9.0, (number, n, 1)) * np.linalg.inv(V))
    first, before = np.linalg.eig(f_y)
    second, after = np.linalg.eig(f_y + 1e-3 * rng.normal(size=f_y.shape))
    real = np.isreal(first).all(axis=-1) & np.isreal(second).all(axis=-1)
    share = np.linalg.solve(before[real].real, after[real].real)
    largest = np.abs(share).argmax(axis=-1)
    swapped = (largest != np.arange(n)).any(axis=-1)
    flipped = (np.diagonal(share, axis1=-2, axis2=-1) < 0.0).any(axis=-1) & ~swapped
    return float(swapped.mean()), float(flipped.mean())


def matrices(a: float, b: float, c: float, d: float) -> dict[str, Any]:
    """Decompose [[a, b], [c, d]] with f_u of the coupled lags; say why where it cannot be done."""
    f_y, missing = np.array([[a, b], [c, d]]), np.full((2, 2), np.nan)
    eig = np.linalg.eigvals(f_y).astype(complex)
    try:
        space = decompose(f_y, F_U)
    except (ComplexEigenvalueError, DefectiveMatrixError) as error:
        words = str(error).split(":")[0]
        arrows = np.full((2, 2, 2), np.nan)
        return {"eig": eig, "axes": arrows, "Lambda": missing, "R": missing, "text": words}
    axes = np.stack([-space.V.T, space.V.T])
    text = f"condition of T_y: {np.linalg.cond(space.T_y):.3g}"
    return {"eig": eig, "axes": axes, "Lambda": space.Lambda, "R": space.R, "text": text}


def near_defective() -> dict[str, Array]:
    """Condition of T_y for f_y = [[-1, 1], [0, -1 - gap]], by eigenvectors and by Schur."""
    gaps = np.logspace(-6.0, 1.0, 60)
    f_y = np.zeros((60, 2, 2))
    f_y[:, 0, 0], f_y[:, 0, 1], f_y[:, 1, 1] = -1.0, 1.0, -1.0 - gaps
    rotations = np.array([schur(m, F_U).T_y for m in f_y])
    return {
        "gap": gaps,
        "eigenvectors": np.linalg.cond(decompose(f_y, F_U).T_y),
        "schur": np.linalg.cond(rotations),
    }


def moving_action(turn: float = 3.0, size: float = 5.0) -> tuple[Array, Array]:
    """Largest real part of the Jacobian of y' = -y + Rot(turn y_1) (0, -size) against y_1.

    The action a = (0, -size) is held, so the frozen analysis sees -1 everywhere. The Jacobian is by
    central differences.
    """

    def f(y: Array) -> Array:
        angle = turn * y[..., 0]
        return -y + size * np.stack([np.sin(angle), -np.cos(angle)], axis=-1)

    y = np.stack([np.linspace(-2.0, 2.0, 241), np.zeros(241)], axis=-1)
    J = np.stack([(f(y + d) - f(y - d)) / 2e-6 for d in 1e-6 * np.eye(2)], axis=-1)
    return y[:, 0], largest_real_part(J)


def control_rates(sizes: tuple[int, ...] = (2, 3, 4, 6)) -> dict[int, float]:
    """Decompositions per CPU second that a `Tracker` does on this machine, for each n."""
    rng, rates = np.random.default_rng(0), {}
    for n in sizes:
        V = np.eye(n) + 0.2 * rng.normal(size=(n, n))
        f_y = V @ np.diag(-np.arange(1.0, n + 1)) @ np.linalg.inv(V)
        tracker, count = Tracker(), budget(2000, 300)
        start = time.process_time()
        for _ in range(count):
            tracker.update(f_y, np.eye(n))
        rates[n] = count / max(time.process_time() - start, 1e-9)
    return rates

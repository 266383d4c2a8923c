"""The explicit solution word for word as the paper's theorem prints it, kept to show that it fails.

Use `cmc.theory.auxiliary.decompose`. Two words are wrong in the theorem's text: the eigenvector
matrix is `T_y^-1`, not `T_y`, and a transpose is missing under the QR decomposition (the paper's
own proof has it).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.spectrum import checked_pair, real_eigenbasis


def literal_transforms(
    f_y: ArrayLike, f_u: ArrayLike, *, invert: bool = False, transpose: bool = False
) -> AuxiliarySpace:
    """Return the transforms of the theorem's text, whose Lambda and R miss their structure.

    `T_y = V` and `T_a = (P Q^T)^-1` with `Q R_qr = P T_y f_u`, P the exchange matrix.

    Args:
        f_y: Jacobian of the plant in `y` [1/s], (..., n, n).
        f_u: Jacobian of the plant in `u`, (..., n, n).
        invert: Repair the first error: `T_y = V^-1`.
        transpose: Repair the second: `Q R_qr = (T_y f_u)^T P`. Both repaired give `decompose`, but
            for the free signs of the QR factors.

    Raises:
        ComplexEigenvalueError: If `f_y` has a complex pair.
        DefectiveMatrixError: If `f_y` lacks eigenvectors.
        SingularInputError: If `f_u` is singular.
        TypeError: If the entries are not real numbers.
        ValueError: If shapes do not fit or an entry is not finite.
    """
    f_y, f_u = checked_pair(f_y, f_u)
    V = real_eigenbasis(f_y)[1]
    T_y = np.linalg.inv(V) if invert else V
    P = np.eye(f_y.shape[-1])[::-1]
    W = T_y @ f_u
    Q = np.linalg.qr(np.swapaxes(W, -1, -2) @ P if transpose else P @ W)[0]
    T_a = np.linalg.inv(P @ np.swapaxes(Q, -1, -2))
    return AuxiliarySpace.from_transforms(T_y, T_a, f_y, f_u)

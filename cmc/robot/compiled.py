"""MuJoCo from compiled code: its C functions by name, its arrays by address.

Functions called by name can be kept in numba's cache, pointers cannot. Nothing checks an address:
whoever passes one keeps the object behind it alive and states its size truly.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numba
from llvmlite import binding
from numba import types
from numba.extending import intrinsic

_LIBRARIES = ("libmujoco.so*", "libmujoco*.dylib", "mujoco.dll")
_FOLDER = Path(mujoco.__file__).parent


def compiled(function: Callable[..., Any]) -> Any:
    """Compile on the first call, without the interpreter's lock; keep it on disk if possible."""
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # a read-only installation without a home to keep it in
        return numba.njit(nogil=True, error_model="numpy")(function)


def _load() -> None:
    found = [path for pattern in _LIBRARIES for path in sorted(_FOLDER.glob(pattern))]
    if not found:
        raise ImportError(f"wanted MuJoCo's library, {' or '.join(_LIBRARIES)}, in {_FOLDER}")
    binding.load_library_permanently(str(found[0]))


def _c(name: str, *arguments: Any) -> Any:
    return types.ExternalFunction(name, types.void(*arguments))


_load()
_p, _n, _i = types.intp, types.float64, types.int32  # addresses, numbers, integers
step = _c("mj_step", _p, _p)
step1 = _c("mj_step1", _p, _p)
step2 = _c("mj_step2", _p, _p)
jacSite = _c("mj_jacSite", _p, _p, _p, _p, _i)
jacDot = _c("mj_jacDot", _p, _p, _p, _p, _p, _i)
mulM = _c("mj_mulM", _p, _p, _p, _p)
solveM = _c("mj_solveM", _p, _p, _p, _p, _i)
cholFactor = _c("mju_cholFactor", _p, _i, _n)
cholSolve = _c("mju_cholSolve", _p, _p, _p, _i)
mat2Quat = _c("mju_mat2Quat", _p, _p)
subQuat = _c("mju_subQuat", _p, _p, _p)
rotVecQuat = _c("mju_rotVecQuat", _p, _p, _p)
mulQuat = _c("mju_mulQuat", _p, _p, _p)
quat2Vel = _c("mju_quat2Vel", _p, _p, _n)


@intrinsic
def _pointer(context: Any, address: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = context.get_value_type(signature.return_type)
        return builder.inttoptr(arguments[0], kind)

    return types.CPointer(types.float64)(types.intp), generate


@compiled
def view(address: int, shape: int | tuple[int, ...]) -> Any:
    """The numbers at an address as an array of a shape."""
    return numba.carray(_pointer(address), shape)  # type: ignore[call-arg]

"""Assets, checkpoints and results on disk, without pickle and without half-written files.

A checkpoint is one safetensors file whose header carries a JSON record (study, method,
configuration, seeds, versions, command, commit) and a digest of all that is in the file. Every file
is written to a temporary name, flushed, and renamed.
"""

from __future__ import annotations

import glob
import hashlib
import json
import os
import platform
import secrets
import subprocess
import sys
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path
from typing import IO, Any

import numpy as np

_FORMAT = "cmc-checkpoint-1"
_HOST = hashlib.sha256(platform.node().encode()).hexdigest()[:8]
"""This machine, in names of temporary files."""


class CheckpointError(ValueError):
    """A checkpoint that is missing, damaged, foreign, or of another study or configuration."""


def asset(*parts: str) -> Path:
    """Path of a shipped asset, in a checkout or in an installed wheel, or FileNotFoundError."""
    package = Path(__file__).resolve().parent
    for root in (package / "assets", package.parent / "assets"):
        if root.joinpath(*parts).exists():
            return root.joinpath(*parts)
    raise FileNotFoundError(f"no asset {'/'.join(parts)!r} is shipped with cmc")


def write_atomic(path: str | Path, write: Callable[[IO[bytes]], Any]) -> Path:
    """Write a file through a temporary name in the same folder, then rename it.

    If writing fails (a full disk, an interrupt), the earlier file is untouched and the temporary
    one is removed; what a killed process left is removed by the next one that writes the file.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_left_over(path)
    temporary = path.with_name(f".{path.name}.{_HOST}-{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return path


def _remove_left_over(path: Path) -> None:
    """Remove temporary files of this machine's processes that are no more."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.{_HOST}-*.tmp"):
        pid = left.name.removeprefix(f".{path.name}.{_HOST}-").split("-")[0]
        if pid.isdigit() and not alive(int(pid)):
            left.unlink(missing_ok=True)


def alive(pid: int) -> bool:
    """Whether a process of this machine is there; always true where that cannot be asked."""
    if os.name != "posix":
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def write_json(path: str | Path, content: Mapping[str, Any]) -> Path:
    """Write `content` as JSON (NaN and infinity are refused), atomically."""
    if not isinstance(content, Mapping):
        raise ValueError(f"content: wanted an object of names and values, got {content!r}")
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    return write_atomic(path, lambda file: file.write(text.encode()))


def read_json(path: str | Path) -> dict[str, Any]:
    """Read a JSON object; a ValueError if the file does not hold one."""
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: wanted a JSON object, found {type(content).__name__}")
    return content


def provenance(command: str, seeds: list[int]) -> dict[str, Any]:
    """What produced a file: the command, seeds, commit and versions."""
    there = [n for n in ("numpy", "scipy", "torch", "mujoco", "gymnasium") if n in sys.modules]
    versions = {"python": platform.python_version()} | {n: metadata.version(n) for n in there}
    return {"command": command, "seeds": seeds, "commit": _commit(), "versions": versions}


def _commit() -> str:
    """Commit of the checkout, with `+changes` if it is not clean; `unknown` outside of one."""
    here = Path(__file__).resolve().parent
    try:
        run = [
            subprocess.run(["git", *words], cwd=here, capture_output=True, text=True, check=True)
            for words in (["rev-parse", "--short=12", "HEAD"], ["status", "--porcelain", "--", "."])
        ]
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return run[0].stdout.strip() + ("+changes" if run[1].stdout.strip() else "")


def save_checkpoint(
    path: str | Path, tensors: Mapping[str, np.ndarray], record: Mapping[str, Any]
) -> Path:
    """Write finite arrays and their JSON record as one safetensors file, atomically.

    Raises:
        ValueError: if an array is not finite or the record lacks `study` or `method`.
    """
    from safetensors.numpy import save

    missing = {"study", "method"} - set(record)
    if missing:
        raise ValueError(f"the checkpoint record lacks {sorted(missing)}")
    arrays = {name: np.ascontiguousarray(array) for name, array in tensors.items()}
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"tensor {name!r} is not finite: nothing was written to {path}")
    text = json.dumps(dict(record), allow_nan=False)
    header = {"format": _FORMAT, "record": text, "digest": _digest(arrays, text)}
    data = save(arrays, metadata=header)
    return write_atomic(path, lambda file: file.write(data))


def load_checkpoint(
    path: str | Path, *, study: str | None = None, method: str | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays by name, and the record, from a file that `save_checkpoint` wrote.

    Args:
        path: the file.
        study: if given, the study it must belong to.
        method: if given, the method it must have been trained with.

    Raises:
        CheckpointError: if it is missing, damaged, pickled, foreign or of another study/method.
    """
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}")
    try:
        with safe_open(path, framework="np") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, TypeError, ValueError, KeyError) as error:
        raise CheckpointError(
            f"{path} is not a complete safetensors file ({error}); "
            "truncated, pickled and foreign files are refused"
        ) from error
    form, text = header.get("format"), header.get("record", "")
    if form != _FORMAT:
        raise CheckpointError(f"{path}: wanted a file of format {_FORMAT!r}, found {form!r}")
    if header.get("digest") != _digest(tensors, text):
        raise CheckpointError(f"{path} is damaged: its content is not what was written")
    record: dict[str, Any] = json.loads(text)
    for key, wanted in (("study", study), ("method", method)):
        if wanted is not None and record[key] != wanted:
            raise CheckpointError(
                f"{path}: wanted a checkpoint of {key} {wanted!r}, found {record[key]!r}"
            )
    return tensors, record


def _digest(arrays: Mapping[str, np.ndarray], record: str) -> str:
    """SHA-256 of names, types, shapes and contents of the arrays, and of the record."""
    found = hashlib.sha256(record.encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        found.update(f"{name} {array.dtype.str} {array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()

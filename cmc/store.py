"""Assets, checkpoints and results on disk, without pickle and without half-written files.

A checkpoint is one safetensors file whose header carries a JSON record (study, method,
configuration, seeds, versions, command, commit) and a digest of all that is in the file. Every file
is written to a temporary name, flushed, and renamed.
"""

from __future__ import annotations

import errno
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
    package, inside = Path(__file__).resolve().parent, Path(*(as_path("asset", p) for p in parts))
    for root in (package / "assets", package.parent / "assets"):
        if (root / inside).exists():
            return root / inside
    raise FileNotFoundError(f"no asset '{inside}' is shipped with cmc")


def as_path(name: str, value: str | Path) -> Path:
    """A path, or a ValueError that names the argument."""
    if not isinstance(value, (str, Path)):
        raise ValueError(f"{name}: wanted a path, got {value!r}")
    return Path(value)


def write_atomic(path: str | Path, write: Callable[[IO[bytes]], Any]) -> Path:
    """Write a file through a temporary name in the same folder, then rename it.

    If writing fails (a full disk, an interrupt), the earlier file is untouched and the temporary
    one is removed; what a killed process left is removed by the next one that writes the file.
    """
    path = as_path("path", path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        code = errno.ENOTDIR
        raise NotADirectoryError(code, os.strerror(code), str(path.parent)) from error
    own = f".{path.name}.{_HOST}-"
    for left in path.parent.glob(f"{glob.escape(own)}*.tmp"):
        pid = left.name.removeprefix(own).split("-")[0]
        if pid.isdecimal() and not (int(pid) and alive(int(pid))):
            left.unlink(missing_ok=True)
    temporary = path.with_name(f"{own}{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(path)
        raise
    return path


def alive(pid: int) -> bool:
    """Whether a process of this machine is there; always true where that cannot be asked."""
    if type(pid) is not int or pid < 1:  # 0 and less are groups of processes to the system
        raise ValueError(f"pid: wanted the number of a process, from 1, got {pid!r}")
    if os.name == "posix":
        try:
            os.kill(pid, 0)
        except (ProcessLookupError, OverflowError):
            return False
        except PermissionError:
            pass
    return True


def write_json(path: str | Path, content: Mapping[str, Any]) -> Path:
    """Write `content` as JSON (NaN and infinity are refused), atomically."""
    text = as_json("content", content, indent=1) + "\n"
    return write_atomic(path, lambda file: file.write(text.encode()))


def as_json(name: str, content: Any, *needed: str, indent: int | None = None) -> str:
    """An object as JSON, or a ValueError that names the argument and what is wrong with it."""
    if not isinstance(content, Mapping):
        raise ValueError(f"{name}: wanted an object of names and values, got {content!r}")
    if missing := [key for key in needed if not isinstance(content.get(key), str)]:
        raise ValueError(f"{name}: lacks {missing}")
    try:
        return json.dumps(dict(content), indent=indent, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {error}") from error


def read_json(path: str | Path) -> dict[str, Any]:
    """Read a JSON object; a ValueError if the file does not hold one."""
    try:
        content = json.loads(as_path("path", path).read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: wanted a JSON object, found {type(content).__name__}")
    return content


def provenance(command: str, seeds: list[int]) -> dict[str, Any]:
    """What produced a file: the command, seeds, commit and versions."""
    named = isinstance(command, str) and isinstance(seeds, list)
    if not named or any(type(seed) is not int for seed in seeds):
        raise ValueError(f"command, seeds: wanted text and integers, got {command!r}, {seeds!r}")
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
    """Write finite arrays, and a JSON record with study and method, as one safetensors file."""
    from safetensors.numpy import save

    text = as_json("record", record, "study", "method")
    if not isinstance(tensors, Mapping):
        raise ValueError(f"tensors: wanted arrays by name, got {tensors!r}")
    for name, array in tensors.items():
        numbers = isinstance(array, np.ndarray) and array.dtype.kind in "biuf"
        if not (isinstance(name, str) and numbers and np.isfinite(array).all()):
            raise ValueError(f"tensor {name!r} is not finite numbers: nothing is written to {path}")
    arrays = {name: np.ascontiguousarray(array) for name, array in tensors.items()}
    header = {"format": _FORMAT, "record": text, "digest": _digest(arrays, text)}
    data = save(arrays, metadata=header)
    return write_atomic(path, lambda file: file.write(data))


def load_checkpoint(
    path: str | Path, *, study: str | None = None, method: str | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays by name, and the record, from a file that `save_checkpoint` wrote.

    Raises:
        CheckpointError: if it is missing, damaged, pickled, foreign, or of another study or method
            than these, where they are given.
    """
    from safetensors import SafetensorError, safe_open

    path = as_path("path", path)
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}")
    try:
        with safe_open(path, framework="np") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, TypeError, ValueError, KeyError) as error:
        raise CheckpointError(f"{path} is not a complete safetensors file ({error})") from error
    form, text = header.get("format"), header.get("record", "")
    if form != _FORMAT:
        raise CheckpointError(f"{path}: wanted a file of format {_FORMAT!r}, found {form!r}")
    if header.get("digest") != _digest(tensors, text):
        raise CheckpointError(f"{path} is damaged: its content is not what was written")
    record: dict[str, Any] = json.loads(text)
    for key, wanted in (("study", study), ("method", method)):
        if wanted is not None and record[key] != wanted:
            said = f"wanted a checkpoint of {key} {wanted!r}, found {record[key]!r}"
            raise CheckpointError(f"{path}: {said}")
    return tensors, record


def _digest(arrays: Mapping[str, np.ndarray], record: str) -> str:
    """SHA-256 of names, types, shapes and contents of the arrays, and of the record."""
    found = hashlib.sha256(record.encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        found.update(f"{name} {array.dtype.str} {array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()

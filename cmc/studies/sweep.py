"""Methods times seeds, trained side by side: on this machine, or on a Dask cluster.

A job trains one method with a group of seeds and writes to its own folder; since seeds do not mix,
the groups of a method are put together afterwards as if they had been trained at once. A job that
was stopped goes on when the same sweep is started again.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cmc import store, studies

Backend = Literal["loky", "dask"]


def sweep(
    study: str,
    names: Sequence[str],
    seeds: Sequence[int],
    *,
    jobs: int = 1,
    backend: Backend = "loky",
    group: int | None = None,
    address: str | None = None,
    out: str | Path | None = None,
    **amount: int | None,
) -> list[Path]:
    """Train several methods.

    Args:
        study: name of the study.
        names: its methods.
        seeds: one training for each.
        jobs: how many run at a time.
        backend: "loky" runs processes of this machine, "dask" a cluster (extra `cmc[cluster]`).
        group: seeds of one job; all seeds of a method if None, which costs least in all.
        address: of a running Dask scheduler; a cluster of `jobs` processes is made if None.
        out: folder, by default `runs/STUDY`.
        amount: `steps` or `episodes`, whichever the study's `train` takes.

    Returns:
        The checkpoint file of each method.

    Raises:
        ValueError: for an unknown study, method or backend, no seed, or less than one job.
    """
    known = studies.get(study).METHODS
    for name in names:
        if name not in known:
            raise ValueError(f"unknown method {name!r}; wanted one of {', '.join(known)}")
    size = len(seeds) if group is None else group
    for what, number in (("seeds", len(seeds)), ("jobs", jobs), ("group", size)):
        if number < 1:
            raise ValueError(f"{what}: wanted at least 1, got {number}")
    folder = Path(out) if out is not None else Path("runs") / study
    parts = [list(seeds[k : k + size]) for k in range(0, len(seeds), size)]
    whole = len(parts) == 1
    wanted = [
        (name, part, folder if whole else folder / "parts" / f"{name}_{part[0]}-{part[-1]}")
        for name in names
        for part in parts
    ]
    made = _run(study, wanted, jobs, backend, address, amount)
    if whole:
        return made
    grouped = [made[k : k + len(parts)] for k in range(0, len(made), len(parts))]
    return [merge(paths, folder / paths[0].name) for paths in grouped]


def _run(
    study: str,
    wanted: list[tuple[str, list[int], Path]],
    jobs: int,
    backend: str,
    address: str | None,
    amount: dict[str, Any],
) -> list[Path]:
    if backend not in ("loky", "dask"):
        raise ValueError(f"backend: wanted 'loky' or 'dask', got {backend!r}")
    from joblib import Parallel, delayed, parallel_config

    calls = [delayed(_train)(study, name, part, str(where), amount) for name, part, where in wanted]
    if backend == "loky":
        return [Path(path) for path in Parallel(n_jobs=jobs, batch_size=1, verbose=5)(calls)]
    with _cluster(jobs, address), parallel_config(backend="dask"):
        return [Path(path) for path in Parallel(n_jobs=jobs, batch_size=1, verbose=5)(calls)]


def _train(study: str, name: str, seeds: list[int], out: str, amount: dict[str, Any]) -> str:
    """One job; runs in a worker."""
    return str(studies.get(study).train(name, seeds, out=out, **amount))


@contextmanager
def _cluster(jobs: int, address: str | None) -> Iterator[None]:
    """A Dask client, with a cluster on the loopback interface unless there is an address."""
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ValueError("backend 'dask' needs the extra: pip install 'cmc[cluster]'") from error
    if address is not None:
        with Client(address):
            yield
        return
    local = {"host": "127.0.0.1", "dashboard_address": None, "threads_per_worker": 1}
    with LocalCluster(n_workers=jobs, **local) as cluster, Client(cluster):
        yield


def merge(paths: Sequence[Path], out: Path) -> Path:
    """Put checkpoints of the same method and different seeds together.

    Raises:
        CheckpointError: if they are of different studies, methods, configurations or lengths.
    """
    loaded = [store.load_checkpoint(path) for path in paths]
    tensors, record = loaded[0]
    for path, (others, found) in zip(paths, loaded, strict=True):
        for key in ("study", "method", "configuration"):
            if found.get(key) != record.get(key):
                raise store.CheckpointError(f"{path}: {key} differs from that of {paths[0]}")
        if set(others) != set(tensors):
            raise store.CheckpointError(f"{path}: other policies are kept than in {paths[0]}")
    joined = {
        key: np.concatenate([part[key] for part, _ in loaded], axis=_seed_axis(key))
        for key in tensors
    }
    seeds = [seed for _, found in loaded for seed in found["seeds"]]
    command = str(record.get("command", ""))
    command = re.sub(
        r"--seeds \d+", f"--seeds {len(seeds)} --group {len(record['seeds'])}", command
    )
    return store.save_checkpoint(out, joined, {**record, "seeds": seeds, "command": command})


def _seed_axis(key: str) -> int:
    """Curves are (time, seeds); weights have the seeds first."""
    return 1 if key in ("rewards", "returns") else 0

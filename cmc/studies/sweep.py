"""Methods times seeds, trained side by side: on this machine, or on a Dask cluster.

A job trains one method with a group of seeds and writes to its own folder; since seeds do not mix,
the groups of a method are put together afterwards as if they had been trained at once. A job that
was stopped goes on when the same sweep is started again.

A cluster made here listens on the loopback interface without a password: on a machine that others
use too, prefer loky.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from cmc.store import alive
from cmc.studies import registry, runner
from cmc.studies.shipping import merge

Backend = Literal["loky", "dask"]


def sweep(
    study: str,
    names: Sequence[str],
    seeds: Sequence[int],
    *,
    length: int | None = None,
    jobs: int = 1,
    backend: Backend = "loky",
    group: int | None = None,
    address: str | None = None,
    out: str | Path | None = None,
) -> list[Path]:
    """Train several methods.

    Args:
        study: name of the study.
        names: its methods.
        seeds: one training for each.
        length: steps or episodes of each seed, in place of the study's.
        jobs: how many run at a time.
        backend: "loky" runs processes of this machine, "dask" a cluster (extra `cmc[cluster]`).
        group: seeds of one job; all seeds of a method if None, which costs least in all.
        address: of a running Dask scheduler; a cluster of `jobs` processes is made if None.
        out: folder, by default `runs/STUDY`.

    Returns:
        The checkpoint file of each method.

    Raises:
        ValueError: for an unknown study, method or backend, no seed, or less than one job.
    """
    for name in names:
        registry.get(study).method(name)
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
    made = _run(study, wanted, length, min(jobs, len(wanted)), backend, address)
    if whole:
        return made
    grouped = [made[k : k + len(parts)] for k in range(0, len(made), len(parts))]
    return [merge(paths, folder / paths[0].name) for paths in grouped]


def _run(
    study: str,
    wanted: list[tuple[str, list[int], Path]],
    length: int | None,
    jobs: int,
    backend: str,
    address: str | None,
) -> list[Path]:
    if backend not in ("loky", "dask"):
        raise ValueError(f"backend: wanted 'loky' or 'dask', got {backend!r}")
    from joblib import Parallel, delayed, parallel_config

    parent = None if address is not None else os.getpid()
    calls = [
        delayed(_train)(study, name, part, str(where), length, parent)
        for name, part, where in wanted
    ]
    if backend == "loky":
        return [Path(path) for path in Parallel(n_jobs=jobs, batch_size=1, verbose=5)(calls)]
    with _cluster(jobs, address), parallel_config(backend="dask"):
        return [Path(path) for path in Parallel(n_jobs=jobs, batch_size=1, verbose=5)(calls)]


def _train(
    study: str, name: str, seeds: list[int], out: str, length: int | None, parent: int | None
) -> str:
    """One job; runs in a worker, which ends when the process that started the sweep does."""
    if parent is not None and parent != os.getpid():
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    return str(runner.train(registry.get(study), name, seeds, length=length, out=out))


def _end_with(parent: int) -> None:
    """End this process once the parent has; what was saved last is where the run goes on."""
    while alive(parent):
        time.sleep(1.0)
    os._exit(1)


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
    quiet = {"dashboard_address": "127.0.0.1:0", "scheduler_kwargs": {"dashboard": False}}
    with (
        LocalCluster(n_workers=jobs, host="127.0.0.1", threads_per_worker=1, **quiet) as cluster,
        Client(cluster),
    ):
        cluster.scheduler.http_server.stop()  # no option leaves it out altogether
        yield

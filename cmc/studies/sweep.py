"""Methods times seeds, trained side by side: on this machine, or on a Dask cluster.

A job trains one method with a group of seeds and writes to its own folder; since seeds do not mix,
the groups of a method are put together afterwards as if they had been trained at once. A job that
was stopped goes on when the same sweep is started again.

A cluster made here listens on the loopback interface without a password: on a machine that others
use too, prefer loky.
"""

from __future__ import annotations

import os
import re
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Literal

import numpy as np

from cmc import store, studies
from cmc.studies import runner
from cmc.studies.study import checked_methods, checked_seeds
from cmc.theory.arrays import count


def sweep(
    study: str,
    names: Sequence[str],
    seeds: Sequence[int],
    *,
    length: int | None = None,
    jobs: int = 1,
    backend: Literal["loky", "dask"] = "loky",
    group: int | None = None,
    address: str | None = None,
    out: str | Path | None = None,
) -> list[Path]:
    """Train several methods with the same seeds; the checkpoint file of each.

    A job has `group` seeds of a method (all if None, which costs least in all); `jobs` run at a
    time: by "loky" in processes of this machine, by "dask" (extra `cmc[cluster]`) at the `address`
    of a scheduler or in a cluster of `jobs` processes made for it. `length` and `out` are those of
    `runner.train`.
    """
    names = checked_methods("names", studies.get(study), names, least=1)
    seeds = checked_seeds(seeds)
    size = count("group", len(seeds) if group is None else group)
    if backend not in ("loky", "dask"):
        raise ValueError(f"backend: wanted 'loky' or 'dask', got {backend!r}")
    if length is not None:
        length = count("length", length, runner.MOST)
    from joblib import Parallel, delayed, parallel_config

    folder = store.as_path("out", Path("runs") / study if out is None else out)
    parts = [seeds[k : k + size] for k in range(0, len(seeds), size)]
    parent = None if address is not None else os.getpid()
    calls = []
    for name in names:
        for part in parts:
            own = folder / "parts" / f"{name}_{part[0]}-{part[-1]}" if len(parts) > 1 else folder
            calls.append(delayed(_train)(study, name, part, str(own), length, parent))
    jobs = min(count("jobs", jobs), len(calls))
    cluster = _cluster(jobs, address) if backend == "dask" else nullcontext()
    with cluster, parallel_config(backend=backend):
        made = [Path(p) for p in Parallel(n_jobs=jobs, batch_size=1, verbose=5)(calls)]
    if len(parts) == 1:
        return made
    grouped = [made[k : k + len(parts)] for k in range(0, len(made), len(parts))]
    return [merge(paths, folder / paths[0].name) for paths in grouped]


def _train(
    study: str, name: str, seeds: list[int], out: str, length: int | None, parent: int | None
) -> str:
    """One job; runs in a worker, which ends when the process that started the sweep does."""

    def end_with_parent() -> None:  # what was saved last is where the run goes on
        while parent is not None and store.alive(parent):
            time.sleep(1.0)
        os._exit(1)

    if parent is not None and parent != os.getpid():
        threading.Thread(target=end_with_parent, daemon=True).start()
    return str(runner.train(studies.get(study), name, seeds, length=length, out=out))


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


def merge(paths: Sequence[Path], out: Path) -> Path:
    """Put checkpoints of the same method and different seeds together, or say what differs."""
    if not isinstance(paths, Sequence) or not paths:
        raise ValueError(f"paths: wanted checkpoint files, got {paths!r}")
    loaded = [store.load_checkpoint(path) for path in paths]
    tensors, record = loaded[0]
    for path, (others, found) in zip(paths, loaded, strict=True):
        for key in ("study", "method", "configuration"):
            if found.get(key) != record.get(key):
                raise store.CheckpointError(f"{path}: {key} differs from that of {paths[0]}")
        if set(others) != set(tensors):
            raise store.CheckpointError(f"{path}: other policies are kept than in {paths[0]}")
    joined = {
        # curves are (time, seeds); weights have the seeds first
        key: np.concatenate([part[key] for part, _ in loaded], axis=int(not key[0].isdigit()))
        for key in tensors
    }
    seeds = [seed for _, found in loaded for seed in found["seeds"]]
    if len(set(seeds)) < len(seeds):
        raise store.CheckpointError(f"paths: wanted different seeds, got {seeds}")
    command = f"--seeds {len(seeds)} --group {len(record['seeds'])}"
    command = re.sub(r"--seeds \d+", command, str(record.get("command", "")))
    return store.save_checkpoint(out, joined, {**record, "seeds": seeds, "command": command})

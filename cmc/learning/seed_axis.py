"""Operations on the leading axis of seeds that keep the seeds apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor


def shuffle(data: Tensor, generators: Sequence[np.random.Generator]) -> Tensor:
    """Put the rows of data (S, N, columns) in random order, each seed by its own generator."""
    S, N, columns = data.shape
    order = np.stack([g.permutation(N) + N * s for s, g in enumerate(generators)])
    index = torch.from_numpy(order.reshape(-1))
    return data.reshape(S * N, columns).index_select(0, index).reshape(S, N, columns)


def clip_gradients(gradients: Sequence[Tensor | None], seeds: int, max_norm: float) -> None:
    """Scale each seed's gradient, over all parameters, to a norm of at most `max_norm`."""
    rows = [gradient.view(seeds, -1) for gradient in gradients if gradient is not None]
    squares = torch.stack([torch.linalg.vector_norm(row, dim=1) for row in rows])
    scale = (max_norm / (torch.linalg.vector_norm(squares, dim=0) + 1e-6)).clamp(max=1.0)
    for row in rows:
        row.mul_(scale.unsqueeze(1))


@contextmanager
def single_thread() -> Iterator[None]:
    """Keep torch to one thread: on products this small more threads only wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)

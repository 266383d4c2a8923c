"""A progress bar as a callback; any other callback (a live curve) may be called beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from tqdm.auto import tqdm


@contextmanager
def bar(description: str = "training") -> Iterator[Callable[[dict[str, Any]], None]]:
    """Yield a callback that shows updates, time left and the mean return over seeds.

    Args:
        description: text before the bar.
    """
    with tqdm(desc=description, unit="update") as progress:

        def show(report: dict[str, Any]) -> None:
            progress.total = report["total_updates"]
            if progress.n == 0 and report["update"] > 1:
                progress.initial = progress.n = report["update"] - 1  # resumed
            progress.set_postfix_str(
                f"return {np.mean(report['episode_return']):.2f}", refresh=False
            )
            progress.update(report["update"] - progress.n)

        yield show
        progress.refresh()

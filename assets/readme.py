"""Make the picture of README.md: `python assets/readme.py` writes assets/readme.png.

The experiment of lesson 00: one plant, one moving target, random networks whose weights are taken
as drawn, and the same weights with their absolute values.
"""

from pathlib import Path

import numpy as np

from cmc import plants
from cmc.theory.simulate import flow
from cmc.view import figures

NUMBER, STARTS, GAIN = 60, 32, 2.0
TIMES = np.linspace(0.0, 25.0, 251)


def target(t: float | np.ndarray) -> np.ndarray:
    """A figure of eight, (..., 2)."""
    return 2.4 * np.stack([np.sin(0.4 * t), 0.6 * np.sin(0.8 * t)], axis=-1)


def follow(W: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Trajectories (time, network, start, 2) of the networks w . tanh(W s), one a dimension."""
    plant = plants.get("coupled_lags")
    space = plant.space()
    angle = 2.0 * np.pi * np.arange(STARTS) / STARTS
    start = np.zeros((len(W), STARTS, 4))
    start[..., :2] = 3.2 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def rhs(time: float, x: np.ndarray) -> np.ndarray:
        y, integral = x[..., :2], x[..., 2:]
        z = space.to_z(y - target(time))
        s = np.stack([z, integral], axis=-1)
        a = -GAIN * (w * np.tanh((W @ s[..., None])[..., 0])).sum(-1)
        return np.concatenate([plant.f(y, space.to_u(a)), z], axis=-1)

    return flow(rhs, start, TIMES, tol=1e-5)[..., :2]


def main() -> None:
    """Draw the first network of each kind, and count all of them."""
    rng = np.random.default_rng(0)
    W = rng.normal(size=(NUMBER, 1, 2, 16, 2))
    w = rng.normal(size=(NUMBER, 1, 2, 16)) / 4.0
    fig, axes = figures.panels(1, 2, width=9.6, height=5.0, sharex=True, sharey=True)
    kinds = {
        "weights of any sign": (W, w, figures.BAD),
        "the same, made positive": (np.abs(W), np.abs(w), figures.GOOD),
    }
    for ax, (name, (first, last, color)) in zip(axes[0], kinds.items(), strict=True):
        paths = follow(first, last)
        gaps = np.linalg.norm(paths[-1, :, :, None] - paths[-1, :, None], axis=-1)
        apart = int((gaps.max(axis=(1, 2)) > 0.1).sum())
        shown = paths[:, 0]
        ax.plot(shown[..., 0], shown[..., 1], color=color, lw=0.8, alpha=0.45)
        ax.plot(shown[0, :, 0], shown[0, :, 1], "o", ms=3, color=color, alpha=0.5)
        ax.plot(shown[-1, :, 0], shown[-1, :, 1], "o", ms=6, color="black", mec="white", zorder=5)
        ax.plot(*target(np.linspace(0, 5 * np.pi, 200)).T, ":", lw=1.2, color="black", alpha=0.6)
        ax.set(xlim=(-5, 5), ylim=(-4.6, 5.4), aspect="equal", xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
        title = f"{name}: in {apart} of {NUMBER} networks\ntrajectories stay apart"
        ax.text(0.5, 0.99, title, transform=ax.transAxes, ha="center", va="top", fontsize=12)
    text = "One plant, one moving target, two random networks: 32 starts, black dots at the end."
    print(figures.save(fig, Path(__file__).with_name("readme.png"), text))


if __name__ == "__main__":
    main()

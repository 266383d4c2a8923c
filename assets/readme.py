"""Make the picture of README.md: `python assets/readme.py` writes assets/readme.png."""

from pathlib import Path

import numpy as np

from cmc.lessons.lesson_00 import random_networks, target
from cmc.view import figures


def main() -> None:
    """Simulate the loops of lesson 00 and draw one of each kind."""
    loops = random_networks(number=60)
    k = loops["example"]
    many = random_networks(number=k + 1, starts=32)
    fig, axes = figures.panels(1, 2, width=9.6, height=5.0, sharex=True, sharey=True)
    kinds = {
        "any": ("weights of any sign", figures.BAD),
        "positive": ("positive weights", figures.GOOD),
    }
    for ax, (kind, (name, color)) in zip(axes[0], kinds.items(), strict=True):
        apart = int((loops[f"apart_{kind}"] > 0.1).sum())
        paths = many[kind][:, k]
        ax.plot(paths[..., 0], paths[..., 1], color=color, lw=0.8, alpha=0.45)
        ax.plot(paths[0, :, 0], paths[0, :, 1], "o", ms=3, color=color, alpha=0.5)
        ax.plot(paths[-1, :, 0], paths[-1, :, 1], "o", ms=6, color="black", mec="white", zorder=5)
        ax.plot(*target(np.linspace(0, 5 * np.pi, 200)).T, ":", lw=1.2, color="black", alpha=0.6)
        ax.set(xlim=(-3.6, 3.6), ylim=(-3.4, 4.2), aspect="equal", xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
        title = f"{name}: in {apart} of 60 networks\ntrajectories stay apart"
        ax.text(0.5, 0.99, title, transform=ax.transAxes, ha="center", va="top", fontsize=12)
    text = "One plant, one moving target, two random networks: 32 starts, black dots at the end."
    print(figures.save(fig, Path(__file__).with_name("readme.png"), text))


if __name__ == "__main__":
    main()

"""Choose which kept policies of a run are shipped.

`python -m cmc.studies.shipping peg_maze FOLDER --all ctd3` copies the last policy of every method
found in the folder (all kept ones of the methods named by `--all`), bit by bit, to
`assets/checkpoints`, with the run's record beside each as JSON.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Iterable
from pathlib import Path

from cmc import store, studies
from cmc.studies.two_level_training import marks


def ship(
    study: str, folder: str | Path, out: str | Path, complete: Collection[str] = ()
) -> list[Path]:
    """Copy the policies of a run.

    Args:
        study: name of a two-level study.
        folder: where its checkpoints are.
        out: where they go.
        complete: methods of which all kept policies are copied, not only the last.

    Returns:
        The checkpoints written.

    Raises:
        ValueError: for an unknown study or method.
        FileNotFoundError: if the folder holds no checkpoint of the study.
        CheckpointError: if one is damaged or of another study.
    """
    found = studies.get(study)
    for name in complete:
        found.STUDY.method(name)
    written = []
    for name in found.METHODS:
        path = Path(folder) / f"{study}_{name}.safetensors"
        if not path.is_file():
            continue
        tensors, record = store.load_checkpoint(path, study=study, method=name)
        kept = marks(found.STUDY, name, path)
        wanted = kept if name in complete else kept[-1:]
        starts = tuple(f"{mark:08d}." for mark in wanted)
        chosen = {k: v for k, v in tensors.items() if k == "rewards" or k.startswith(starts)}
        target = Path(out) / path.name
        written.append(store.save_checkpoint(target, chosen, record))
        store.write_json(target.with_suffix(".json"), record)
    if not written:
        raise FileNotFoundError(f"no checkpoint of {study} in {folder}")
    return written


def main(arguments: Iterable[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("study")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--all", nargs="*", default=[], metavar="METHOD", dest="complete")
    parser.add_argument("--out", type=Path, default=Path("assets/checkpoints"))
    chosen = parser.parse_args(None if arguments is None else [*arguments])
    for path in ship(chosen.study, chosen.folder, chosen.out, chosen.complete):
        print(path)


if __name__ == "__main__":
    main()

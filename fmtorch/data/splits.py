"""Which sequences the paper trains and tests on (Bian et al., BMVC 2019, Section 4 and its supplement)."""

from __future__ import annotations

from collections.abc import Sequence

from fmtorch.data.text_files import DataError

SPLITS: dict[str, dict[str, tuple[str, ...]]] = {
    "tum": {
        "test": (
            "rgbd_dataset_freiburg3_teddy",
            "rgbd_dataset_freiburg3_large_cabinet",
            "rgbd_dataset_freiburg3_long_office_household",
        ),
    },
    "kitti": {
        "test": ("06", "07", "08", "09", "10"),
        "train": ("00", "01", "02", "03", "04", "05"),
    },
    "colmap": {
        "test": ("Panther", "Playground", "Train", "Roman_Forum"),
        "train": ("Family", "Francis", "Horse", "Lighthouse", "M60"),
    },
}  # fmt: skip
"""By data set and split the names of sequences or scenes. Without `train` these are all others."""


def chosen(name: str, split: str, sequences: Sequence[str] | None, there: Sequence[str]) -> list[str]:
    """The sequences to read: those asked for, or those of the split.

    there: the names of those on disk, among which a split of "all others" chooses. Raises DataError for an unknown
    split, and where no sequence is left.
    """
    if split not in ("test", "train"):
        raise DataError(f"split {split!r}; there are test and train")
    if sequences is not None:
        names = list(sequences)
    elif split in SPLITS[name]:
        names = list(SPLITS[name][split])
    else:
        names = sorted(set(there) - set(SPLITS[name]["test"]))
    if not names:
        raise DataError(f"{name}: no sequence in split {split!r}; dataset.sequences=[...] names some")
    if len(set(names)) < len(names):
        raise DataError(f"sequences={names}: one is named twice")
    return names

"""What is kept on disk: results and features."""

from fmtorch.runs.feature_cache import CachedFeatures, cached
from fmtorch.runs.run_folder import PAIR_SCHEMA, PairRow, RunFolder, RunFolderError, identity_digest, to_table

__all__ = [
    "PAIR_SCHEMA", "CachedFeatures", "PairRow", "RunFolder", "RunFolderError", "cached", "identity_digest", "to_table",
]  # fmt: skip

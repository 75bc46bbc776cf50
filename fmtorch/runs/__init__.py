"""What is kept on disk: results and features."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.runs.feature_cache import ArrayCache, CachedFeatures, cached, image_digest
    from fmtorch.runs.fingerprint import code_digest, configuration, fmtorch_version, libraries
    from fmtorch.runs.run_folder import PAIR_SCHEMA, PairRow, RunFolder, RunFolderError, identity_digest, to_table

__all__ = [
    "PAIR_SCHEMA", "ArrayCache", "CachedFeatures", "PairRow", "RunFolder", "RunFolderError", "cached",
    "code_digest", "configuration", "fmtorch_version", "identity_digest", "image_digest", "libraries", "to_table",
]  # fmt: skip

lazy_exports(__name__)

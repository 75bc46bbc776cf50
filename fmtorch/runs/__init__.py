"""What is kept on disk: results and features."""

from fmtorch.core.files import replacing
from fmtorch.runs.run_folder import PAIR_SCHEMA, PairRow, RunFolder, RunFolderError, identity_digest, to_table

__all__ = ["PAIR_SCHEMA", "PairRow", "RunFolder", "RunFolderError", "identity_digest", "replacing", "to_table"]

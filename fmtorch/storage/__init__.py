"""What is kept on disk: results and features."""

from fmtorch.core.files import replacing
from fmtorch.storage.rows import PAIR_SCHEMA, PairRow, to_table
from fmtorch.storage.runs import RunFolder, RunFolderError, identity_digest

__all__ = ["PAIR_SCHEMA", "PairRow", "RunFolder", "RunFolderError", "identity_digest", "replacing", "to_table"]

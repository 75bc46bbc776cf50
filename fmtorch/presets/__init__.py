"""Presets: the flat YAML files of ``conf/<group>/<name>.yaml``, loaded by name and built into objects.

With the commands this is the only user of Hydra and OmegaConf.
"""

from fmtorch.presets.composition import (
    STAGES,
    build_pipeline,
    composed,
    expect_dataset,
    expect_stages,
    pipeline,
    pipeline_stages,
    stages,
)
from fmtorch.presets.files import (
    available,
    closest,
    known_targets,
    load,
    own_modules,
    peer_packages,
    targets_of,
)
from fmtorch.presets.objects import build, expect_buildable, instantiate, plain, resolve_device

__all__ = [
    "STAGES", "available", "build", "build_pipeline", "closest", "composed", "expect_buildable", "expect_dataset",
    "expect_stages", "instantiate", "known_targets", "load", "own_modules", "peer_packages", "pipeline",
    "pipeline_stages", "plain", "resolve_device", "stages", "targets_of",
]  # fmt: skip

"""Presets: the flat YAML files of ``conf/<group>/<name>.yaml``, loaded by name and built into objects.

`files` needs neither Hydra nor OmegaConf, which compose the configs of commands and pipelines."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.core.files import STAGES
    from fmtorch.presets.composition import (
        compose,
        composed,
        expect_stages,
        pipeline_stages,
        plain,
        resolve_device,
        stages,
    )
    from fmtorch.presets.files import (
        available,
        build,
        closest,
        expect_buildable,
        instantiate,
        known_targets,
        load,
        merged,
        own_modules,
        peer_packages,
        target_of,
        targets_of,
    )

__all__ = [
    "STAGES", "available", "build", "closest", "compose", "composed", "expect_buildable", "expect_stages",
    "instantiate", "known_targets", "load", "merged", "own_modules", "peer_packages", "pipeline_stages", "plain",
    "resolve_device", "stages", "target_of", "targets_of",
]  # fmt: skip

lazy_exports(__name__)

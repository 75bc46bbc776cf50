"""Presets: the flat YAML files of ``conf/<group>/<name>.yaml``, loaded by name and built into objects.

`files` needs neither Hydra nor OmegaConf, which compose the configs of commands and pipelines."""

from typing import TYPE_CHECKING

from fmtorch.core.lazy import lazy_exports

if TYPE_CHECKING:
    from fmtorch.core.files import STAGES
    from fmtorch.presets.composition import composed, expect_stages, pipeline_stages, plain, resolve_device, stages
    from fmtorch.presets.files import available, build, expect_buildable, instantiate, load, merged, target_of

__all__ = [
    "STAGES", "available", "build", "composed", "expect_buildable", "expect_stages", "instantiate", "load", "merged",
    "pipeline_stages", "plain", "resolve_device", "stages", "target_of",
]  # fmt: skip

lazy_exports(__name__)

"""The commands: each reads a config and calls the rooms below. `fmtorch eval` and `python -m fmtorch.eval` are one."""

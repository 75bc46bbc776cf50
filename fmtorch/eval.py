"""`python -m fmtorch.eval` runs the command of `fmtorch.commands.eval`."""

from fmtorch.commands.eval import main, run

__all__ = ["main", "run"]

if __name__ == "__main__":
    main()

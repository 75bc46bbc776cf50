"""`python -m fmtorch.report` runs the command of `fmtorch.commands.report`."""

from fmtorch.commands.report import main, run

__all__ = ["main", "run"]

if __name__ == "__main__":
    main()

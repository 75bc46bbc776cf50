"""`python -m fmtorch` is `fmtorch`: the commands by one name."""

from fmtorch.commands.main import main

if __name__ == "__main__":
    main()

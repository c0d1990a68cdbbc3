"""`python -m sbt`: the command line."""

from sbt.cli import main

if __name__ == "__main__":
    main()

"""What the live view lets a process of its own do: `python -m sbt.serve.task film DIR RUN`, or `resume DIR`."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from sbt.errors import SbtError

__all__ = ["main"]


def main(arguments: list[str]) -> int:
    """Do one task; print its result as JSON, or the error on stderr and return 1."""
    result = os.dup(1)
    os.dup2(2, 1)  # whatever SUMO or a scenario prints goes elsewhere
    try:
        if arguments[0] == "film":
            from sbt.workflows.live import film_of

            found = film_of(Path(arguments[1]), int(arguments[2]))
            with os.fdopen(result, "w", encoding="utf-8") as out:
                json.dump(found, out, allow_nan=False)
        else:
            from sbt.workflows.live import check_resumable

            configuration = check_resumable(Path(arguments[1]))
            os.dup2(2, 1)
            os.execv(sys.executable, [sys.executable, "-m", "sbt", "run", str(configuration), "--store", arguments[1], "--quiet"])
    except SbtError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))

"""Where the built-in networks are: beside the checkout, or inside the installed wheel."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from sbt.errors import InputError

__all__ = ["net_file", "nets_folder"]


@cache
def nets_folder() -> Path:
    """Return the folder with the built-in networks.

    Raises:
        InputError: the installation has none.
    """
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "_nets", package.parent / "sumo_nets"):
        if folder.is_dir():
            return folder
    raise InputError(f"the built-in networks must be in {package / '_nets'}, but they are not: install the package again")


@cache
def net_file(net: str) -> Path:
    """Return the file of a network: a built-in name, or a path to a `.net.xml`.

    Raises:
        InputError: there is no such file.
    """
    path = nets_folder() / net / f"{net}.net.xml" if "." not in net else Path(net)
    if not path.is_file():
        known = ", ".join(sorted(p.name for p in nets_folder().iterdir() if p.is_dir()))
        raise InputError(f"a network must be one of {known}, or an existing .net.xml file, but got '{net}'")
    return path.resolve()

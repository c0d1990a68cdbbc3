"""The verb `serve`: the live view in a browser."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import secrets
import socket
import sys
from pathlib import Path
from typing import Annotated

import typer

from sbt.cli.console import clean_stdout
from sbt.errors import InputError

__all__ = ["serve"]


def serve(
    folders: Annotated[
        list[Path] | None, typer.Argument(metavar="[DIR...]", help="Folders with campaigns; default: runs.")
    ] = None,
    *,
    port: Annotated[int, typer.Option(min=0, max=65535, metavar="PORT", help="0: any that is free.")] = 8000,
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Where to listen; by default only this machine can ask.")
    ] = "127.0.0.1",
    trust: Annotated[
        bool, typer.Option("--trust", help="Approve the code that the stores name: films and resuming run it.")
    ] = False,
) -> None:
    """Show campaigns in a browser, also while they run: progress, runs, films; stop and resume them."""
    with clean_stdout():
        try:
            import uvicorn

            from sbt.serve.app import application
        except ModuleNotFoundError as error:
            rule = f"serve needs the extra serve, but {error.name} is not installed"
            raise InputError(f"{rule}: pip install 'sumo-sbt[serve]'") from None
        from sbt.serve.campaigns import Campaigns

        campaigns, token, local = Campaigns(folders or [Path("runs")], trusted=trust), secrets.token_urlsafe(24), _is_local(host)
        listening = _listen(host, port)
    name = f"[{host}]" if ":" in host else host
    print(f"http://{name}:{listening.getsockname()[1]}/?token={token}", flush=True)
    others = "" if local else "; others in the network can ask too: keep the token to yourself"
    print(f"ctrl-c ends the view, campaigns go on{others}", file=sys.stderr)
    app = application(campaigns, token=token, hosts=frozenset({"localhost", "127.0.0.1", "::1", host} if local else ()))
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", access_log=False, timeout_graceful_shutdown=1))
    logging.getLogger("uvicorn.error").addFilter(_is_fault)
    try:
        server.run(sockets=[listening])
    except KeyboardInterrupt:
        pass
    finally:
        campaigns.close()


def _is_fault(record: logging.LogRecord) -> bool:
    """Return whether something went wrong: a request that the end of the view cuts off is told of with a long traceback."""
    kind = record.exc_info[0] if record.exc_info else None
    return kind is None or not issubclass(kind, asyncio.CancelledError)


def _is_local(host: str) -> bool:
    """Return whether only this machine can ask there."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        rule = f"the server must be able to listen, but {host}, port {port}: {reason}"
        raise InputError(f"{rule}; --port 0 takes a free one") from None

"""The server of the live view: who may ask, and what is answered."""

from __future__ import annotations

import gzip
import json
import secrets
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Route

from sbt.errors import InputError, SbtError
from sbt.serve.campaigns import Campaigns
from sbt.workflows.live import live_parts, packed_library

__all__ = ["application"]

_COOKIE = "sbt-token"
_LARGE = 10_000
"""Answers larger than so many bytes are packed."""
_SAFE = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
    "img-src data:; connect-src 'self'; frame-ancestors 'none'; form-action 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "Cache-Control": "no-store",
}  # fmt: skip
_REPORT = {
    "Content-Security-Policy": "sandbox allow-scripts allow-downloads; default-src 'none'; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline' 'unsafe-eval'; img-src data:; frame-ancestors 'none'",
}  # fmt: skip
"""Of a report: it came with a store, maybe somebody else's, so it may not ask for what the view may ask for."""
_OWN = {"style": "serve.css", "script": "serve.js"}
Next = Callable[[Request], Awaitable[Response]]


def application(campaigns: Campaigns, *, token: str, hosts: frozenset[str]) -> Starlette:
    """Return the application.

    Args:
        campaigns: what is shown.
        token: everybody who asks must have it; a page that was opened with `?token=` keeps it in a cookie.
        hosts: names under which the server may be asked (a foreign page that resolves to this machine has another); none: all.
    """
    view, guard = _View(campaigns), _Guard(token, hosts)
    return Starlette(
        routes=[
            Route("/", view.index),
            Route("/c/{key}", view.campaign),
            Route("/c/{key}/report", view.report),
            Route("/plotly.js", view.library),
            Route("/api/campaigns", view.listed),
            Route("/api/{key}/status", view.status),
            Route("/api/{key}/explorer", view.explorer),
            Route("/api/{key}/film/{run:int}", view.film),
            Route("/api/{key}/{verb}", view.act, methods=["POST"]),
        ],
        middleware=[Middleware(BaseHTTPMiddleware, dispatch=guard)],
    )


@dataclass(frozen=True)
class _Guard:
    """Answers nobody but the browser of the user."""

    token: str
    hosts: frozenset[str]

    async def __call__(self, request: Request, then: Next) -> Response:
        """Refuse a request, or let it be answered."""
        response = self._refusal(request)
        if response is None and request.method == "GET" and "token" in request.query_params:
            response = RedirectResponse(request.url.path, 303)
            response.set_cookie(_COOKIE, self.token, httponly=True, samesite="strict")
        response = await then(request) if response is None else response
        for name, value in _SAFE.items():
            response.headers.setdefault(name, value)
        return response

    def _refusal(self, request: Request) -> Response | None:
        name = request.headers.get("host", "").rpartition(":")[0].strip("[]").lower()
        if self.hosts and name not in self.hosts:
            return Response("this server is not asked under that name", 421)
        given = request.query_params.get("token") or request.cookies.get(_COOKIE, "")
        if not secrets.compare_digest(given.encode(), self.token.encode()):
            return Response("open the address that `sumo-sbt serve` printed: it has the token", 403)
        if request.method == "POST" and request.headers.get("x-sbt") != "1":  # which no foreign page can send
            return Response("only the page itself may ask for that", 403)
        return None


@dataclass(frozen=True)
class _View:
    """What is answered; work that reads stores is done beside the loop."""

    campaigns: Campaigns

    async def index(self, _: Request) -> Response:
        return HTMLResponse(_page("list.html"))

    async def campaign(self, request: Request) -> Response:
        try:
            await run_in_threadpool(self.campaigns.__getitem__, request.path_params["key"])
        except InputError as error:
            return Response(str(error), 404)
        return HTMLResponse(_page("campaign.html", **live_parts()))

    async def report(self, request: Request) -> Response:
        try:
            path = await run_in_threadpool(self.campaigns.page, request.path_params["key"])
            if path is None:
                raise InputError("there is no report yet: it is written when the campaign ends")
        except InputError as error:
            return Response(str(error), 404)
        return HTMLResponse(await run_in_threadpool(path.read_bytes), headers=_REPORT)

    async def library(self, request: Request) -> Response:
        content, how = await run_in_threadpool(packed_library), {"Cache-Control": "private, max-age=3600"}
        if not content:
            return Response("plotly is not installed", 404)
        if "gzip" in request.headers.get("accept-encoding", ""):
            how["Content-Encoding"] = "gzip"
        else:
            content = gzip.decompress(content)
        return Response(content, media_type="text/javascript", headers=how)

    async def listed(self, request: Request) -> Response:
        return await _answered(request, self.campaigns.listed)

    async def status(self, request: Request) -> Response:
        return await _answered(request, lambda: self.campaigns.status(request.path_params["key"]))

    async def explorer(self, request: Request) -> Response:
        first = request.query_params.get("first") == "1"
        return await _answered(request, lambda: self.campaigns.explorer(request.path_params["key"], first=first))

    async def film(self, request: Request) -> Response:
        return await _answered(request, lambda: self.campaigns.film(request.path_params["key"], request.path_params["run"]))

    async def act(self, request: Request) -> Response:
        do = {"stop": self.campaigns.stop, "resume": self.campaigns.resume}.get(request.path_params["verb"])
        if do is None:
            return JSONResponse({"error": "what can be asked for is stop or resume"}, 404)
        return await _answered(request, lambda: {"said": do(request.path_params["key"])})


async def _answered(request: Request, work: Callable[[], Any]) -> Response:
    """Return what work finds as JSON, packed where that spares much; or its error."""
    try:
        found = await run_in_threadpool(work)
    except InputError as error:
        return JSONResponse({"error": str(error)}, 409 if request.method == "POST" else 404)
    except SbtError as error:
        return JSONResponse({"error": str(error)}, 500)
    text = json.dumps(found, allow_nan=False, separators=(",", ":")).encode()
    if len(text) > _LARGE and "gzip" in request.headers.get("accept-encoding", ""):
        return Response(gzip.compress(text, 3), media_type="application/json", headers={"Content-Encoding": "gzip"})
    return Response(text, media_type="application/json")


def _page(name: str, **parts: object) -> str:
    import jinja2
    import markupsafe

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader("sbt.serve", "."), jinja2.PackageLoader("sbt.report", ".")]),
    )  # fmt: skip
    own = {key: markupsafe.Markup(files("sbt.serve").joinpath(file).read_text(encoding="utf-8")) for key, file in _OWN.items()}
    return environment.get_template(name).render(**own, **parts)

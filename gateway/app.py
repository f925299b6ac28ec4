"""The gateway's addresses, as an ASGI application."""

import asyncio
import importlib.resources
from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute

from daedalus.gateway.client_gateway import MAX_CLIENTS, Gateway
from daedalus.gateway.connection import ClientConnection
from daedalus.gateway.places import Places, most_connections
from daedalus.gateway.security import HEADERS, Guard
from daedalus.gateway.watching.page_data import PageData
from daedalus.gateway.watching.viewer import ViewerConnection

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


class Asset(NamedTuple):
    """One file."""

    content: bytes
    media_type: str


def read_assets() -> dict[str, Asset]:
    """Return the files of gateway/page by name."""
    found = {}
    for entry in importlib.resources.files("daedalus.gateway").joinpath("page").iterdir():
        media_type = _TYPES.get("." + entry.name.rpartition(".")[2])
        if media_type is not None:
            found[entry.name] = Asset(entry.read_bytes(), media_type)
    return found


_NO_CLIENTS = "this gateway serves its page only: start the run with --clients too, or a gateway of its own\n"

Application = Callable[[Any, Any, Any], Awaitable[None]]


def application(gateway: "asyncio.Future[Gateway]", guard: Guard, data: PageData) -> Application:
    """Return the application: every request passes the guard first.

    `gateway` has its result when the network is reached; clients wait for it.
    """
    places = Places(min(MAX_CLIENTS, most_connections() // 2), "clients")

    class Actor:
        """The WebSocket of one client."""

        async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
            if data.takes_clients:
                await ClientConnection(gateway, guard, places, scope, receive, send).serve()
            else:
                await PlainTextResponse(_NO_CLIENTS, 403)(scope, receive, send)

    class Watch:
        """The WebSocket of one page."""

        async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
            await ViewerConnection(data, guard, scope, receive, send).serve()

    assets = read_assets()

    async def asset(request: Request) -> Response:
        return _response(assets.get(request.path_params["name"]))

    async def run_page(request: Request) -> Response:
        return _response(assets["index.html"])

    async def play_page(request: Request) -> Response:
        return _response(assets["play.html"]) if data.takes_clients else PlainTextResponse(_NO_CLIENTS, 403)

    async def match_page(request: Request) -> Response:
        return _response(assets["match.html"])

    routes: list[BaseRoute] = [
        WebSocketRoute("/actor", Actor()),
        WebSocketRoute("/watch", Watch()),
        Route("/", run_page),
        Route("/play", play_page),
        Route("/match", match_page),
        Route("/page/{name}", asset),
        Route("/protocol.json", _protocol),
    ]
    return _Guarded(Starlette(routes=routes), guard)


def _response(asset: Asset | None) -> Response:
    if asset is None:
        return PlainTextResponse("there is no such page\n", 404)
    return Response(asset.content, media_type=asset.media_type)


async def _protocol(request: Request) -> Response:
    schema = importlib.resources.files("daedalus.gateway").joinpath("protocol.json").read_bytes()
    return Response(schema, media_type="application/schema+json")


class _Guarded:
    """Refuses requests, and adds the security headers to every answer."""

    def __init__(self, inner: Application, guard: Guard) -> None:
        self._inner, self._guard = inner, guard

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._inner(scope, receive, send)
            return

        async def send_with_headers(event: Any) -> None:
            if event["type"] in ("http.response.start", "websocket.http.response.start"):
                added = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
                event = {**event, "headers": [*event.get("headers", []), *added]}
            await send(event)

        refusal = self._guard.refusal(scope["headers"])
        if not refusal:
            await self._inner(scope, receive, send_with_headers if scope["type"] == "http" else send)
        else:
            await PlainTextResponse(refusal + "\n", 403)(scope, receive, send_with_headers)

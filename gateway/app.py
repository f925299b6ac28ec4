"""The gateway's addresses, as an ASGI application."""

import importlib.resources
from collections.abc import Awaitable, Callable
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute

from daedalus.gateway.connection import ClientConnection
from daedalus.gateway.gateway import Gateway
from daedalus.gateway.raw.endpoint import RawEndpoint
from daedalus.gateway.security import HEADERS, Guard

Application = Callable[[Any, Any, Any], Awaitable[None]]


def application(gateway: Gateway, raw: RawEndpoint, guard: Guard) -> Application:
    """Return the application: every request passes the guard first."""

    class Actor:
        """The WebSocket of one client."""

        async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
            await ClientConnection(gateway, guard, scope, receive, send).serve()

    class Raw:
        """The WebSocket of one client that runs the policy itself."""

        async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
            await raw.serve(scope, receive, send)

    routes: list[BaseRoute] = [
        WebSocketRoute("/actor", Actor()),
        WebSocketRoute("/raw", Raw()),
        Route("/protocol.json", _protocol),
    ]
    return _Guarded(Starlette(routes=routes), guard)


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

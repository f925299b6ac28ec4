"""The packages that a gateway needs."""

GATEWAY_PACKAGES = ("starlette", "uvicorn", "websockets")
INSTALL = 'the gateway needs starlette, uvicorn and websockets: pip install "daedalus-rl[gateway]"'

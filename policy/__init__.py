"""The network and its forward pass, both ways: torch for learning, a program with numpy around it for acting."""

import os

# onnxruntime would tell its makers of every process that imports it.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

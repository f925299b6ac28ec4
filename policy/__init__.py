"""The policy network: in torch for learning, as an exported ONNX program for acting."""

import os

# Otherwise onnxruntime sends telemetry from every process that imports it.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

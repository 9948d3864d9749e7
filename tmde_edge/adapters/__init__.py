"""Hardware and runtime libraries behind small interfaces."""

from __future__ import annotations

import os

# ONNX Runtime reports to its makers as soon as a session starts; its API alone does not stop the first
# report. It reads this before it starts, so it stands here, above every adapter.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"

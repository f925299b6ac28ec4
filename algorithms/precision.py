"""Choice of mixed precision. bfloat16 is faster for convolutions on hardware that multiplies it natively."""

from pathlib import Path
from typing import Literal

import torch


def autocast(
    precision: Literal["auto", "float32", "bfloat16"], device: torch.device, convolutional: bool
) -> torch.autocast:
    """Return the context for forward passes, with mixed precision if it is requested or known to be faster.

    "auto" enables bfloat16 for a convolutional network on a device that multiplies bfloat16 in hardware.
    """
    enabled = precision == "bfloat16" or (precision == "auto" and convolutional and _multiplies_bfloat16(device))
    # Enter the context for each forward pass: its cache of cast weights must not survive an update of the weights.
    return torch.autocast(device.type, torch.bfloat16, enabled=enabled)


def _multiplies_bfloat16(device: torch.device) -> bool:
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    try:
        flags = Path("/proc/cpuinfo").read_text("utf-8")
    except OSError:
        return False
    return "avx512_bf16" in flags or "amx_bf16" in flags

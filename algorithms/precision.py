"""Choice of mixed precision. bfloat16 is faster for convolutions on hardware that multiplies it natively."""

from pathlib import Path
from typing import Literal

import torch


def is_mixed(precision: Literal["auto", "float32", "bfloat16"], device: torch.device, convolutional: bool) -> bool:
    """Return whether forward passes compute in bfloat16: if it is requested or known to be faster.

    "auto" means bfloat16 for a convolutional network on a device that multiplies bfloat16 in hardware.
    """
    return precision == "bfloat16" or (precision == "auto" and convolutional and _multiplies_bfloat16(device))


def _multiplies_bfloat16(device: torch.device) -> bool:
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    try:
        flags = Path("/proc/cpuinfo").read_text("utf-8")
    except OSError:
        return False
    return "avx512_bf16" in flags or "amx_bf16" in flags

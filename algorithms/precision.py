"""Where bfloat16 pays: convolutions on processors and accelerators that multiply it in hardware."""

from pathlib import Path
from typing import Literal

import torch


def autocast(
    precision: Literal["auto", "float32", "bfloat16"], device: torch.device, convolutional: bool
) -> torch.autocast:
    """The context for forward passes: mixed precision where it was asked for, or where it is known to be faster."""
    enabled = precision == "bfloat16" or (precision == "auto" and convolutional and _multiplies_bfloat16(device))
    # The cache of cast weights would outlive the update that made them stale, were the context entered only once.
    return torch.autocast(device.type, torch.bfloat16, enabled=enabled)


def _multiplies_bfloat16(device: torch.device) -> bool:
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    try:
        flags = Path("/proc/cpuinfo").read_text("utf-8")
    except OSError:
        return False
    return "avx512_bf16" in flags or "amx_bf16" in flags

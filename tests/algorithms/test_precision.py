"""algorithms/gradients.py: which devices are known to be faster with bfloat16."""

import pytest
import torch

from daedalus.algorithms.gradients import is_mixed


@pytest.mark.parametrize("in_hardware", [True, False])
def test_auto_is_bfloat16_on_a_gpu_that_multiplies_it_in_hardware(
    in_hardware: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every recent GPU can at least emulate it, which is slower than float32."""
    monkeypatch.setattr(
        torch.cuda, "is_bf16_supported", lambda including_emulation=True: in_hardware or including_emulation
    )
    gpu = torch.device("cuda")
    assert is_mixed("auto", gpu, convolutional=True) == in_hardware
    assert not is_mixed("auto", gpu, convolutional=False)
    assert is_mixed("bfloat16", gpu, convolutional=False)
    assert not is_mixed("float32", gpu, convolutional=True)

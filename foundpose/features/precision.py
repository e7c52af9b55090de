"""Which precision a network runs in, and what the processor is good at."""

import warnings
from typing import Literal, get_args

import torch
from torch import nn

Precision = Literal["auto", "bf16", "fp16", "int8"]
_AUTOCAST: dict[str, torch.dtype] = {"bf16": torch.bfloat16, "fp16": torch.float16}
# Instructions that multiply bfloat16 matrices.
_BFLOAT16_INSTRUCTIONS = {"amx_bf16", "avx512_bf16"}


def check_precision(precision: str | None) -> None:
    """Raise ValueError for a precision that is none of None, 'auto', 'bf16', 'fp16' and 'int8'."""
    if precision is not None and precision not in get_args(Precision):
        raise ValueError(f"precision must be None, 'auto', 'bf16', 'fp16' or 'int8', got {precision!r}")


def autocast_precision(precision: str | None, device: torch.device) -> str | None:
    """What a network runs in on a device: ``precision`` itself, with "auto" resolved.

    "auto" is bf16 on GPUs of compute capability 8.0 or more (Ampere and later) and on CPUs with instructions for it
    (AVX512-BF16, AMX), fp16 on GPUs of 7.x, whose tensor cores have no bf16, and None elsewhere.
    """
    if precision != "auto":
        return precision
    if device.type == "cuda":
        major, _ = torch.cuda.get_device_capability(device)
        return "bf16" if major >= 8 else "fp16" if major >= 7 else None
    return "bf16" if has_fast_bfloat16(device) else None


def autocast_dtype(precision: str | None, device: torch.device) -> torch.dtype | None:
    """Type for autocast on a device; None for no autocast.

    With "auto" a forward pass whose gradient may be asked for runs in the weights' own precision: only inference
    gains.
    """
    if precision == "auto" and torch.is_grad_enabled():
        return None
    resolved = autocast_precision(precision, device)
    return None if resolved is None else _AUTOCAST.get(resolved)


def quantize_linear_layers(model: nn.Module) -> None:
    """Let the linear layers of a network in float32 on the CPU multiply 8-bit integers; no gradient is left.

    Weights get one scale for each layer, inputs one for each call (PyTorch's dynamic quantisation).
    """
    from torch.ao.quantization import quantize_dynamic

    with warnings.catch_warnings():  # both the function and its tensors are to move to another package
        warnings.simplefilter("ignore")
        quantize_dynamic(model, {nn.Linear}, dtype=torch.qint8, inplace=True)


def has_fast_bfloat16(device: torch.device) -> bool:
    """Whether a CPU multiplies bfloat16 matrices in hardware; False for all other devices."""
    return (
        device.type == "cpu"
        and torch.backends.mkldnn.is_available()
        and not _BFLOAT16_INSTRUCTIONS.isdisjoint(cpu_instructions())
    )


def cpu_instructions() -> set[str]:
    """Extensions of the CPU's instruction set; none where torch is too old to tell them."""
    tell = getattr(torch.cpu, "get_capabilities", dict)
    return {name for name, has in tell().items() if has is True}

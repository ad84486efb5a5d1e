"""Which precision of matrix products is fast on a device."""

from __future__ import annotations

import torch

from torchrl_rad.modules.frozen import can_pack

__all__ = ["planning_dtype", "uses_bf16"]


def uses_bf16(precision: str, device: str | torch.device = "cpu") -> bool:
    """Whether to train under bfloat16 autocast.

    Args:
        precision (str): ``"bf16"``, ``"fp32"``, or ``"auto"``: where products of bfloat16 matrices
            are faster than of float32, which is on CUDA and on CPUs with AMX.
        device (str, optional): Defaults to ``"cpu"``.

    Raises:
        ValueError: another precision.

    Examples:
        >>> uses_bf16("fp32"), uses_bf16("bf16")
        (False, True)
    """
    if precision not in ("auto", "bf16", "fp32"):
        raise ValueError(f"precision is {precision!r}; expected 'auto', 'bf16' or 'fp32'.")
    if precision != "auto":
        return precision == "bf16"
    if torch.device(device).type == "cuda":
        return torch.cuda.is_bf16_supported()
    supported = getattr(torch.cpu, "_is_amx_tile_supported", None)  # not public, so it may go
    return bool(supported and supported())


def planning_dtype(
    precision: str = "auto", device: str | torch.device = "cpu"
) -> torch.dtype | None:
    """Precision of autocast in which a planner decides; None for float32.

    Args:
        precision (str, optional): ``"bf16"``, ``"fp16"``, ``"fp32"``, or ``"auto"``: bfloat16 as of
            :func:`uses_bf16`; on other CPUs float16 where they can read weights of it, of which a
            decision for few environments waits for half as long.
        device (str, optional): Defaults to ``"cpu"``.

    Raises:
        ValueError: another precision.

    Examples:
        >>> planning_dtype("fp16"), planning_dtype("fp32")
        (torch.float16, None)
    """
    if precision == "fp16":
        return torch.float16
    if uses_bf16(precision, device):
        return torch.bfloat16
    packs = torch.device(device).type == "cpu" and can_pack(torch.float16)
    return torch.float16 if precision == "auto" and packs else None

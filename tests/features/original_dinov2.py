"""DINOv2's forward pass in plain torch on a state dictionary with the original key names.

Written from the architecture's definition (pre-norm transformer, LayerScale, registers behind the cls token),
as an independent reference for the conversion of checkpoints.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

MEAN = torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)
STD = torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1)


def random_state(
    width: int, depth: int, grid: int, registers: int, swiglu: bool, seed: int = 0
) -> dict[str, Tensor]:
    """Random weights of which each has an effect (biases and scales too)."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int, std: float = 0.3, mean: float = 0.0) -> Tensor:
        return mean + std * torch.randn(*shape, generator=g)

    state = {
        "cls_token": normal(1, 1, width),
        "mask_token": normal(1, width),
        "pos_embed": normal(1, 1 + grid * grid, width),
        "patch_embed.proj.weight": normal(width, 3, 14, 14, std=0.05),
        "patch_embed.proj.bias": normal(width),
        "norm.weight": normal(width, mean=1.0),
        "norm.bias": normal(width),
    }
    if registers:
        state["register_tokens"] = normal(1, registers, width)
    hidden = 4 * width
    for k in range(depth):
        block = {
            "attn.qkv.weight": normal(3 * width, width),
            "attn.qkv.bias": normal(3 * width),
            "attn.proj.weight": normal(width, width),
            "attn.proj.bias": normal(width),
        }
        for name in ("norm1", "norm2"):
            block[f"{name}.weight"] = normal(width, mean=1.0)
            block[f"{name}.bias"] = normal(width)
        for name in ("ls1", "ls2"):
            block[f"{name}.gamma"] = normal(width)
        if swiglu:
            inner = (int(hidden * 2 / 3) + 7) // 8 * 8
            shapes = {"w12": (2 * inner, width), "w3": (width, inner)}
        else:
            shapes = {"fc1": (hidden, width), "fc2": (width, hidden)}
        for name, shape in shapes.items():
            block[f"mlp.{name}.weight"] = normal(*shape)
            block[f"mlp.{name}.bias"] = normal(shape[0])
        state |= {f"blocks.{k}.{name}": value for name, value in block.items()}
    return state


def position_embeddings(state: dict[str, Tensor], grid: int, registers: int) -> Tensor:
    embed = state["pos_embed"]
    n = int((embed.shape[1] - 1) ** 0.5)
    if n == grid:
        return embed
    image = embed[:, 1:].reshape(1, n, n, -1).permute(0, 3, 1, 2)
    if registers:
        image = F.interpolate(image, size=(grid, grid), mode="bicubic", antialias=True)
    else:
        scale = (grid + 0.1) / n
        image = F.interpolate(image, scale_factor=(scale, scale), mode="bicubic")
        assert image.shape[-1] == grid
    return torch.cat([embed[:, :1], image.permute(0, 2, 3, 1).reshape(1, grid * grid, -1)], dim=1)


def forward(
    state: dict[str, Tensor], images: Tensor, heads: int, last_block: int, final_norm: bool
) -> tuple[Tensor, Tensor]:
    """Patch tokens (B, C, h, w) and cls tokens (B, C) after block ``last_block``."""
    registers = state["register_tokens"].shape[1] if "register_tokens" in state else 0
    batch, grid = images.shape[0], images.shape[-1] // 14

    def linear(x: Tensor, name: str) -> Tensor:
        return x @ state[f"{name}.weight"].T + state[f"{name}.bias"]

    def norm(x: Tensor, name: str) -> Tensor:
        x = (x - x.mean(-1, keepdim=True)) / (x.var(-1, keepdim=True, correction=0) + 1e-6).sqrt()
        return x * state[f"{name}.weight"] + state[f"{name}.bias"]

    # patch embedding: one product of each 14 × 14 patch with the kernel
    patches = ((images - MEAN) / STD).unfold(2, 14, 14).unfold(3, 14, 14)
    x = torch.einsum("bchwyx,dcyx->bhwd", patches, state["patch_embed.proj.weight"]).flatten(1, 2)
    x = x + state["patch_embed.proj.bias"]
    x = torch.cat([state["cls_token"].expand(batch, -1, -1), x], dim=1)
    x = x + position_embeddings(state, grid, registers)
    if registers:
        x = torch.cat([x[:, :1], state["register_tokens"].expand(batch, -1, -1), x[:, 1:]], dim=1)

    for k in range(last_block + 1):
        block = f"blocks.{k}"
        q, key, v = linear(norm(x, f"{block}.norm1"), f"{block}.attn.qkv").chunk(3, dim=-1)
        q, key, v = (t.unflatten(-1, (heads, -1)).transpose(1, 2) for t in (q, key, v))
        weights = (q @ key.transpose(-1, -2) / q.shape[-1] ** 0.5).softmax(-1)
        attended = linear((weights @ v).transpose(1, 2).flatten(2), f"{block}.attn.proj")
        x = x + state[f"{block}.ls1.gamma"] * attended
        y = norm(x, f"{block}.norm2")
        if f"{block}.mlp.w12.weight" in state:
            gate, value = linear(y, f"{block}.mlp.w12").chunk(2, dim=-1)
            y = linear(gate * gate.sigmoid() * value, f"{block}.mlp.w3")
        else:
            y = linear(y, f"{block}.mlp.fc1")
            y = linear(0.5 * y * (1 + torch.erf(y / 2**0.5)), f"{block}.mlp.fc2")
        x = x + state[f"{block}.ls2.gamma"] * y

    if final_norm:
        x = norm(x, "norm")
    patches = x[:, 1 + registers :].transpose(1, 2).unflatten(2, (grid, grid))
    return patches, x[:, 0]

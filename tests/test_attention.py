"""Attention by blocks of queries in 16 bits, against a slow one in 64 and against PyTorch's fused kernel."""

import pytest
import torch
import torch.nn.functional as F

from lidargrit.nn.transformer import CausalTransformer, TransformerConfig, attend


def by_definition(query, key, value, causal):
    scores = query @ key.mT / query.shape[-1] ** 0.5
    if causal:
        scores = scores.masked_fill(torch.ones_like(scores, dtype=torch.bool).triu(1), -torch.inf)
    return scores.softmax(-1) @ value


def fused(query, key, value, causal):
    return F.scaled_dot_product_attention(query, key, value, is_causal=causal)


def mixed_and_gradients(attention, tensors, causal, dtype):
    """Return the mixed values, and the gradients of their product with fixed random numbers, in 64 bits."""
    leaves = [tensor.to(dtype).requires_grad_() for tensor in tensors]
    mixed = attention(*leaves, causal=causal)
    weights = torch.randn(mixed.shape, generator=torch.Generator().manual_seed(1))
    (mixed.double() * weights).sum().backward()
    return [mixed.detach().double(), *(leaf.grad.double() for leaf in leaves)]


def heads(length, dtype=torch.bfloat16):
    rng = torch.Generator().manual_seed(length)
    return [torch.randn(2, 3, length, 16, generator=rng).to(dtype) for _ in range(3)]


@pytest.mark.parametrize("causal", [True, False])
@pytest.mark.parametrize("length", [1, 7, 128, 129, 300])
def test_blocks_in_16_bits_are_as_near_as_the_fused_kernel(length, causal):
    tensors = heads(length)
    exact = mixed_and_gradients(by_definition, tensors, causal, torch.float64)
    ours = mixed_and_gradients(attend, tensors, causal, torch.bfloat16)
    kernel = mixed_and_gradients(fused, tensors, causal, torch.bfloat16)
    for wanted, got, of_kernel in zip(exact, ours, kernel, strict=True):
        scale = wanted.norm() + 1e-9
        assert float((got - wanted).norm() / scale) < 2 * float((of_kernel - wanted).norm() / scale) + 1e-3


def test_a_token_sees_none_after_it():
    query, key, value = heads(300)
    changed_key, changed_value = key.clone(), value.clone()
    changed_key[:, :, 130:], changed_value[:, :, 130:] = 5.0, 5.0
    before, after = attend(query, key, value, causal=True), attend(query, changed_key, changed_value, causal=True)
    assert torch.equal(before[:, :, :130], after[:, :, :130])
    assert not torch.equal(before[:, :, 130:], after[:, :, 130:])


def test_32_bits_and_long_sequences_take_the_fused_kernel():
    query, key, value = heads(64, torch.float32)
    assert torch.equal(attend(query, key, value, causal=True), fused(query, key, value, True))
    query, key, value = heads(1030)
    assert torch.equal(attend(query, key, value, causal=True), fused(query, key, value, True))


def test_a_transformer_keeps_16_bits_under_autocast(monkeypatch):
    torch.manual_seed(0)
    transformer = CausalTransformer(
        TransformerConfig(layers=2, heads=4, width=32), num_tokens=20, grid_size=(1, 200)
    ).eval()
    torch.nn.init.normal_(transformer.head.weight, std=0.5)
    tokens = torch.randint(20, (2, 200))
    transformer.requires_grad_(False)
    exact = transformer(tokens)
    monkeypatch.setattr(F, "scaled_dot_product_attention", None)  # whoever calls it fails
    with torch.autocast("cpu", torch.bfloat16):
        mixed = transformer(tokens)
    assert mixed.dtype == torch.bfloat16
    assert float((mixed.float() - exact).norm() / exact.norm()) < 0.02

"""Sequences generated token by token by a transformer, with a cache of keys and values.

The transformer itself reads whole sequences, for training and for likelihoods. Here its weights are laid out for one
token at a time, and a step takes few operations: query, key and value come from one product, the cache is allocated
once, and residuals are added in place. In 32 bits the result is the transformer's own but for rounding.
"""

import copy
import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from lidargrit.core.errors import ConfigError
from lidargrit.nn.transformer import CausalTransformer

_SHARED_FROM_FLOPS = 1e8  # a step of the packaged model for 8 scans has 6.7e7: two threads save it a tenth of its time


@contextmanager
def threads_for(step_flops: int) -> Iterator[None]:
    """Compute with one thread meanwhile if steps are small and torch's threads spin while they wait for one another.

    Beside other work a thread that spins takes the processor from the very thread that it waits for, a hundred times a
    step. The command ``lidargrit`` lets threads sleep; other programs that load torch mostly do not, and OpenMP reads
    its variables only once.
    """
    threads = torch.get_num_threads()
    sleeps = os.environ.get("OMP_WAIT_POLICY", "").upper() == "PASSIVE"
    if sleeps or threads == 1 or step_flops >= _SHARED_FROM_FLOPS:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


WeightPrecision = Literal["fp32", "bf16", "int8"]
SampleToken = Callable[[Tensor, Tensor], Tensor]

_POSITIONS_PER_GRAPH = 128  # with static shapes, attention reads a multiple of it: 8 graphs for 1,024 tokens


class CachedDecoder:
    """Generates the tokens of whole scans, ``batch_size`` at once, from one set of weights.

    Args:
        transformer: transformer in evaluation mode; later changes of its weights may have no effect here.
        batch_size: number of sequences.
        sample_token: function of logits (B, K) and uniform numbers (B,) that returns tokens (B,).
        start: token before the first one.
        precision: number type. ``fp32`` gives the logits of the transformer that reads the whole prefix for every
            token. ``bf16`` keeps weights, activations and cache in 16 bits. ``int8`` keeps the weights of the blocks in
            8 bits, with one scale a row, and the rest in 16; only on CPUs.
        static: whether shapes stay the same from token to token, so that a GPU can replay recorded CUDA graphs; by
            default only on a GPU.
        guidance: weight w of logits weaker + w (own - weaker), where the weaker ones are those of the same transformer
            without the attention of its last block but one, or of its only one; 1 gives the transformer's own logits.
    """

    def __init__(
        self,
        transformer: CausalTransformer,
        batch_size: int,
        sample_token: SampleToken,
        start: int = 0,
        precision: WeightPrecision = "fp32",
        static: bool | None = None,
        guidance: float = 1.0,
    ) -> None:
        self._device = transformer.pos_emb.device
        if precision == "int8" and self._device.type != "cpu":
            raise ConfigError(f"8-bit weights on {self._device.type}", "a CPU", "use bf16 there")
        self._sample_token, self._start, self._length = sample_token, start, transformer.context_length
        self._static = self._device.type == "cuda" if static is None else static
        dtype = torch.float32 if precision == "fp32" else torch.bfloat16
        heads, width = transformer.config.heads, transformer.config.width
        self._windows, self._positions_of = transformer.windows, transformer.positions
        embedding = transformer.embedding().detach()
        self._embedding = embedding.to(dtype)
        self._positions = transformer.positions().detach().to(dtype, copy=True)
        self._around = transformer.around
        self._places = torch.empty(0) if self._around is None else self._around.places(None).clone()
        tables = None if self._around is None else self._around.tables(embedding).detach()
        self._tables = torch.empty(0) if tables is None else tables.to(dtype)
        self._blocks = [_Block(block, heads, precision) for block in transformer.blocks]
        self._guidance, self._weaker = guidance, self._blocks[-2:] if guidance != 1 else []
        self._last_norm = _norm(transformer.ln_f, dtype)
        self._head = copy.deepcopy(transformer.head).requires_grad_(False).to(dtype)
        # Layer, key or value, sequence and head, position, number: a step writes one position of all layers, the weaker
        # transformer's own last one behind those of all blocks.
        layers = len(self._blocks) + len(self._weaker[1:])
        size = (layers, 2, batch_size * heads, self._length, width // heads)
        self._cache = torch.zeros(size, dtype=dtype, device=self._device)
        self._slots = self._cache.unflatten(2, (batch_size, heads))
        fused = torch.zeros(batch_size, 3 * width, dtype=dtype, device=self._device)
        self._fused, self._query = fused, fused[:, :width].view(batch_size, heads, 1, width // heads)
        self._newest = fused[:, width:].view(batch_size, 2, heads, width // heads).transpose(0, 1)
        self._tokens = torch.zeros(batch_size, dtype=torch.long, device=self._device)
        self._generated = torch.zeros(batch_size, self._length, dtype=torch.long, device=self._device)
        self._uniform = torch.zeros(batch_size, self._length, device=self._device)
        self._observed = torch.full_like(self._generated, -1)
        self._position = torch.zeros(1, dtype=torch.long, device=self._device)
        self._graphs: dict[int, Callable[[], None]] = {}
        self._step_flops = batch_size * flops_of_step(transformer, 0, guidance)

    @torch.inference_mode(False)  # its tensors are written to in later calls, which may be outside of it
    @torch.no_grad()
    def generate(self, uniform: Float[Tensor, "B T"], observed: Int[Tensor, "B T"] | None = None) -> Int[Tensor, "B T"]:
        """Generate the tokens of one scan, row by row, for each row of uniform numbers in [0, 1), one number a token.

        Args:
            uniform: one random number for each token.
            observed: tokens that stand already, and -1 where one is to be generated; later tokens know of them.
        """
        observed = torch.full_like(uniform, -1, dtype=torch.long) if observed is None else observed
        if self._windows is None:
            return self._sequence(uniform, observed)
        chances, found = (each.unflatten(1, self._windows.grid_size) for each in (uniform, observed.clone()))
        for columns, known in self._windows.in_turn():
            self._positions.copy_(self._positions_of(columns))
            if self._around is not None:
                self._places.copy_(self._around.places(columns))
            inputs = (self._windows.take(each, columns) for each in (chances, found))
            tokens = self._sequence(*inputs, known=known * self._windows.grid_size[0])
            found[:, :, columns] = tokens.unflatten(1, (len(columns), -1)).transpose(1, 2)
        return found.flatten(1)

    def _sequence(
        self, uniform: Float[Tensor, "B T"], observed: Int[Tensor, "B T"], known: int = 0
    ) -> Int[Tensor, "B T"]:
        """Generate one sequence; of the first ``known`` tokens, which are all observed, the cache is filled at once."""
        length = uniform.shape[1]
        if self._static:
            self._record_graphs(length)
            self._uniform[:, :length], self._observed[:, :length] = uniform, observed
            self._begin(observed[:, :known])
            for step in range(known, length):
                self._graphs[step // _POSITIONS_PER_GRAPH]()
        else:
            with threads_for(self._step_flops):
                self._begin(observed[:, :known])
                for step in range(known, length):
                    chosen = self._sample_token(self.next_logits(self._tokens, step), uniform[:, step])
                    self._tokens = torch.where(observed[:, step] < 0, chosen, observed[:, step])
                self._generated[:, length - 1] = self._tokens
        return self._generated[:, :length].clone()

    def _begin(self, known: Int[Tensor, "B N"]) -> None:
        """Go to the position after the first tokens, whose keys and values are written into the cache at once."""
        count = known.shape[1]
        self._position.fill_(count)
        if not count:
            self._tokens.fill_(self._start)
            return
        self._generated[:, :count] = known
        self._tokens.copy_(known[:, -1])
        read = F.pad(known[:, :-1], (1, 0), value=self._start)
        x = F.embedding(read, self._embedding) + self._positions[:count]
        if self._around is not None:
            x = x + self._around.added(self._around.around(read, self._places), self._tables)

        def attended(layer: int, block: _Block, x: Tensor) -> Tensor:
            parts = block.query_key_value(block.norm1(x), None).unflatten(0, (-1, count))
            query, key, value = parts.unflatten(-1, (3, self._query.shape[1], -1)).permute(2, 0, 3, 1, 4)
            self._slots[layer, :, :, :, :count] = torch.stack((key, value))
            mixed = F.scaled_dot_product_attention(query, key, value, is_causal=True, scale=1.0)
            return mixed.transpose(1, 2).flatten(2).flatten(0, 1)

        self._through_blocks(x.flatten(0, 1), attended)

    @torch.no_grad()
    def next_logits(self, tokens: Int[Tensor, "B"], position: int) -> Float[Tensor, "B K"]:
        """Return the logits after a token at a position, whose predecessors were given by earlier calls."""
        slots = self._slots[:, :, :, :, position].unbind()

        def write_cache(layer: int) -> None:
            slots[layer].copy_(self._newest)

        if position:
            self._generated[:, position - 1] = tokens
        x = self._embedded(tokens, lambda of_positions: of_positions[position])
        return self._logits(x, self._cache[:, :, :, : position + 1], write_cache)

    def _embedded(self, tokens: Int[Tensor, "B"], at: Callable[[Tensor], Tensor]) -> Float[Tensor, "B C"]:
        """Return the sum of what the previous token, the position and the tokens around it are embedded as.

        Args:
            tokens: previous token of each sequence.
            at: returns what a table over positions, its first axis, has at the present one.
        """
        x = F.embedding(tokens, self._embedding) + at(self._positions)
        if self._around is None:
            return x
        places = at(self._places)  # counted from the start token; the last is none
        around = F.pad(self._generated, (1, 0)).index_select(1, places)
        around = torch.where(places < self._length, around, -1)
        return x + self._around.added(around, self._tables)

    def _logits(
        self, x: Tensor, past: Tensor, write_cache: Callable[[int], None], future: Tensor | None = None
    ) -> Tensor:
        keys, values = (each.unbind() for each in past.unflatten(2, self._query.shape[:2]).unbind(1))

        def attended(layer: int, block: _Block, x: Tensor) -> Tensor:
            block.query_key_value(block.norm1(x), self._fused)
            write_cache(layer)
            return _attend(self._query, keys[layer], values[layer], future).view_as(x)

        x, weaker = self._through_blocks(x, attended)
        if not self._weaker:
            return self._head_logits(x)
        return torch.lerp(self._head_logits(weaker), self._head_logits(x), self._guidance)

    def _through_blocks(
        self, x: Float[Tensor, "N C"], attended: "Callable[[int, _Block, Tensor], Tensor]"
    ) -> tuple[Float[Tensor, "N C"], Float[Tensor, "N C"]]:
        """Return the output of all blocks, and of the weaker transformer's, if there is one.

        Args:
            attended: returns what a block's attention finds; it writes keys and values into the cache of a layer.
        """
        weaker = x
        for layer, block in enumerate(self._blocks):
            if layer == len(self._blocks) - len(self._weaker):
                weaker = x.clone()
            x.add_(block.proj(attended(layer, block, x), None))
            block.add_perceptron(x)
        if self._weaker:
            self._weaker[0].add_perceptron(weaker)
        for layer, block in enumerate(self._weaker[1:], start=len(self._blocks)):
            weaker.add_(block.proj(attended(layer, block, weaker), None))
            block.add_perceptron(weaker)
        return x, weaker

    def _head_logits(self, x: Tensor) -> Tensor:
        return self._head(self._last_norm(x)).float()

    def _static_step(self, num_positions: int) -> None:
        """Generate the token at the position that a tensor holds, and advance it; no shape depends on the position."""
        slots = self._slots.unbind()

        def write_cache(layer: int) -> None:
            slots[layer].index_copy_(3, self._position, self._newest.unsqueeze(3))

        x = self._embedded(self._tokens, lambda of_positions: of_positions.index_select(0, self._position)[0])
        future = torch.arange(num_positions, device=self._device) > self._position
        logits = self._logits(x, self._cache[:, :, :, :num_positions], write_cache, future)
        chosen = self._sample_token(logits, self._uniform.index_select(1, self._position)[:, 0])
        observed = self._observed.index_select(1, self._position)[:, 0]
        chosen = torch.where(observed < 0, chosen, observed)
        self._tokens.copy_(chosen)
        self._generated.index_copy_(1, self._position, chosen[:, None])
        self._position.add_(1)

    def _record_graphs(self, length: int) -> None:
        for index in range(len(self._graphs), math.ceil(length / _POSITIONS_PER_GRAPH)):
            num_positions = min((index + 1) * _POSITIONS_PER_GRAPH, self._length)
            if self._device.type != "cuda":
                self._graphs[index] = lambda num_positions=num_positions: self._static_step(num_positions)
                continue
            stream, graph = torch.cuda.Stream(), torch.cuda.CUDAGraph()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):  # once outside of the graph, so that libraries take their workspaces
                self._begin(self._observed[:, :0])
                self._static_step(num_positions)
            torch.cuda.current_stream().wait_stream(stream)
            self._begin(self._observed[:, :0])
            with torch.cuda.graph(graph):
                self._static_step(num_positions)
            self._graphs[index] = graph.replay


def flops_of_step(transformer: CausalTransformer, position: int, guidance: float = 1.0) -> int:
    """Return the operations that the token at a position of one sequence takes, with a cache."""
    layers, width = transformer.config.layers, transformer.config.width
    perceptron, head = 16 * width**2, transformer.head.flops
    # Four projections, queries by keys, and weights by values.
    block = 8 * width**2 + 4 * width * (position + 1) + perceptron
    flops = layers * block + head
    return flops if guidance == 1 else flops + perceptron + min(layers - 1, 1) * block + head


class _Block:
    """The weights of one block, laid out for single tokens; those of the query hold the scale of attention."""

    def __init__(self, block: nn.Module, heads: int, precision: WeightPrecision) -> None:
        attention, perceptron = block.get_submodule("attn"), block.get_submodule("mlp")
        query, key, value, proj = (_weights(attention, name) for name in ("query", "key", "value", "proj"))
        scale = 1 / math.sqrt(query[0].shape[0] // heads)
        weight = torch.cat((query[0] * scale, key[0], value[0]))
        self.query_key_value = _product(weight, torch.cat((query[1] * scale, key[1], value[1])), precision)
        self.proj = _product(*proj, precision)
        self.expand, self.contract = (_product(*_weights(perceptron, name), precision) for name in ("0", "2"))
        dtype = torch.float32 if precision == "fp32" else torch.bfloat16
        self.norm1, self.norm2 = (_norm(block.get_submodule(name), dtype) for name in ("ln1", "ln2"))

    def add_perceptron(self, x: Tensor) -> None:
        x.add_(self.contract(F.gelu(self.expand(self.norm2(x), None)), None))


def _weights(parent: nn.Module, name: str) -> tuple[Tensor, Tensor]:
    linear = parent.get_submodule(name)
    return linear.get_parameter("weight").detach(), linear.get_parameter("bias").detach()


def _norm(norm: nn.Module, dtype: torch.dtype) -> Callable[[Tensor], Tensor]:
    weight, bias = norm.get_parameter("weight").detach().to(dtype), norm.get_parameter("bias").detach().to(dtype)
    return lambda x: torch.layer_norm(x, weight.shape, weight, bias)


def _product(weight: Tensor, bias: Tensor, precision: WeightPrecision) -> Callable[[Tensor, Tensor | None], Tensor]:
    """Return a function that computes x @ weight.T + bias, into a given tensor or a new one."""
    if precision == "int8":
        scale = weight.abs().amax(dim=1).clamp(min=1e-12) / 127
        rounded, scale, bias = (weight / scale[:, None]).round().to(torch.int8), scale.bfloat16(), bias.bfloat16()
        return lambda x, out: torch.add(torch.ops.aten._weight_int8pack_mm(x, rounded, scale), bias, out=out)
    if precision == "bf16" and weight.device.type == "cpu" and torch.ops.mkldnn._is_mkldnn_bf16_supported():
        # In the order in which oneDNN reads them, half the time of a plain product at 16 sequences.
        packed, bias = torch.ops.mkldnn._reorder_linear_weight(weight.bfloat16()), bias.bfloat16()
        multiply = partial(torch.ops.mkldnn._linear_pointwise, W=packed, B=bias, attr="none", scalars=[], algorithm="")
        return lambda x, out: multiply(x) if out is None else out.copy_(multiply(x))
    dtype = torch.float32 if precision == "fp32" else torch.bfloat16
    columns, bias = weight.to(dtype).T, bias.to(dtype)
    return lambda x, out: torch.addmm(bias, x, columns, out=out)


def _attend(query: Tensor, keys: Tensor, values: Tensor, future: Tensor | None) -> Tensor:
    """Return the attention (B, heads, 1, d) of one query, which holds the scale already."""
    if query.dtype != torch.float32:
        return F.scaled_dot_product_attention(query, keys, values, None if future is None else ~future[None], scale=1.0)
    fit = query @ keys.transpose(2, 3)  # for a single query in 32 bits two products beat the fused kernel on CPUs
    return (fit if future is None else fit.masked_fill_(future, -torch.inf)).softmax(dim=-1) @ values

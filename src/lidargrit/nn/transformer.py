"""Transformers over tokens: causal ones predict the next token, masked ones the tokens that are hidden.

They read whole sequences; ``nn.decoding`` generates token by token with the same weights. Parameter names follow the
reference's state dict (a minGPT), so that published weights load.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Count, NotNegative, ShareBelow1
from lidargrit.nn.blocks import Block, Network
from lidargrit.nn.codes import CodeFeatures, CodeHead, GroupedCodeHead, SharedEmbedding
from lidargrit.nn.precision import as_in_products, without_autocast
from lidargrit.nn.windows import Windows

_QUERIES_AT_ONCE = 128  # their scores with all keys stay in a processor's cache
_KEYS_AT_MOST = 1024  # beyond, scores no longer fit the cache, and the memory for their gradients grows as the square


def attend(
    query: Float[Tensor, "B H T D"], key: Float[Tensor, "B H T D"], value: Float[Tensor, "B H T D"], *, causal: bool
) -> Float[Tensor, "B H T D"]:
    """Return softmax(query key' / sqrt(D)) value, of one sequence with itself.

    On a CPU in bfloat16, PyTorch's fused kernel computes a fifth as many operations a second as a matrix product does.
    There, products are computed block by block of queries, with scores in 16 bits, and sums of the softmax in 32:
    more than twice as fast for 256 tokens, forward and backward, and 1.2 to 1.8 times for 1,024 (measured in
    ``benchmarks/attention.py``).
    """
    length = query.shape[-2]
    if query.dtype != torch.bfloat16 or query.device.type != "cpu" or length > _KEYS_AT_MOST:
        return F.scaled_dot_product_attention(query, key, value, is_causal=causal)
    query = query * query.shape[-1] ** -0.5
    mixed = []
    with without_autocast(query.device):  # it would compute the softmax, and keep its result, in 32 bits
        for first in range(0, length, _QUERIES_AT_ONCE):
            last = min(first + _QUERIES_AT_ONCE, length)
            seen = last if causal else length
            scores = query[..., first:last, :] @ key[..., :seen, :].transpose(-1, -2)
            if causal:
                later = torch.full((last - first, seen), -torch.inf, dtype=scores.dtype, device=scores.device)
                scores = scores + later.triu(first + 1)
            mixed.append(scores.softmax(-1) @ value[..., :seen, :])
    return torch.cat(mixed, -2)


# Offsets to the tokens around a position: lines (rows of the grid, or columns of a window), then places within a line.
_AROUND = ((0, -2), (0, -3), *((-1, right) for right in range(-2, 3)), (-2, -1), (-2, 0), (-2, 1), (-3, 0))
_AHEAD = ((1, -1), (1, 0), (1, 1), (2, 0), (3, 0))  # where a scan ends, those of its beginning
_AROUND_IF_SHARED = 0.3  # of the usual first weights of the tokens around, since shared embeddings begin longer
_WINDOWS_AT_MOST = 64  # of a scan: beyond, each column is learned many times over
_LAYERS_AT_MOST = 1000  # of the largest language models about a hundred


@dataclass(frozen=True)
class TransformerConfig(Settings):
    """Sizes of the transformer; the defaults are the paper's for KITTI odometry.

    Args:
        layers: number of blocks.
        heads: number of attention heads in each block.
        width: length of the vector that stands for a token.
        embedding_dropout: probability of dropout on the embedded tokens.
        residual_dropout: probability of dropout on the output of each block's two branches.
        neighbours: whether a position also reads the tokens around it in the grid that come before it, where the paper
            gives it the previous token alone and leaves it to attention to learn where the row above lies.
        code_features: whether codes share weights by what they stand for, such as their range, so that a rare code is
            learned from those like it; first the range of a token is predicted, then the rest of its meaning. The
            tokenizer has to know what its codes stand for, as ``nearest_range`` does.
        window_columns: number of columns of tokens that are read at once, column by column, as the sensor turns; half
            of them go on from earlier ones. 0 reads whole scans, row by row, as in the paper.
        windows_per_scan: number of windows that a training reads of each scan. More of them spare loading scans, which
            takes a core some milliseconds; but those of one scan are alike, and teach less.
    """

    layers: Annotated[int, Bounds(1, _LAYERS_AT_MOST)] = 6
    heads: Count = 8
    width: Count = 256
    embedding_dropout: ShareBelow1 = 0.2
    residual_dropout: ShareBelow1 = 0.0
    neighbours: bool = False
    code_features: bool = False
    window_columns: NotNegative = 0
    windows_per_scan: Annotated[int, Bounds(1, _WINDOWS_AT_MOST)] = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.windows_per_scan > 1 and not self.window_columns:
            got = f"model.transformer.windows_per_scan={self.windows_per_scan} without windows"
            raise ConfigError(
                got, "model.transformer.window_columns, or 1", "add --set model.transformer.window_columns=32"
            )
        if self.width % self.heads:
            got = f"heads={self.heads}, width={self.width}"
            raise ConfigError(got, "a width that is a multiple of the heads", "change the width or the heads")


class Transformer(Network):
    """Pre-norm blocks, learned positions, exact GELU, an untied head, without bias unless codes share weights.

    Args:
        num_inputs: number of different tokens that it reads.
        num_tokens: number of different tokens that it predicts.
        context_length: number of tokens in the longest sequence.
        causal: whether a token attends only to itself and to those before it.
        code_features: meaning of every code, by which codes share weights; None where each has its own alone.

    Source:
        Haghighi et al., LidarGRIT, 2024, section 3.3; layers as in hamedhaghighi/LidarGRIT@a3f86e7.
    """

    def __init__(
        self,
        config: TransformerConfig,
        num_inputs: int,
        num_tokens: int,
        context_length: int,
        causal: bool,
        code_features: CodeFeatures | None = None,
    ) -> None:
        super().__init__()
        self.config, self.num_tokens, self.context_length = config, num_tokens, context_length
        self.tok_emb = nn.Embedding(num_inputs, config.width)
        self.pos_emb = nn.Parameter(torch.zeros(1, context_length, config.width))
        self.drop = nn.Dropout(config.embedding_dropout)
        self.blocks = nn.ModuleList(TransformerBlock(config, causal) for _ in range(config.layers))
        self.ln_f = nn.LayerNorm(config.width)
        self.head: CodeHead | GroupedCodeHead
        self.shared: SharedEmbedding | None = None
        if code_features is None:
            self.head = CodeHead(config.width, num_tokens)
        else:
            self.head = GroupedCodeHead(config.width, num_tokens, code_features.group_size)
            self.shared = SharedEmbedding(code_features.of_codes, config.width)
        self.apply(_initialise)

    def forward(self, tokens: Int[Tensor, "B T"]) -> Float[Tensor, "B T K"]:
        """Return the logits at each position: of the next token if causal, else of the position's own."""
        return self.head(self._read(F.embedding(tokens, self.embedding()) + self.pos_emb[:, : tokens.shape[1]]))

    def _read(self, x: Float[Tensor, "B T C"]) -> Float[Tensor, "B T C"]:
        x = self.drop(x)
        for block in self.blocks:
            x = block(x)
        return self.ln_f(x)

    def embedding(self) -> Float[Tensor, "N C"]:
        """Return the vector that stands for each token that is read."""
        own = self.tok_emb.weight
        return own if self.shared is None else own + self.shared()


class TokensAround(nn.Module):
    """What the tokens around a position add to its embedding, each by a linear map of its own.

    They are those beside it on the grid, up to three rows or columns away, that come before it in the sequence: in a
    window also the scan's first columns, where its last ones meet them. The next token depends on these most, and a
    short training finds that sooner than by attention over learned positions.

    Args:
        grid_size: rows and columns of the grid, whose tokens come row by row. In a window, whose tokens come column by
            column, these are its columns and rows.
        width: length of the vector that stands for a token.
        turn: number of columns of the whole grid, whose last lies beside the first, where sequences are windows of it;
            0 where the grid is one sequence, which turns within its rows.

    Source:
        van den Oord et al., Pixel Recurrent Neural Networks, 2016, for the neighbours that come before a pixel.
    """

    _offsets: Tensor
    _places: Tensor

    def __init__(self, grid_size: tuple[int, int], width: int, turn: int = 0) -> None:
        super().__init__()
        self._grid_size, self._turn = grid_size, turn
        offsets = torch.tensor(_AROUND + (_AHEAD if turn else ()))
        self.maps = nn.Parameter(torch.randn(len(offsets), width, width) * width**-0.5)
        self.register_buffer("_offsets", offsets, persistent=False)
        self.register_buffer("_places", self._places_in(torch.arange(grid_size[0])), persistent=False)

    def places(self, columns: Int[Tensor, "*B W"] | None) -> Int[Tensor, "*B T N"]:
        """Return of each position the places of its neighbours in a sequence that begins with the start token.

        A place beyond the sequence is none.

        Args:
            columns: numbers in the grid of the columns of windows; None where the grid is one sequence.
        """
        return self._places if columns is None else self._places_in(columns.to(self._places.device))

    def _places_in(self, lines: Int[Tensor, "*B L"]) -> Int[Tensor, "*B T N"]:
        length, across = self._grid_size
        on, right = self._offsets.unbind(1)
        wanted = lines[..., None] + on  # modulo a turn, which has at least 9 columns, no two of them are the same
        is_line = lines[..., None, None, :] == (wanted % self._turn if self._turn else wanted)[..., None]
        line = is_line.int().argmax(-1)  # in the sequence; any if there is none, which `found` tells
        found = is_line.any(-1) & ((on == 0) | (line < torch.arange(length, device=lines.device)[:, None]))
        other = torch.arange(across, device=lines.device)[:, None] + right
        beyond = (other < 0) | (other >= across)
        absent = ~found[..., None, :] | (beyond & ((on == 0) | bool(self._turn)))
        place = line[..., None, :] * across + other % across + 1
        return torch.where(absent, length * across, place).flatten(-3, -2)

    def tables(self, embedding: Float[Tensor, "K C"]) -> Float[Tensor, "R C"]:
        """Return what every token adds at every place around, and last 0 for one that does not come before it."""
        mapped = torch.einsum("kc,ncd->nkd", embedding, self.maps).flatten(0, 1).to(embedding.dtype)
        return torch.cat((mapped, mapped.new_zeros(1, mapped.shape[1])))

    def forward(
        self, tokens: Int[Tensor, "B T"], embedding: Float[Tensor, "K C"], columns: Int[Tensor, "*B W"] | None = None
    ) -> Float[Tensor, "B T C"]:
        """Return what is added at each position of sequences that begin with the start token.

        Codes are mapped once where there are fewer of them than tokens; else the tokens are.

        Args:
            embedding: the vector that stands for each token.
            columns: numbers in the grid of the columns of windows; None where the grid is one sequence.
        """
        around = self.around(tokens, self.places(columns))
        if tokens.numel() > len(embedding):
            return self.added(around, self.tables(embedding))
        vectors = F.pad(as_in_products(embedding), (0, 0, 0, 1))
        read = F.embedding(torch.where(around < 0, len(embedding), around), vectors)
        return (read.flatten(-2) @ self.maps.flatten(0, 1)).to(embedding.dtype)

    def around(self, tokens: Int[Tensor, "B T"], places: Int[Tensor, "*B P N"]) -> Int[Tensor, "B T N"]:
        """Return the tokens at the places around each position of sequences that begin with the start token, or -1."""
        count, length = tokens.shape
        known = F.pad(tokens, (0, places.shape[-2] + 1 - length), value=-1)
        places = places[..., :length, :].expand(count, -1, -1)
        return known.gather(1, places.flatten(1)).view_as(places)

    def added(self, around: Int[Tensor, "*B N"], tables: Float[Tensor, "R C"]) -> Float[Tensor, "*B C"]:
        """Return the sum over the tokens around; -1 is none."""
        count = len(self.maps)
        offsets = torch.arange(count, device=around.device) * (len(tables) // count)
        rows = torch.where(around < 0, len(tables) - 1, around + offsets)
        return F.embedding_bag(rows.flatten(0, -2), tables, mode="sum").unflatten(0, around.shape[:-1])


class CausalTransformer(Transformer):
    """Predicts, at every position of a sequence, the token that follows.

    Args:
        num_tokens: number of different tokens.
        grid_size: rows and columns of the grid whose tokens it predicts: one sequence row by row, or windows of it
            column by column (``config.window_columns``).
        code_features: meaning of every code, by which codes share weights; wanted if ``config.code_features``.

    Attributes:
        windows: the windows over the grid; None where the grid is one sequence.
    """

    def __init__(
        self,
        config: TransformerConfig,
        num_tokens: int,
        grid_size: tuple[int, int],
        code_features: CodeFeatures | None = None,
    ) -> None:
        if config.code_features and code_features is None:
            cure = "take the tokenizer nearest_range, or leave it out"
            raise ConfigError(
                "model.transformer.code_features", "a tokenizer that knows what its codes stand for", cure
            )
        rows, columns = grid_size
        windows = Windows(grid_size, config.window_columns) if config.window_columns else None
        length = rows * columns if windows is None else windows.length
        super().__init__(config, num_tokens, num_tokens, length, causal=True, code_features=code_features)
        self.windows, self.column_emb, self.around = windows, None, None
        if windows is not None:
            self.column_emb = nn.Parameter(torch.zeros(1, columns, config.width))
        if config.neighbours:
            in_order, turn = (grid_size, 0) if windows is None else ((windows.columns, rows), columns)
            self.around = TokensAround(in_order, config.width, turn)
            if self.shared is not None:
                self.around.maps.data *= _AROUND_IF_SHARED

    def forward(
        self,
        tokens: Int[Tensor, "B T"],
        columns: Int[Tensor, "*B W"] | None = None,
        next_tokens: Int[Tensor, "B T"] | None = None,
    ) -> Float[Tensor, "B T *K"]:
        """Return the logits of the next token at each position; or of given next tokens the nats, which is quicker.

        Args:
            tokens: sequences that begin with the start token.
            columns: numbers in the grid of the columns of windows; None where the grid is one sequence.
            next_tokens: the token that follows each, of which the negative log-likelihood is returned.
        """
        x = self._read(self.embedded(tokens, columns))
        return self.head(x) if next_tokens is None else self.head.nats(x, next_tokens)

    def embedded(
        self, tokens: Int[Tensor, "B T"], columns: Int[Tensor, "*B W"] | None = None
    ) -> Float[Tensor, "B T C"]:
        """Return what the blocks read."""
        embedding = self.embedding()
        x = F.embedding(tokens, embedding) + self.positions(columns)[..., : tokens.shape[1], :]
        return x if self.around is None else x + self.around(tokens, embedding, columns)

    def positions(self, columns: Int[Tensor, "*B W"] | None = None) -> Float[Tensor, "*B T C"]:
        """Return what is learned of each position of a sequence, or of windows at these columns of the grid."""
        if self.column_emb is None or columns is None:
            return self.pos_emb[0]
        of_columns = self.column_emb[0, columns.to(self.column_emb.device)]
        return self.pos_emb[0] + of_columns.repeat_interleave(self.context_length // columns.shape[-1], -2)


class MaskedTransformer(Transformer):
    """Predicts the tokens of a sequence that are hidden, which it reads as ``mask_token``."""

    def __init__(self, config: TransformerConfig, num_tokens: int, context_length: int) -> None:
        for setting in ("neighbours", "code_features", "window_columns"):
            if getattr(config, setting):
                cure = "leave it out, or take a generator of tokens one by one"
                raise ConfigError(f"model.transformer.{setting} of masked tokens", "its default", cure)
        super().__init__(config, num_tokens + 1, num_tokens, context_length, causal=False)
        self.mask_token = num_tokens


class _Attention(nn.Module):
    def __init__(self, config: TransformerConfig, causal: bool) -> None:
        super().__init__()
        self.heads, self.causal = config.heads, causal
        self.key, self.query, self.value, self.proj = (nn.Linear(config.width, config.width) for _ in range(4))

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = (
            linear(x).unflatten(-1, (self.heads, -1)).transpose(1, 2) for linear in (self.query, self.key, self.value)
        )  # (B, heads, T, d)
        mixed = attend(q, k, v, causal=self.causal)
        return self.proj(mixed.transpose(1, 2).flatten(-2))


class TransformerBlock(Block):
    """Attention, then a perceptron, each added to what comes in, over tokens of :attr:`TransformerConfig.width`."""

    def __init__(self, config: TransformerConfig, causal: bool) -> None:
        super().__init__()
        self.ln1, self.ln2 = nn.LayerNorm(config.width), nn.LayerNorm(config.width)
        self.attn = _Attention(config, causal)
        self.mlp = nn.Sequential(
            nn.Linear(config.width, 4 * config.width), nn.GELU(), nn.Linear(4 * config.width, config.width)
        )
        self.drop = nn.Dropout(config.residual_dropout)

    def forward(self, x: Float[Tensor, "B T C"]) -> Float[Tensor, "B T C"]:
        """Add what the two layers find."""
        x = x + self.drop(self.attn(self.ln1(x)))
        return x + self.drop(self.mlp(self.ln2(x)))


def resample_positions(
    positions: Float[Tensor, "1 T C"], grid: tuple[int, int], columns: int
) -> Float[Tensor, "1 T_new C"]:
    """Return positions learned for one token grid for a grid of as many rows and another number of columns.

    Every column of the new grid takes the linear interpolation of the two old ones around its azimuth, which wraps.

    Args:
        positions: learned positions, row by row.
    """
    rows, old = grid
    at = (torch.arange(columns, dtype=torch.float64) + 0.5) * old / columns - 0.5  # centres of the new columns
    left = at.floor().long()
    weight = (at - left).to(positions)[:, None]
    by_column = positions.unflatten(1, (rows, old))
    mixed = by_column[:, :, left % old] * (1 - weight) + by_column[:, :, (left + 1) % old] * weight
    return mixed.flatten(1, 2)


def _initialise(module: nn.Module) -> None:
    if isinstance(module, nn.Linear | nn.Embedding):
        nn.init.normal_(module.weight, std=0.02)
    if isinstance(module, nn.Linear) and module.bias is not None:
        nn.init.zeros_(module.bias)

"""A neural process for pushes of one object, conditioned on other pushes of the same object.

An object's support and friction are invisible to a camera but show in the outcomes of pushes. The
context is a set of such pushes and, where known, the feet. The network is a transformer (Nguyen and
Grover, Transformer Neural Processes, ICML 2022) whose queries attend to feet and context only:
predictions depend neither on the order of these, nor on other queries.

Pushes and feet are rows as in `physics.py`, in units of the object's radius of gyration, in
its frame; pushes with known outcome have three more values: displacement and rotation.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import huber_loss, scaled_dot_product_attention, softplus

from affordlib.geometry import cross, quarter_turn
from affordlib.weights import resolve_checkpoint, restored

WIDTH, BLOCKS, HEADS = 64, 4, 4
PRETRAINED = "np_simulated_pushes"
_CONTEXT = 32
_OUTCOME_SCALE = 0.12


def transformed(rows: Tensor, matrix: Tensor) -> Tensor:
    """Rotate or mirror pushes (B, N, 7 or 10) or feet (B, N, 3) by orthogonal (B, 2, 2)."""
    if rows.shape[-1] == 3:
        return torch.cat([rows[..., :2] @ matrix, rows[..., 2:]], -1)
    vectors = rows[..., :6].unflatten(-1, (3, 2)) @ matrix[:, None]
    parts = [vectors.flatten(-2), rows[..., 6:7]]
    if rows.shape[-1] == 10:
        parts += [rows[..., 7:9] @ matrix, rows[..., 9:] * torch.linalg.det(matrix)[:, None, None]]
    return torch.cat(parts, -1)


def rotation(angle: Tensor, mirrored: Tensor) -> Tensor:
    """Matrices (B, 2, 2) for `transformed`: mirror where `mirrored`, then rotate by angles (B,)."""
    c, s = angle.cos(), angle.sin()
    flip = 1 - 2 * mirrored.float()
    return torch.stack([torch.stack([c, s], -1), torch.stack([-s * flip, c * flip], -1)], -2)


def in_contact_frame(push: Tensor, outcome: Tensor) -> Tensor:
    """Outcomes (..., 3) along the normal and the tangent of their contacts, and the rotation."""
    normal, xy = push[..., 2:4], outcome[..., :2]
    tangent = quarter_turn(normal)
    return torch.stack([(xy * normal).sum(-1), (xy * tangent).sum(-1), outcome[..., 2]], -1)


def _features(push: Tensor) -> Tensor:
    contact, normal, direction, travel = push[..., :7].split([2, 2, 2, 1], dim=-1)
    tangent = quarter_turn(normal)
    dots = [(contact, normal), (contact, tangent), (direction, tangent), (direction, normal)]
    invariant = [(a * b).sum(-1) for a, b in dots] + [cross(contact, direction)]
    scaled = [travel * 2 - 0.6, travel.log() + 1.3, torch.stack(invariant, -1)]
    return torch.cat([contact, normal, direction, *scaled], -1)


class _Block(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(WIDTH) for _ in range(2))
        self.qkv, self.out = nn.Linear(WIDTH, 3 * WIDTH), nn.Linear(WIDTH, WIDTH)
        self.mlp = nn.Sequential(
            nn.Linear(WIDTH, 3 * WIDTH), nn.GELU(), nn.Linear(3 * WIDTH, WIDTH)
        )

    def forward(self, h: Tensor, mask: Tensor) -> Tensor:
        qkv = self.qkv(self.norms[0](h)).unflatten(-1, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        attended = scaled_dot_product_attention(*qkv, attn_mask=mask)
        h = h + self.out(attended.transpose(1, 2).flatten(-2))
        return h + self.mlp(self.norms[1](h))


class NeuralProcess(nn.Module):
    """Predicts outcomes of pushes from other pushes of the object and from its feet, if known."""

    def __init__(self) -> None:
        super().__init__()
        self.nothing = nn.Parameter(torch.zeros(1, 1, WIDTH))
        self.query, self.context = nn.Linear(13, WIDTH), nn.Linear(16, WIDTH)
        self.feet = nn.Linear(3, WIDTH)
        self.hidden = nn.Sequential(nn.GELU(), nn.Linear(WIDTH, WIDTH))
        self.blocks = nn.ModuleList(_Block() for _ in range(BLOCKS))
        self.last = nn.Sequential(
            nn.LayerNorm(WIDTH), nn.Linear(WIDTH, WIDTH), nn.GELU(), nn.Linear(WIDTH, 6)
        )

    def forward(
        self, query: Tensor, context: Tensor, feet: Tensor, seen: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Mean and σ (B, Q, 3) in the contact frames.

        query: (B, Q, 7 or more); context: (B, C, 10); seen: (B, C), which of the context to use
        (default: all); feet: (B, F, 3), of which those of positive weight are used.
        """
        known = torch.cat([_features(context), 8 * in_contact_frame(context, context[..., 7:])], -1)
        tokens = [self.feet(feet * feet.new_tensor([1, 1, 4])), self.context(known)]
        tokens = self.hidden(torch.cat([*tokens, self.query(_features(query))], 1))
        h = torch.cat([self.nothing.expand(len(tokens), -1, -1), tokens], 1)
        seen = torch.ones(context.shape[:2], dtype=torch.bool) if seen is None else seen
        shown = [torch.ones(len(h), 1, dtype=torch.bool), feet[..., 2] > 1e-6, seen]
        shown = torch.cat([*shown, torch.zeros(query.shape[:2], dtype=torch.bool)], 1)
        mask = (shown[:, None] | torch.eye(h.shape[1], dtype=torch.bool))[:, None]
        for block in self.blocks:
            h = block(h, mask)
        mean, raw = self.last(h[:, -query.shape[1] :]).chunk(2, -1)
        return mean * _OUTCOME_SCALE, 0.3 * softplus(raw - 3) + 0.003

    @torch.no_grad()
    def predict(self, query: Tensor, context: Tensor, feet: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and σ (Q, 3) in the contact frames; query (Q, 7), context (C, 10).

        Averages over the eight quarter rotations and reflections, to which it is invariant.
        """
        mirrored = torch.arange(8) % 2 == 1
        matrix = rotation(torch.arange(8) // 2 * (math.pi / 2), mirrored)
        images = [transformed(v.expand(8, -1, -1), matrix) for v in (query, context, feet)]
        mean, std = self(*images)
        mean = torch.where(mirrored[:, None, None], mean * mean.new_tensor([1, -1, -1]), mean)
        return mean.mean(0), std.mean(0)


def train_neural_process(
    model: NeuralProcess,
    tasks: Sequence[Tensor],
    feet: Tensor,
    effort: tuple[int, float, int],
    generator: torch.Generator,
    report: Callable[[int, float], None] = lambda step, loss: None,
) -> None:
    """Train in place on tasks, each (n, 10), the pushes of one object, n > 1.

    feet: (tasks, F, 3), given to the model in half of the draws. effort: steps, maximum learning
    rate, tasks per step. Each task drawn is split into context and queries, and rotated and
    mirrored at random. report: called after each step with its number and loss.
    """
    steps, rate, batch = effort
    queries = 16 if max(len(task) for task in tasks) > 40 else 8
    optimiser = torch.optim.AdamW(model.parameters(), rate, weight_decay=1e-4, betas=(0.9, 0.98))
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, steps, pct_start=0.08)
    for step in range(steps):
        drawn = torch.randint(len(tasks), (batch,), generator=generator)
        parts = [_split(tasks[i], queries, generator) for i in drawn.tolist()]
        rows, seen = map(torch.stack, zip(*parts, strict=True))
        chance = torch.rand(3, batch, generator=generator)
        matrix = rotation(chance[0] * 2 * math.pi, chance[1] < 0.5)
        rows = transformed(rows, matrix)
        given = transformed(feet[drawn] * (chance[2] < 0.5)[:, None, None], matrix)
        context, query = rows.split([_CONTEXT, queries], 1)
        mean, std = model(query, context, given, seen)
        truth = in_contact_frame(query, query[..., 7:])
        off = (truth - mean.detach()) / std
        loss = huber_loss(50 * mean, 50 * truth)  # linear beyond 2 % of the radius
        loss = loss + 0.05 * (std.log() + off.clamp(-4, 4) ** 2 / 2).mean()
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        report(step + 1, loss.item())


def _split(task: Tensor, queries: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Rows of a task, context first, then queries (repeated if few); mask of the context."""
    order = torch.randperm(len(task), generator=generator)
    n = min(_CONTEXT, max(len(task) // 2, len(task) - 8))
    share = min(1.0, 1.5 * float(torch.rand(1, generator=generator)))
    places = torch.arange(_CONTEXT), n + torch.arange(queries) % (len(task) - n)
    seen = places[0] < round(share * n)
    return task[order[torch.cat([places[0] % n, places[1]])]], seen


def load_neural_process(name_or_path: str | Path = PRETRAINED) -> NeuralProcess:
    """Load a shipped or another checkpoint; ValueError if it is damaged or of another kind."""
    path, remedy = resolve_checkpoint(name_or_path), "train it: python -m experiments.pretrain_np"

    def make(_description):
        with torch.device("meta"):  # draws no random weights
            return NeuralProcess()

    return restored(path, remedy, make)[0]

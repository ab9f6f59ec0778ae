"""Decisions: the largest of some scores says which of some values counts, as where a controller picks an advisory."""

from __future__ import annotations

import torch
from torch import Tensor

from sagemp_cli.errors import UsageError


def choose(scores: Tensor, values: Tensor) -> Tensor:
    """The value of the largest score, ``values[..., argmax(scores), :]``; the first of them where several are largest.

    It is made of comparisons, so that a step that decides can be recorded, bounded, certified and checked, where
    ``torch.argmax`` is refused. On a set on which only one decision is possible it is the value of that one; else it
    is anything between the values of the decisions that are possible, step by step: the hull of all of them, so no
    decision is left out. It does not follow each decision by itself: cells that lie on one side of a decision do.

    Args:
        scores: ``(..., A)``, of a network say, in float64 or float32.
        values: ``(..., A, m)``: controls, next states, the outputs of A networks; or a table ``(A, m)``.

    Raises:
        UsageError: there are not as many values as scores.
    """
    if values.dim() < 2 or scores.dim() < 1 or values.shape[-2] != scores.shape[-1]:
        raise UsageError(
            f"choose: scores (..., A) and values (..., A, m) are needed, found {tuple(scores.shape)} and "
            f"{tuple(values.shape)}"
        )
    best, chosen = scores[..., :1], values[..., 0, :]
    for i in range(1, scores.shape[-1]):
        score = scores[..., i : i + 1]
        chosen = torch.where(score > best, values[..., i, :], chosen)
        best = torch.maximum(best, score)
    return chosen

"""What the local network reads of an instruction: which of a few words occur in it, nothing more."""

from __future__ import annotations

import re

import torch
from torch import Tensor

from sagemp_cli.scenes.objects import OBJECTS

WORDS = ("avoid", "avoiding", "obstacles", "food", "circles", "except", "over", *OBJECTS)
"""All words that the network knows; the order is that of its inputs."""


def bag_of_words(text: str) -> Tensor:
    """1 for every one of :data:`WORDS` that occurs in the text, else 0: ``(len(WORDS),)``, float32."""
    found = set(re.findall(r"[a-z]+", text.lower()))
    return torch.tensor([float(word in found) for word in WORDS])

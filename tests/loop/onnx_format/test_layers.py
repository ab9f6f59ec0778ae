"""Networks as layers: what is too large is refused before its numbers are made."""

import pytest

from sagemp_cli.errors import ConfigError
from sagemp_cli.loop.onnx_format.layers import Layer, Network


def test_the_numbers_of_all_layers_together_are_limited():
    half = Layer("linear", 2**11, (0,))
    again = Layer("linear", 2**12, (1,))
    with pytest.raises(ConfigError, match="network: it has more than 16777216 numbers, far more than can be bounded"):
        Network(2**12, [half, again])

"""A double pendulum under two controllers; the claim about the more robust one is false, the other is true."""

import torch

from sagemp_cli.scenes.requirements import Inside


class LessRobust:
    """Two angles and their rates."""

    network = "Double_Pendulum__controller_double_pendulum_less_robust.onnx"
    period, horizon = 0.05, 20
    state_names = ("x1", "x2", "x3", "x4")
    start = ((1.0, 1.3),) * 4
    requirements = (Inside({name: (-1.7, 2.0) for name in state_names}),)

    def control(self, x, network):
        """Two torques."""
        return network(x)

    def rate(self, x, u):
        """The time derivative of the state."""
        a, b, p, q = x.unbind(-1)
        d = a - b
        sine, cosine = torch.sin(d), torch.cos(d)
        first = 4 * u[..., 0] + 2 * torch.sin(a) - 0.5 * q**2 * sine
        both = p**2 * sine + 8 * u[..., 1] + 2 * torch.sin(b) - first * cosine
        below = 0.5 * cosine**2 - 1
        return torch.stack([p, q, first + 0.5 * cosine * both / below, -both / below], -1)


class MoreRobust(LessRobust):
    """The same under another network, at another period and with a narrower claim."""

    network = "Double_Pendulum__controller_double_pendulum_more_robust.onnx"
    period = 0.02
    requirements = (Inside({name: (-1.5, 1.5) for name in LessRobust.state_names}),)
